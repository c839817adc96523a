"""Semantic keypoints: what they are called, how files hold them, which car of several they belong to."""
