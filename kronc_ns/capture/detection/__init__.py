"""Keypoint detectors behind one protocol; each loads what it needs only when it is chosen."""
