"""Where the paper's solver starts: keypoint depths."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from kronc_ns.fit.depths import mean_distance, prior_depths, random_depths
from kronc_ns.fit.starts import circular_poses
from kronc_ns.geometry.camera import rays
from kronc_ns.geometry.poses import camera_z
from kronc_ns.synthetic.variations import noisy_poses


def test_the_distance_is_that_of_the_cameras_from_the_origin():
    assert mean_distance(circular_poses(7, radius_m=2.5)) == pytest.approx(2.5)


def test_random_depths_fill_the_papers_range_and_follow_the_seed():
    c2w = circular_poses(50, radius_m=6.0)

    def drawn(seed: int) -> np.ndarray:
        return random_depths(c2w, 66, np.random.default_rng(seed))

    z = drawn(1)
    assert 3.0 <= z.min() < 3.05
    assert 5.95 < z.max() <= 6.0
    assert_array_equal(z, drawn(1))
    assert (z != drawn(2)).any()


def test_prior_depths_are_scaled_to_the_trajectory(walk_capture):
    """Depths in any unit come back in that of the poses, which need not be exact; unknown ones are replaced."""
    c2w, camera = walk_capture.c2w, walk_capture.camera
    true = camera_z(c2w, walk_capture.points)
    seen = walk_capture.keypoints[..., 2] > 0
    given = np.where(seen, true / 7.3, math.nan)

    def found(poses: np.ndarray, depths: np.ndarray = given) -> np.ndarray:
        directions = rays(walk_capture.keypoints[..., :2], camera)
        return prior_depths(depths, poses, directions, seen.astype(float), np.full_like(true, 3.3))

    assert_allclose(found(c2w)[seen], true[seen], rtol=5e-3)
    assert (found(c2w)[~seen] == 3.3).all()
    noisy = noisy_poses(c2w, 4.0, 0.5, np.random.default_rng(0))
    assert_allclose(found(noisy)[seen], true[seen], rtol=0.1)
    on_circle = found(circular_poses(len(c2w), radius_m=8.0))[seen]
    assert (on_circle / given[seen]).std() < 1e-9, "one factor for all"
    assert np.median(on_circle) == pytest.approx(8.0, rel=0.35)
    assert (found(c2w, given * math.nan) == 3.3).all()
