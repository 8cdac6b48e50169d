"""Floor 1: target photographs to cameras."""
