"""Image features after keypoints: exact poses where the photos allow them, accepted only when better."""
