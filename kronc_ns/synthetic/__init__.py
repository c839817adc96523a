"""Synthetic car scenes with exact ground truth: keypoints only (fast) and rendered images."""
