"""Errors of poses and of images."""
