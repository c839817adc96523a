"""The ray caster: visibility, depth, masks, backgrounds."""

from __future__ import annotations

import time
from dataclasses import replace

import cv2
import numpy as np
import pytest

from kronc_ns.geometry.camera import Camera
from kronc_ns.synthetic.car import CarModel, build_car
from kronc_ns.synthetic.car_parts import CarShape
from kronc_ns.synthetic.render import Rendering, keypoint_visibility, render_view, trace_mask_and_depth
from kronc_ns.synthetic.scenes import default_camera, make_capture
from kronc_ns.synthetic.surroundings import ground_levels, wall_levels

SIZE, FOCAL = 96, 82.0
REAR, FRONT = [22, 23, 25, 26, 31, 32, 34, 35], [0, 1, 2, 3, 54, 55, 56, 57]


def ring_pose(azimuth_deg: float, radius_m: float = 4.5, height_m: float = 1.5) -> np.ndarray:
    """c2w [3,4] of a camera on a circle around the car, looking at (0, 0, 0.6)."""
    azimuth = np.radians(azimuth_deg)
    eye = np.array([radius_m * np.cos(azimuth), radius_m * np.sin(azimuth), height_m])
    forward = np.array([0, 0, 0.6]) - eye
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(forward, right), forward, eye])


def view(car: CarModel, c2w: np.ndarray, *, ground: bool, samples: int = 2) -> Rendering:
    return render_view(car, c2w, Camera(FOCAL, FOCAL, SIZE / 2, SIZE / 2, SIZE, SIZE), ground=ground, samples=samples)


@pytest.fixture(scope="module")
def car() -> CarModel:
    return build_car(CarShape())


def test_visibility_follows_the_side_of_the_car(car: CarModel) -> None:
    centres = np.stack([ring_pose(a)[:, 3] for a in (0, 90, 180, 270)])
    front, left, rear, right = keypoint_visibility(car.mesh, car.keypoints, centres)
    assert not front[REAR].any()
    assert front[FRONT].all()
    assert not rear[FRONT].any()
    assert rear[REAR].all()
    assert not left[[39, 40, 43, 44]].any()
    assert left[[13, 14, 17, 18, 7, 20]].all()
    assert not right[[13, 14, 17, 18]].any()
    assert right[[39, 40, 43, 44, 37, 50]].all()


@pytest.mark.parametrize("radius_m", [4.0, 5.0])
def test_visible_keypoints_per_view_are_plausible(car: CarModel, radius_m: float) -> None:
    centres = np.stack([ring_pose(a, radius_m)[:, 3] for a in np.arange(0, 360, 10)])
    count = keypoint_visibility(car.mesh, car.keypoints, centres).sum(1)
    assert count.min() >= 15
    assert count.max() <= 45


def test_points_inside_the_car_are_hidden(car: CarModel) -> None:
    centres = np.stack([ring_pose(a)[:, 3] for a in np.arange(0, 360, 30)])
    assert not keypoint_visibility(car.mesh, np.array([[0.0, 0, 0.6], [1.2, 0.3, 0.5]]), centres).any()


def test_visibility_of_a_hundred_views_takes_less_than_a_second(car: CarModel) -> None:
    centres = np.stack([ring_pose(a)[:, 3] for a in np.linspace(0, 360, 100)])
    start = time.perf_counter()
    visible = keypoint_visibility(car.mesh, car.keypoints, centres)
    assert visible.shape == (100, 66)
    assert time.perf_counter() - start < 1.0


@pytest.mark.parametrize("azimuth_deg", [30, 160])
def test_depth_is_z_of_the_visible_keypoints(car: CarModel, azimuth_deg: float) -> None:
    c2w = ring_pose(azimuth_deg)
    focal, size = 500.0, 600
    rendering = render_view(car, c2w, Camera(focal, focal, size / 2, size / 2, size, size), ground=False, samples=1)
    visible = keypoint_visibility(car.mesh, car.keypoints, c2w[None, :, 3])[0]
    local = (car.keypoints[visible] - c2w[:, 3]) @ c2w[:, :3]
    column, row = np.floor(local[:, :2] / local[:, 2:] * focal + size / 2).astype(int).T
    error = np.abs(rendering.depth[row, column] - local[:, 2])
    assert (error < 0.02).mean() > 0.75
    assert np.median(error) < 0.01


def test_ground_depth_is_that_of_the_plane(car: CarModel) -> None:
    c2w = ring_pose(70)
    rendering = view(car, c2w, ground=True)
    row, column = SIZE - 3, 20
    assert rendering.mask[row, column] == 0
    local = np.array([(column + 0.5 - SIZE / 2) / FOCAL, (row + 0.5 - SIZE / 2) / FOCAL, 1.0])
    point = c2w[:, 3] + rendering.depth[row, column] * (c2w[:, :3] @ local)
    assert abs(point[2]) < 1e-4


def test_mask_is_where_depth_is_on_the_bare_car(car: CarModel) -> None:
    rendering = view(car, ring_pose(40), ground=False)
    assert rendering.rgba.dtype == rendering.mask.dtype == np.uint8
    assert rendering.depth.dtype == np.float32
    np.testing.assert_array_equal(rendering.mask == 255, rendering.depth > 0)
    assert 0.1 < (rendering.mask > 0).mean() < 0.6
    alpha = rendering.rgba[..., 3]
    assert (alpha[rendering.mask == 0] < 255).all()
    assert (alpha[rendering.mask > 0] > 0).all()
    assert ((alpha > 0) & (alpha < 255)).any()
    np.testing.assert_array_equal(view(car, ring_pose(40), ground=True).mask, rendering.mask)


def test_head_on_view_is_mirror_symmetric_about_the_principal_point(car: CarModel) -> None:
    rendering = view(car, ring_pose(0), ground=False)
    assert (rendering.mask != rendering.mask[:, ::-1]).mean() < 1e-3
    difference = np.abs(rendering.depth - rendering.depth[:, ::-1])[rendering.mask > 0]
    assert np.median(difference) < 1e-4


def test_background_is_opaque_textured_and_leaves_the_car_alone(car: CarModel) -> None:
    bare, full = (view(car, ring_pose(130), ground=g) for g in (False, True))
    assert (full.rgba[..., 3] == 255).all()
    solid = bare.rgba[..., 3] == 255
    np.testing.assert_array_equal(full.rgba[solid], bare.rgba[solid])
    floor = full.rgba[-20:, :, :3][full.mask[-20:] == 0].astype(float)
    assert floor.std(0).min() > 4
    assert (bare.rgba[bare.rgba[..., 3] == 0] == 0).all()


def test_left_and_right_sides_look_different(car: CarModel) -> None:
    left, right = (view(car, ring_pose(a), ground=False) for a in (90, -90))
    mirrored = right.rgba[:, ::-1]
    both = (left.rgba[..., 3] == 255) & (mirrored[..., 3] == 255)
    assert np.abs(left.rgba[both].astype(int) - mirrored[both].astype(int))[:, :3].max() > 80


def test_a_rebuilt_car_differs_only_in_its_paint(car: CarModel) -> None:
    pictures = [view(c, ring_pose(60), ground=False) for c in (build_car(paint_rgb=(180, 30, 30)), car, car)]
    red, blue, again = (p.rgba[p.rgba[..., 3] == 255][:, :3].astype(float) for p in pictures)
    assert red.mean(0)[0] > red.mean(0)[2] + 20
    assert blue.mean(0)[2] > blue.mean(0)[0] + 20
    np.testing.assert_array_equal(blue, again)
    np.testing.assert_array_equal(pictures[0].depth, pictures[1].depth)


def test_background_is_deterministic(car: CarModel) -> None:
    first = view(car, ring_pose(200), ground=True)
    ground_levels.cache_clear()
    wall_levels.cache_clear()
    np.testing.assert_array_equal(first.rgba, view(car, ring_pose(200), ground=True).rgba)


def test_supersampling_converges(car: CarModel) -> None:
    rough, fine, finest = (view(car, ring_pose(15), ground=True, samples=n).rgba.astype(float) for n in (1, 2, 4))
    assert np.abs(fine - finest).mean() < 0.75 * np.abs(rough - finest).mean()


def test_principal_point_shifts_the_image(car: CarModel) -> None:
    c2w = ring_pose(50)
    centred = view(car, c2w, ground=True)
    moved = render_view(car, c2w, Camera(FOCAL, FOCAL, SIZE / 2 - 10, SIZE / 2 + 4, SIZE, SIZE), ground=True)
    np.testing.assert_array_equal(moved.rgba[4:, :-10], centred.rgba[:-4, 10:])


@pytest.mark.parametrize("lens", [(-0.35, 0.12), (0.6, 0.3)])
def test_a_lens_bends_the_image_as_it_does_the_keypoints(lens: tuple[float, float]) -> None:
    camera = replace(default_camera("carpatch", 160), k1=lens[0], k2=lens[1])
    capture = make_capture("carpatch", 6, seed=5, camera=camera)
    assert isinstance(capture.car, CarModel)
    for c2w, keypoints in zip(capture.c2w, capture.keypoints, strict=True):
        mask, _ = trace_mask_and_depth(capture.car.mesh, c2w, camera, ground=False)
        near = cv2.dilate(mask, np.ones((3, 3), np.uint8))
        seen = keypoints[:, 2] > 0
        u, v = np.floor(keypoints[seen, :2]).astype(int).T
        assert (near[v, u] > 0).all()
