"""What users bring: recordings, trajectories, calibrations and datasets of other programs, made into scenes."""
