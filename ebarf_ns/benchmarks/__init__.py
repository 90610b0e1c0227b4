"""Comparisons of methods, and timings of the engine."""
