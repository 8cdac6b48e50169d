"""Floor 2: radiance frames to the light around a point."""
