"""The way of the cameras from start to end."""

import math
from dataclasses import replace

import pytest
import torch

from kronc_ns.geometry.poses import make_pose
from kronc_ns.geometry.rotations import rotation_angle_deg, so3_exp
from kronc_ns.options import KroncConfig
from kronc_ns.pipeline import solve_scene
from kronc_ns.stages import aligned_start, between, frustum_depth
from tests.conftest import scene_of


def poses(count: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    turn, centre = torch.randn(2, count, 3, generator=generator, dtype=torch.float64)
    return make_pose(so3_exp(0.5 * turn), centre)


def test_the_way_begins_at_the_start_and_ends_at_the_end():
    before, after = poses(6, 0), poses(6, 1)
    torch.testing.assert_close(between(before, after, 0.0), before)
    torch.testing.assert_close(between(before, after, 1.0), after)


def test_half_way_is_equally_far_from_both_ends():
    before, after = poses(6, 2), poses(6, 3)
    half = between(before, after, 0.5)
    torch.testing.assert_close(half[..., 3], (before[..., 3] + after[..., 3]) / 2)
    first, second = (rotation_angle_deg(half[..., :3].mT @ end[..., :3]) for end in (before, after))
    torch.testing.assert_close(first, second)
    torch.testing.assert_close(first + second, rotation_angle_deg(before[..., :3].mT @ after[..., :3]))


def test_cameras_without_a_start_stay_and_those_without_an_end_have_none():
    before, after = poses(3, 4), poses(3, 5)
    before[0], after[1] = math.nan, math.nan
    half = between(before, after, 0.3)
    torch.testing.assert_close(half[0], after[0])
    assert half[1].isnan().all()


def test_a_start_in_another_frame_is_moved_onto_the_end(lap):
    scene = scene_of(lap)
    solution = solve_scene(scene, KroncConfig())
    turn = so3_exp(torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64))
    elsewhere = make_pose(turn @ solution.c2w[..., :3], 2.5 * solution.c2w[..., 3] @ turn.T + 3.0)
    torch.testing.assert_close(aligned_start(replace(solution, initial_c2w=elsewhere)), solution.c2w)


def test_many_cameras_are_drawn_smaller():
    few, many = poses(100, 6), poses(600, 6)
    assert frustum_depth(many) == pytest.approx(frustum_depth(few) / 2, rel=0.1)
    assert frustum_depth(few[:1]) > 0
