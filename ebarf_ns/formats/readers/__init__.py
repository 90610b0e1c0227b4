"""Readers for the recordings of cameras and datasets, one module per format."""
