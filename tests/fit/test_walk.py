"""Views without keypoints, on the walk between their neighbours."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from kronc_ns.fit.walk import interpolate_walk
from kronc_ns.geometry.rotations import rotation_angle_deg
from kronc_ns.synthetic.scenes import walk_poses


def walk(views: int = 60, seed: int = 0, **options) -> Tensor:
    return walk_poses(views, np.random.default_rng(seed), **options)


def holes(views: int, share: float, seed: int = 0) -> Tensor:
    """Which views are known; the first and the last are."""
    known = torch.from_numpy(np.random.default_rng(seed).uniform(size=views) >= share)
    known[[0, -1]] = True
    return known


def hidden(c2w: Tensor, known: Tensor) -> Tensor:
    return torch.where(known[:, None, None], c2w, math.nan)


def errors(c2w: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    angle = rotation_angle_deg(c2w[..., :3].mT @ truth[..., :3])
    return angle, (c2w[..., 3] - truth[..., 3]).norm(dim=-1)


@pytest.mark.parametrize("options", [{}, {"clockwise": True}, {"laps": 0.5}, {"laps": 1.5}])
def test_a_fifth_of_a_walk_is_placed_about_as_well_as_the_hand_was_steady(options):
    for seed in range(2):
        truth, known = walk(seed=seed, **options), holes(60, 0.2, seed)
        placed = interpolate_walk(hidden(truth, known), known)
        assert placed is not None
        rotation, centre = errors(placed.c2w, truth)
        assert rotation[~known].median() < 3.0  # every view is shaken by a degree about each axis
        assert centre[~known].median() < 0.1
        assert rotation.max() < 10.0
        assert centre.max() < 0.5


def test_known_views_are_where_they_were():
    truth, known = walk(), holes(60, 0.2)
    placed = interpolate_walk(hidden(truth, known), known)
    rotation, centre = errors(placed.c2w[known], truth[known])
    assert rotation.max() < 1e-4
    assert centre.max() < 1e-8
    assert placed.sigma_rot_deg[known].isnan().all()
    assert placed.sigma_trans_m[known].isnan().all()


def test_the_sigmas_say_how_far_off_it_is():
    share_rotation, share_centre = [], []
    for seed in range(6):
        truth, known = walk(40, seed), holes(40, 0.2, seed)
        placed = interpolate_walk(hidden(truth, known), known)
        rotation, centre = (x[~known] for x in errors(placed.c2w, truth))
        share_rotation.append((rotation / placed.sigma_rot_deg[~known]).square())
        share_centre.append((centre / placed.sigma_trans_m[~known]).square())
    # the sigma is the root mean square of all three axes together
    assert 0.7 < float(torch.cat(share_rotation).mean().sqrt()) < 1.3
    assert 0.7 < float(torch.cat(share_centre).mean().sqrt()) < 1.4


def test_wider_gaps_are_less_certain():
    truth = walk(120)
    known = torch.ones(120, dtype=torch.bool)
    known[[20, *range(60, 67)]] = False
    placed = interpolate_walk(hidden(truth, known), known)
    assert placed.sigma_trans_m[63] > placed.sigma_trans_m[20]


def test_a_perfect_circle_is_continued_exactly():
    from kronc_ns.fit.starts import circular_poses

    truth = circular_poses(36, 5.0)
    known = torch.ones(36, dtype=torch.bool)
    known[[0, 7, 8, 20, 35]] = False
    placed = interpolate_walk(hidden(truth, known), known)
    rotation, centre = errors(placed.c2w, truth)
    assert rotation.max() < 1e-4
    assert centre.max() < 1e-8
    assert placed.sigma_rot_deg[~known].max() < 1e-3
    assert placed.sigma_trans_m[~known].max() < 1e-6


def test_views_in_any_order_are_no_walk():
    order = torch.from_numpy(np.random.default_rng(0).permutation(60))
    truth, known = walk()[order], holes(60, 0.2)
    assert interpolate_walk(hidden(truth, known), known) is None


@pytest.mark.parametrize("count", range(5))
def test_a_few_views_are_no_walk(count):
    known = torch.zeros(60, dtype=torch.bool)
    known[:count] = True
    assert interpolate_walk(hidden(walk(), known), known) is None


def test_gaps_that_are_too_wide_stay_open():
    truth, known = walk(), torch.ones(60, dtype=torch.bool)
    known[20:34] = False  # 90 degrees
    known[45] = False
    placed = interpolate_walk(hidden(truth, known), known)
    assert placed.c2w[20:34].isnan().all()
    assert placed.sigma_rot_deg[20:34].isnan().all()
    assert placed.c2w[45].isfinite().all()


def test_a_walk_is_continued_a_little_only():
    truth, known = walk(), torch.ones(60, dtype=torch.bool)
    known[:2] = False
    known[50:] = False
    placed = interpolate_walk(hidden(truth, known), known)
    posed = placed.c2w.isfinite().all(-1).all(-1)
    assert posed.tolist() == [True] * 53 + [False] * 7
    assert errors(placed.c2w[:2], truth[:2])[1].max() < 0.3
    assert errors(placed.c2w[50:53], truth[50:53])[1].max() < 0.6


def test_poses_are_poses():
    truth, known = walk(), holes(60, 0.3, 3)
    placed = interpolate_walk(hidden(truth, known), known)
    rotation = placed.c2w[..., :3]
    identity = torch.eye(3, dtype=torch.float64).expand(60, 3, 3)
    torch.testing.assert_close(rotation.mT @ rotation, identity, rtol=0, atol=1e-9)
    assert (torch.linalg.det(rotation) > 0).all()
    assert placed.sigma_rot_deg[~known].isfinite().all()
