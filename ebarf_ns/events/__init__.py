"""Recordings, estimates of their sensor's properties, and event pairs."""
