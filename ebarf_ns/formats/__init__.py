"""Import of foreign recordings, trajectories, calibrations and datasets into scenes."""
