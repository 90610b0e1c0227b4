"""Evaluation of runs: errors, held-out events, report."""
