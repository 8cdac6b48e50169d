"""Devices that are not there: the same bytes behind a real pseudo-terminal."""
