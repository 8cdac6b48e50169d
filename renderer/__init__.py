"""Floor 4: scene to picture, on Embree."""
