"""What a run is worth: errors, held-out events, report."""
