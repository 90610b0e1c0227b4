"""From time to pose: trajectories, rotations, cameras, clocks."""
