"""Where a solved car stands: its own axes, metres, on the ground."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from kronc_ns.fit.car_frame import car_axes, rough_frame, standing, template_frame
from kronc_ns.fit.starts import circular_poses
from kronc_ns.geometry.alignment import Similarity
from kronc_ns.geometry.rotations import rotation_angle_deg, so3_exp
from kronc_ns.keypoints.schema import APOLLOCAR3D_66, KeypointSchema
from kronc_ns.keypoints.template import CarDimensions, CarTemplate, car_template, keypoints_of
from kronc_ns.synthetic.car import CarShape, build_car


def the_template() -> CarTemplate:
    template = car_template(APOLLOCAR3D_66)
    assert template is not None
    return template


TEMPLATE = the_template()
FRAMES = {"rough": rough_frame, "template": template_frame}
WORLD = Similarity(1.7, so3_exp(np.array([0.4, -1.1, 0.7])), np.array([0.5, -2.0, 3.0]))


def randn(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=shape)


def inverse(similarity: Similarity) -> Similarity:
    rotation, scale = similarity.rotation.T, 1 / similarity.scale
    return Similarity(scale, rotation, -scale * rotation @ similarity.translation)


def assert_identity(similarity: Similarity, degrees: float, share: float, metres: float) -> None:
    assert rotation_angle_deg(similarity.rotation) < degrees
    assert similarity.scale == pytest.approx(1.0, abs=share)
    assert np.linalg.norm(similarity.translation) < metres


@pytest.mark.parametrize("name", FRAMES)
def test_the_average_car_is_put_where_it_stands(name):
    found = FRAMES[name](WORLD.apply(TEMPLATE.mean), TEMPLATE)
    assert_allclose(found.apply(WORLD.apply(TEMPLATE.mean)), TEMPLATE.mean, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", FRAMES)
def test_it_does_not_matter_where_the_points_were_before(name):
    points = build_car(CarShape()).keypoints
    worlds = (inverse(WORLD), WORLD)
    here, there = (FRAMES[name](world.apply(points), TEMPLATE).apply(world.apply(points)) for world in worlds)
    assert_allclose(here, there, rtol=0, atol=1e-6)


CARS = {
    "city": CarDimensions(length=3.6, width=1.65, height=1.49, wheelbase=2.35),
    "saloon": CarDimensions(length=4.88, width=1.87, height=1.43, wheelbase=2.87, tail_run=1.3),
    "suv": CarDimensions(length=4.7, width=1.9, height=1.72, wheelbase=2.8, sill_height=0.38),
}


@pytest.mark.parametrize("car", CARS)
def test_other_cars_stand_on_the_ground_too_about_as_large_as_they_are(car):
    points = keypoints_of(CARS[car])
    there = template_frame(WORLD.apply(points), TEMPLATE).apply(WORLD.apply(points))
    wheels = there[list(APOLLOCAR3D_66.wheels)]
    assert_allclose(wheels[:, 2], 0.325, rtol=0, atol=0.05)
    assert_allclose(there[:, 1], -there[list(APOLLOCAR3D_66.flip), 1], rtol=0, atol=1e-3, err_msg="sides of y = 0")
    left_front, _, left_rear, _ = wheels
    assert left_front[0] > left_rear[0]
    size, true_size = (np.linalg.norm(np.ptp(cloud, axis=0)) for cloud in (there, points))
    assert size / true_size == pytest.approx(1.0, abs=0.12)


def test_the_likely_frame_of_an_odd_car_is_better_than_the_rough_one():
    """Only as far as the template knows cars: the Mahalanobis distance of the carried points is least."""
    points = WORLD.apply(keypoints_of(CARS["suv"]) + 0.02 * randn(66, 3))

    def distance(similarity: Similarity) -> float:
        offset = (similarity.apply(points) - TEMPLATE.mean).ravel()
        return float(offset @ TEMPLATE.precision() @ offset)

    found = template_frame(points, TEMPLATE)
    best = distance(found)
    assert best < distance(rough_frame(points, TEMPLATE))
    for step in 1e-3 * randn(20, 7):
        turned = so3_exp(step[:3])
        nearby = Similarity(found.scale * (1 + step[3]), turned @ found.rotation, turned @ found.translation + step[4:])
        assert best <= distance(nearby)


@pytest.mark.parametrize("name", FRAMES)
def test_unknown_points_are_left_out(name):
    points = WORLD.apply(TEMPLATE.mean)
    points[::2] = math.nan
    found = FRAMES[name](points, TEMPLATE)
    assert_allclose(found.apply(points)[1::2], TEMPLATE.mean[1::2], rtol=0, atol=1e-9)


def test_points_that_are_far_off_hardly_turn_it():
    points = TEMPLATE.mean.copy()
    points[[3, 20, 44]] += [3.0, -4.0, 2.0]
    assert_identity(rough_frame(points, TEMPLATE), 5.0, 0.1, 0.3)


def object_points(count: int = 12) -> np.ndarray:
    return randn(count, 3) * [2.0, 1.0, 0.5]


PLAIN = KeypointSchema("thing", tuple(f"point {j}" for j in range(12)), tuple(range(12)))


def test_an_unknown_object_is_upright_centred_and_at_the_radius():
    points, c2w = WORLD.apply(object_points()), WORLD.apply_to_poses(circular_poses(16, 6.0))
    placed = standing(PLAIN, points, c2w, 5.0)
    there, cameras = placed.apply(points), placed.apply_to_poses(c2w)
    assert_allclose(there.min(0), -there.max(0), rtol=0, atol=1e-9)
    assert np.linalg.norm(cameras[..., 3], axis=-1).mean() == pytest.approx(5.0)
    assert_allclose(cameras[..., 1], np.tile([0.0, 0.0, -1.0], (16, 1)), rtol=0, atol=1e-9)


def test_an_unknown_objects_unknown_points_are_left_out():
    points, c2w = object_points(), circular_poses(16, 6.0)
    points[4] = math.nan
    placed = standing(PLAIN, points, c2w, 5.0)
    assert np.isfinite(placed.rotation).all()
    assert np.isfinite(placed.translation).all()
    assert placed.scale > 0


def test_car_axes_follow_the_car():
    points = build_car(CarShape()).keypoints
    rotation = so3_exp(np.array([0.4, -0.8, 1.9]))
    turned = points @ rotation.T
    turned[[1, 7, 30]] = math.nan
    axes = car_axes(APOLLOCAR3D_66, turned, rotation @ np.array([0.1, 0.0, 1.0]))
    assert_allclose(axes @ rotation, np.eye(3), rtol=0, atol=1e-3)
