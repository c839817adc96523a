"""Rotations, poses, cameras and alignment: pure functions on torch tensors of any device and dtype."""
