"""Where the solver may start."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.starts import (
    LOST,
    Hypothesis,
    circles,
    circular_poses,
    locate_views,
    single_views,
    start_from_poses,
    start_from_template,
    usable_views,
)
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.geometry.camera import reproject
from kronc_ns.geometry.poses import invert
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.solve.resection import unexplained

CONFIG = KroncConfig()


def azimuths(c2w: np.ndarray) -> np.ndarray:
    return np.rad2deg(np.arctan2(c2w[:, 1, 3], c2w[:, 0, 3])) % 360


def test_the_papers_circle():
    c2w = circular_poses(36)
    assert_allclose(np.linalg.norm(c2w[..., 3], axis=1), 4.0)
    assert_allclose(azimuths(c2w), np.arange(36) * 10.0, atol=1e-9)
    assert_allclose(c2w[..., 2], -c2w[..., 3] / 4.0, atol=1e-12, err_msg="facing the axis")
    assert_allclose(c2w[..., 1], np.tile([0.0, 0.0, -1.0], (36, 1)), atol=1e-12, err_msg="no tilt")


def test_direction_and_laps():
    assert_allclose(azimuths(circular_poses(4, direction="cw", laps=0.5)), [0.0, 315.0, 270.0, 225.0])


def test_starts_from_poses_stand_in_the_cars_frame(scene, lap, lap_start):
    found = start_from_poses("given", "given", scene, lap_start)
    assert np.median(np.linalg.norm(found.points - lap.points, axis=-1)) < 0.5
    rotation, centre = pose_errors(found.c2w, lap_start)
    assert rotation.max() < 1e-4, "moved as a whole"
    assert centre.max() < 1e-6
    assert not found.swapped.any()
    assert found.used.all()


def test_a_template_starts_near_the_truth_without_poses(scene, lap):
    found = start_from_template(scene)
    rotation, centre = pose_errors(found.c2w[found.used], lap.c2w[found.used])
    assert found.used.mean() > 0.8
    assert np.median(rotation) < 8
    assert np.median(centre) < 0.8


def test_circles_go_both_ways_only_where_that_is_to_be_found_out(scene):
    auto, asked = circles(scene, CONFIG), circles(scene, replace(CONFIG, init="circular", direction="cw", laps=0.5))
    assert len(auto) > 6
    assert {"ccw" in start.name for start in auto} == {True, False}
    assert len({start.name for start in auto}) == len(auto)
    assert [start.name for start in asked] == ["circular"]


def test_swapping_sides_twice_is_nothing(lap):
    mirrored = APOLLOCAR3D_66.mirrored
    assert_array_equal(mirrored(mirrored(lap.keypoints)), lap.keypoints)
    assert (mirrored(lap.keypoints) != lap.keypoints).any()


@pytest.fixture(scope="module")
def true(scene, lap) -> Hypothesis:
    return replace(start_from_poses("given", "given", scene, lap.c2w), c2w=lap.c2w, points=lap.points)


def turned_about(hypothesis: Hypothesis) -> Hypothesis:
    """Every camera looks the other way."""
    c2w = hypothesis.c2w.copy()
    c2w[:, :, [0, 2]] *= -1
    return replace(hypothesis, c2w=c2w)


def test_errors_are_distances_from_the_points(true, scene, lap):
    off = reproject(lap.points, lap.c2w, lap.camera) - scene.uv
    assert_allclose(true.error_px, np.linalg.norm(off, axis=-1))
    assert 0.5 < np.median(true.error_px[scene.seen]) / (0.7 * 1.1774) < 2


def test_errors_are_infinite_behind_a_camera_and_where_there_is_no_place(true):
    assert np.isfinite(true.error_px).all()
    assert np.isinf(turned_about(true).error_px).all()
    points, c2w = true.points.copy(), true.c2w.copy()
    points[4], c2w[7] = np.nan, np.nan
    lost = np.isinf(replace(true, points=points, c2w=c2w).error_px)
    assert_array_equal(lost, (np.arange(66) == 4) | (np.arange(20) == 7)[:, None])


def test_what_is_seen_does_not_look_away(true, scene):
    assert (true.far_side & scene.seen).sum() < 0.02 * scene.seen.sum()
    assert 0.2 < true.far_side.mean() < 0.7
    assert not replace(true, scene=replace(scene, schema=replace(scene.schema, keypoints=("?",) * 66))).far_side.any()


def test_views_are_located_without_a_pose_and_swapped_ones_told(scene, lap):
    """By the true points: as well as the noise allows; views that were not asked for have no pose."""
    chosen, swapped = np.arange(20) % 2 == 0, np.arange(20) % 8 == 0
    keypoints = np.where(swapped[:, None, None], scene.schema.mirrored(scene.keypoints), scene.keypoints)
    c2w, cost, told = locate_views(replace(scene, keypoints=keypoints), lap.points, chosen, 0.7)
    assert_array_equal(told, swapped)
    assert np.isnan(c2w[~chosen]).all()
    assert np.isinf(cost[~chosen]).all()
    assert (cost[chosen] < LOST / 4).all()
    off = invert(c2w[chosen])[..., 3] - invert(lap.c2w[chosen])[..., 3]
    assert np.median(np.linalg.norm(off, axis=-1)) < 0.1
    views = single_views(scene, lap.points, chosen, 0.7)  # its cost is that of its pose
    assert_allclose(
        cost[chosen], unexplained(views, invert(c2w[chosen])), rtol=1e-9, err_msg="its cost is that of its pose"
    )


def test_nothing_asked_nothing_located(scene, lap):
    c2w, cost, swapped = locate_views(scene, lap.points, np.zeros(20, dtype=bool), None)
    assert np.isnan(c2w).all()
    assert np.isinf(cost).all()
    assert not swapped.any()


def test_views_with_fewer_than_four_points_are_not_usable(scene, lap):
    keypoints = lap.keypoints.copy()
    for view, count in ((2, 3), (5, 4), (7, 0)):
        keypoints[view, np.flatnonzero(keypoints[view, :, 2])[count:]] = 0
    usable = usable_views(replace(scene, keypoints=keypoints))
    assert np.flatnonzero(~usable).tolist() == [2, 7]
