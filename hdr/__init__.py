"""Floor 1: brackets to radiance."""
