"""Rotations, poses, cameras, alignment and triangulation: pure functions on NumPy arrays."""
