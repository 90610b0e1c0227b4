"""Recordings as cameras and datasets write them, one file per format."""
