"""Trajectories, rotations, camera models and clock offsets."""
