"""Recordings, their sensor, and pairs of events."""
