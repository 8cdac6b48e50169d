"""Frames of several directions to one map (seeds.md F1s, A5, F2)."""
