"""From a video or photos to what the solver needs: upright frames of one size, masks and intrinsics."""
