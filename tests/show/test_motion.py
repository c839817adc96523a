"""The way of the cameras from start to end."""

import math
from dataclasses import replace

import numpy as np
import pytest

from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.geometry.poses import make_pose
from kronc_ns.geometry.rotations import rotation_angle_deg, so3_exp
from kronc_ns.show.motion import aligned_path, aligned_start, frustum_depth, on_path
from kronc_ns.solve.adam import AdamConfig
from tests.conftest import scene_of


def poses(count: int, seed: int) -> np.ndarray:
    turn, centre = np.random.default_rng(seed).normal(size=(2, count, 3))
    return make_pose(so3_exp(0.5 * turn), centre)


def test_the_way_goes_through_its_stages():
    path = np.stack([poses(6, seed) for seed in range(4)])
    for i, stage in enumerate(path):
        np.testing.assert_allclose(on_path(path, i / 3), stage, atol=1e-9)


def test_half_way_is_equally_far_from_both_stages():
    path = np.stack([poses(6, seed) for seed in (2, 3, 4)])
    half = on_path(path, 0.75)
    np.testing.assert_allclose(half[..., 3], path[1:, :, :, 3].mean(0), atol=1e-9)
    first, second = (rotation_angle_deg(half[..., :3].swapaxes(1, 2) @ end[..., :3]) for end in path[1:])
    np.testing.assert_allclose(first, second, atol=1e-9)
    np.testing.assert_allclose(
        first + second, rotation_angle_deg(path[1, ..., :3].swapaxes(1, 2) @ path[2, ..., :3]), atol=1e-9
    )


def test_cameras_are_where_they_end_until_they_are_known_and_nowhere_without_an_end(lap):
    solution = solve_scene(scene_of(lap), KroncConfig())
    assert solution.path is not None
    c2w, path = solution.c2w.copy(), solution.path.copy()
    c2w[1], path[:2, 0] = math.nan, math.nan
    way = aligned_path(replace(solution, c2w=c2w, path=path, initial_c2w=np.full_like(c2w, math.nan)))
    np.testing.assert_allclose(way[:3, 0], np.broadcast_to(solution.c2w[0], (3, 3, 4)), atol=1e-9)
    assert not np.allclose(way[3, 0], solution.c2w[0], atol=1e-9)
    assert np.isnan(way[-1, 1]).all()


@pytest.mark.parametrize("solver", ["lm", "adam"])
def test_the_recorded_way_comes_ever_closer(lap, solver):
    config = KroncConfig(solver=solver, init="circular", adam=AdamConfig(steps=500, learning_rate=0.01))
    solution = solve_scene(scene_of(lap), config)
    way = aligned_path(solution)
    assert len(way) == 2 + min(20, len(solution.history["loss"]))
    off = np.linalg.norm(way[..., 3] - solution.c2w[..., 3], axis=-1).mean(1)
    assert off[0] > 0.1
    assert (off[1:] <= off[:-1] + 0.02 * off[0]).all()
    np.testing.assert_allclose(way[-2], way[-1], atol=0.02, rtol=0)


def test_a_start_in_another_frame_is_moved_onto_the_end(lap):
    scene = scene_of(lap)
    solution = solve_scene(scene, KroncConfig())
    turn = so3_exp(np.array([0.3, -0.2, 1.0]))
    elsewhere = make_pose(turn @ solution.c2w[..., :3], 2.5 * solution.c2w[..., 3] @ turn.T + 3.0)
    np.testing.assert_allclose(aligned_start(replace(solution, initial_c2w=elsewhere)), solution.c2w, atol=1e-9)


def test_many_cameras_are_drawn_smaller():
    few, many = poses(100, 6), poses(600, 6)
    assert frustum_depth(many) == pytest.approx(frustum_depth(few) / 2, rel=0.1)
    assert frustum_depth(few[:1]) > 0
