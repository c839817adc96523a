"""Segmenters behind one protocol: where the car is in each image."""
