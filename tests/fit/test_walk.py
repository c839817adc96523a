"""Views without keypoints, on the walk between their neighbours."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from kronc_ns.fit.starts import circular_poses
from kronc_ns.fit.walk import Interpolated, interpolate_walk
from kronc_ns.geometry.poses import posed
from kronc_ns.geometry.rotations import rotation_angle_deg
from kronc_ns.synthetic.scenes import walk_poses


def walk(views: int = 60, seed: int = 0, **options) -> np.ndarray:
    return walk_poses(views, np.random.default_rng(seed), **options)


def holes(views: int, share: float, seed: int = 0) -> np.ndarray:
    """Which views are known; the first and the last are."""
    known = np.random.default_rng(seed).uniform(size=views) >= share
    known[[0, -1]] = True
    return known


def all_but(views: int, *unknown: int) -> np.ndarray:
    """Every view is known but these."""
    return ~np.isin(np.arange(views), unknown)


def interpolated(truth: np.ndarray, known: np.ndarray) -> Interpolated | None:
    """The walk, told the poses of the known views only."""
    return interpolate_walk(np.where(known[:, None, None], truth, math.nan), known)


def completed(truth: np.ndarray, known: np.ndarray) -> Interpolated:
    placed = interpolated(truth, known)
    assert placed is not None
    return placed


def errors(c2w: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    angle = rotation_angle_deg(c2w[..., :3].swapaxes(-1, -2) @ truth[..., :3])
    return angle, np.linalg.norm(c2w[..., 3] - truth[..., 3], axis=-1)


@pytest.mark.parametrize("options", [{}, {"clockwise": True}, {"laps": 0.5}, {"laps": 1.5}])
def test_a_fifth_of_a_walk_is_placed_about_as_well_as_the_hand_was_steady(options):
    for seed in range(2):
        truth, known = walk(seed=seed, **options), holes(60, 0.2, seed)
        placed = completed(truth, known)
        rotation, centre = errors(placed.c2w, truth)
        assert np.median(rotation[~known]) < 3.0  # every view is shaken by a degree about each axis
        assert np.median(centre[~known]) < 0.1
        assert rotation.max() < 10.0
        assert centre.max() < 0.5


def test_known_views_are_where_they_were():
    truth, known = walk(), holes(60, 0.2)
    placed = completed(truth, known)
    rotation, centre = errors(placed.c2w[known], truth[known])
    assert rotation.max() < 1e-4
    assert centre.max() < 1e-8
    assert np.isnan(placed.sigma_rot_deg[known]).all()
    assert np.isnan(placed.sigma_trans_m[known]).all()


def test_the_sigmas_say_how_far_off_it_is():
    share_rotation, share_centre = [], []
    for seed in range(6):
        truth, known = walk(40, seed), holes(40, 0.2, seed)
        placed = completed(truth, known)
        rotation, centre = errors(placed.c2w, truth)
        share_rotation.append((rotation / placed.sigma_rot_deg)[~known])
        share_centre.append((centre / placed.sigma_trans_m)[~known])
    # the sigma is the root mean square of all three axes together
    assert 0.7 < np.sqrt(np.mean(np.square(np.concatenate(share_rotation)))) < 1.3
    assert 0.7 < np.sqrt(np.mean(np.square(np.concatenate(share_centre)))) < 1.4


def test_wider_gaps_are_less_certain():
    truth, known = walk(120), all_but(120, 20, *range(60, 67))
    placed = completed(truth, known)
    assert placed.sigma_trans_m[63] > placed.sigma_trans_m[20]


def test_a_perfect_circle_is_continued_exactly():
    truth, known = circular_poses(36, 5.0), all_but(36, 0, 7, 8, 20, 35)
    placed = completed(truth, known)
    rotation, centre = errors(placed.c2w, truth)
    assert rotation.max() < 1e-4
    assert centre.max() < 1e-8
    assert placed.sigma_rot_deg[~known].max() < 1e-3
    assert placed.sigma_trans_m[~known].max() < 1e-6


def test_views_in_any_order_are_no_walk():
    truth, known = walk()[np.random.default_rng(0).permutation(60)], holes(60, 0.2)
    assert interpolated(truth, known) is None


@pytest.mark.parametrize("count", range(5))
def test_a_few_views_are_no_walk(count):
    known = np.arange(60) < count
    assert interpolated(walk(), known) is None


def test_gaps_that_are_too_wide_stay_open():
    truth, known = walk(), all_but(60, *range(20, 34), 45)  # 14 views are 90 degrees
    placed = completed(truth, known)
    assert np.isnan(placed.c2w[20:34]).all()
    assert np.isnan(placed.sigma_rot_deg[20:34]).all()
    assert np.isfinite(placed.c2w[45]).all()


def test_a_walk_is_continued_a_little_only():
    truth, known = walk(), all_but(60, 0, 1, *range(50, 60))
    placed = completed(truth, known)
    assert posed(placed.c2w).tolist() == [True] * 53 + [False] * 7
    assert errors(placed.c2w[:2], truth[:2])[1].max() < 0.3
    assert errors(placed.c2w[50:53], truth[50:53])[1].max() < 0.6


def test_poses_are_poses():
    truth, known = walk(), holes(60, 0.3, 3)
    placed = completed(truth, known)
    rotation = placed.c2w[..., :3]
    assert_allclose(rotation.swapaxes(-1, -2) @ rotation, np.tile(np.eye(3), (60, 1, 1)), rtol=0, atol=1e-9)
    assert (np.linalg.det(rotation) > 0).all()
    assert np.isfinite(placed.sigma_rot_deg[~known]).all()
