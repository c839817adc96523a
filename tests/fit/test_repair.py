"""Odd views: found, and put right or left out."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from kronc_ns.fit.attempts import adjust_starts
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.repair import repair
from kronc_ns.fit.starts import start_from_poses, start_from_template
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.synthetic.scenes import make_capture
from kronc_ns.synthetic.variations import swap_sides
from tests.conftest import scene_of

CONFIG = KroncConfig()


def solved(scene, c2w):
    return adjust_starts([start_from_poses("given", scene, c2w)], KroncConfig())


def rng() -> np.random.Generator:
    return np.random.default_rng(1)


@pytest.mark.parametrize("given", [True, False])
def test_swapped_views_are_found_and_repaired_and_no_others(lap, lap_start, given):
    swapped, chosen = swap_sides(lap, 0.15, rng())
    assert int(chosen.sum()) == 3
    scene = scene_of(swapped)
    first = start_from_poses("given", scene, lap_start) if given else start_from_template(scene)
    (attempt,) = repair(adjust_starts([first], CONFIG), CONFIG)
    assert attempt.start.swapped.equal(chosen)
    assert attempt.start.scene.keypoints.equal(lap.keypoints), "put right"
    assert attempt.agreeing.all()
    rotation, centre = pose_errors(attempt.start.c2w, lap.c2w)
    assert rotation.max() < 2.5
    assert rotation.mean() < 0.6
    assert centre.max() < 0.2


def test_a_view_of_another_car_is_dropped(lap, lap_start):
    other = make_capture("walk", views=20, seed=40, noise_px=0.7)
    keypoints = lap.keypoints.clone()
    keypoints[6] = other.keypoints[15]  # seen from elsewhere, with its points in another order
    keypoints[6] = keypoints[6][torch.from_numpy(rng().permutation(66))]
    scene = replace(scene_of(lap), keypoints=keypoints)
    (attempt,) = repair(solved(scene, lap_start), CONFIG)
    kept = torch.arange(20) != 6
    assert attempt.agreeing.equal(kept)
    assert pose_errors(attempt.start.c2w[kept], lap.c2w[kept])[0].mean() < 0.7


def test_a_view_that_was_set_on_the_wrong_side_is_brought_back(lap, lap_start):
    wrong = lap_start.clone()
    wrong[3] = lap_start[13]
    (before,) = solved(scene_of(lap), wrong)
    (after,) = repair([before], CONFIG)
    assert after.agreeing.all()
    assert pose_errors(after.start.c2w, lap.c2w)[0].max() < 2.5
    assert after.iterations >= before.iterations


def test_nothing_is_repaired_where_nothing_is_wrong(lap, lap_start):
    before = solved(scene_of(lap), lap_start)
    after = repair(before, CONFIG)
    assert after[0] is before[0]


def test_two_starts_of_one_scene_end_in_one_place(lap, lap_start):
    attempts = adjust_starts(
        [start_from_template(scene_of(lap)), start_from_poses("given", scene_of(lap), lap_start)], CONFIG
    )
    attempts = repair(attempts, CONFIG)
    rotation, centre = pose_errors(attempts[0].start.c2w, attempts[1].start.c2w)
    assert rotation.max() < 0.02
    assert centre.max() < 0.002
