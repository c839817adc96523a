"""Captures of bare points and what may happen to captures."""

import numpy as np
import pytest
import torch

from kronc_ns.errors import KroncError
from kronc_ns.geometry.camera import project
from kronc_ns.geometry.poses import invert, transform
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.synthetic.car import CarShape, build_car
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.hull import hull_visibility
from kronc_ns.synthetic.render import keypoint_visibility
from kronc_ns.synthetic.scenes import Capture, default_camera, make_capture, observe, walk_poses
from kronc_ns.synthetic.variations import empty_views, limit_points, on_wheels, reorder, reverse, shuffle, swap_sides

FLIP = torch.tensor(APOLLOCAR3D_66.flip)


@pytest.fixture(scope="module")
def capture() -> Capture:
    return make_capture("walk", views=20, seed=3, noise_px=1.0, outliers=0.2)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_wild_detections_are_those_that_lie_about_their_point(capture):
    exact = project(transform(invert(capture.c2w), capture.points.expand(20, -1, -1)), capture.camera)
    error = (capture.keypoints[..., :2] - exact).norm(dim=-1)
    seen = capture.keypoints[..., 2] > 0
    assert error[seen & ~capture.wild].max() < 5
    assert error[capture.wild].median() > 20
    assert not (capture.wild & ~seen).any()
    assert 0.15 < float(capture.wild.sum() / seen.sum()) < 0.25


def test_a_cube_shows_the_corners_of_the_sides_that_face_the_camera():
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    seen = hull_visibility(corners, np.array([[5.0, 0, 0], [4, 4, 4]]))
    np.testing.assert_array_equal(seen[0], corners[:, 0] > 0)
    np.testing.assert_array_equal(seen[1], corners.sum(1) > -3)


def test_the_hull_sees_about_what_rays_see():
    car = build_car(CarShape())
    centres = walk_poses(60, rng())[..., 3].numpy()
    by_hull, by_rays = hull_visibility(car.keypoints, centres), keypoint_visibility(car.mesh, car.keypoints, centres)
    assert (by_hull == by_rays).mean() > 0.9
    assert by_hull.sum(1).mean() == pytest.approx(by_rays.sum(1).mean(), rel=0.05)


def test_bare_points_can_be_captured_but_not_drawn(tmp_path):
    points = on_wheels(torch.from_numpy(build_car(CarShape()).keypoints) + torch.tensor([1.0, 2.0, 3.0]))
    torch.testing.assert_close(points, torch.from_numpy(build_car(CarShape()).keypoints), atol=0.05, rtol=0)
    capture = observe(points, walk_poses(6, rng()), default_camera("walk"), rng())
    exact = project(transform(invert(capture.c2w), points.expand(6, -1, -1)), capture.camera)
    seen = capture.keypoints[..., 2] > 0
    assert (seen.sum(1) > 10).all()
    torch.testing.assert_close(capture.keypoints[..., :2][seen], exact[seen])
    with pytest.raises(KroncError, match="without images"):
        write_capture(tmp_path / "drawn", capture, render=True)
    write_capture(tmp_path / "written", capture)


def test_views_keep_their_detections_in_another_order(capture):
    assert reverse(reverse(capture)).c2w.equal(capture.c2w)
    assert reverse(capture).keypoints[0].equal(capture.keypoints[-1])
    mixed = shuffle(capture, rng())
    order = (mixed.c2w[:, None] == capture.c2w).all(-1).all(-1).double().argmax(1)
    assert sorted(order.tolist()) == list(range(20))
    assert order.tolist() != list(range(20))
    again = reorder(mixed, order.argsort())
    assert again.keypoints.equal(capture.keypoints)
    assert again.wild.equal(capture.wild)


def test_sides_are_swapped_in_the_views_that_are_named(capture):
    swapped, chosen = swap_sides(capture, 0.1, rng())
    assert int(chosen.sum()) == 2
    assert swapped.keypoints[~chosen].equal(capture.keypoints[~chosen])
    assert swapped.keypoints[chosen].equal(capture.keypoints[chosen][:, FLIP])
    back = swap_sides(swapped, 0.1, rng())[0]
    assert back.keypoints.equal(capture.keypoints)
    assert back.wild.equal(capture.wild)


def test_detections_are_taken_out(capture):
    emptied, chosen = empty_views(capture, 0.2, rng())
    assert int(chosen.sum()) == 4
    assert (emptied.keypoints[chosen] == 0).all()
    assert emptied.keypoints[~chosen].equal(capture.keypoints[~chosen])
    few = limit_points(capture, 12, rng())
    seen, left = capture.keypoints[..., 2] > 0, few.keypoints[..., 2] > 0
    assert left.sum(1).equal(seen.sum(1).clamp_max(12))
    assert few.keypoints[left].equal(capture.keypoints[left])
    assert not (few.wild & ~left).any()


def test_walks_have_a_length_and_a_sense():
    def turned(**options) -> float:
        centres = walk_poses(200, rng(), **options)[..., 3].numpy()
        angle = np.unwrap(np.arctan2(centres[:, 1], centres[:, 0]))
        return float(angle[-1] - angle[0]) / (2 * np.pi)

    assert turned() == pytest.approx(1.0, abs=0.1)
    assert turned(clockwise=True) == pytest.approx(-1.0, abs=0.1)
    assert turned(laps=0.5) == pytest.approx(0.5, abs=0.1)
    assert turned(laps=1.5) == pytest.approx(1.5, abs=0.1)
