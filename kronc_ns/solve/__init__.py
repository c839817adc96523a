"""Pose solvers; each takes plain tensors and knows nothing about cars or files."""
