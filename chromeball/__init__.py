"""Capture light, calibrate cameras and insert synthetic objects into real places."""
