"""Where the solver may start."""

from dataclasses import replace

import torch

from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.starts import (
    circles,
    far_side,
    in_front,
    mirrored,
    start_from_poses,
    start_from_template,
    usable_views,
)
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from tests.conftest import scene_of

CONFIG = KroncConfig()


def test_starts_from_poses_stand_in_the_cars_frame(lap, lap_start):
    found = start_from_poses("given", scene_of(lap), lap_start)
    assert (found.points - lap.points).norm(dim=-1).median() < 0.5
    rotation, centre = pose_errors(found.c2w, lap_start)
    assert rotation.max() < 1e-4, "moved as a whole"
    assert centre.max() < 1e-6
    assert not found.swapped.any()
    assert found.used.all()


def test_a_template_starts_near_the_truth_without_poses(lap):
    found = start_from_template(scene_of(lap))
    rotation, centre = pose_errors(found.c2w[found.used], lap.c2w[found.used])
    assert found.used.double().mean() > 0.8
    assert rotation.median() < 8
    assert centre.median() < 0.8


def test_circles_go_both_ways_only_where_that_is_to_be_found_out(lap):
    scene = scene_of(lap)
    auto, asked = circles(scene, CONFIG), circles(scene, replace(CONFIG, init="circular", direction="cw", laps=0.5))
    assert len(auto) > 6
    assert {"ccw" in start.name for start in auto} == {True, False}
    assert [start.name for start in asked] == ["circular"]


def test_swapping_sides_twice_is_nothing(lap):
    assert mirrored(mirrored(lap.keypoints, APOLLOCAR3D_66), APOLLOCAR3D_66).equal(lap.keypoints)
    assert not mirrored(lap.keypoints, APOLLOCAR3D_66).equal(lap.keypoints)


def test_what_is_in_front_and_what_looks_away(lap):
    true = replace(start_from_poses("given", scene_of(lap), lap.c2w), c2w=lap.c2w, points=lap.points)
    seen = lap.keypoints[..., 2] > 0
    assert in_front(true).all()
    assert (far_side(true) & seen).double().sum() < 0.02 * seen.sum()
    assert 0.2 < float(far_side(true).double().mean()) < 0.7
    turned = replace(true, c2w=true.c2w.clone())
    turned.c2w[:, :, [0, 2]] *= -1
    assert not in_front(turned).any()


def test_views_with_fewer_than_four_points_are_not_usable(lap):
    keypoints = lap.keypoints.clone()
    for view, count in ((2, 3), (5, 4), (7, 0)):
        keypoints[view, torch.nonzero(keypoints[view, :, 2])[count:, 0]] = 0
    usable = usable_views(replace(scene_of(lap), keypoints=keypoints))
    assert torch.nonzero(~usable)[:, 0].tolist() == [2, 7]
