"""Where a solved car stands: its own axes, metres, on the ground."""

import math

import pytest
import torch
from torch import Tensor

from kronc_ns.fit.car_frame import rough_frame, standing, template_frame
from kronc_ns.fit.starts import circular_poses
from kronc_ns.geometry.alignment import Similarity
from kronc_ns.geometry.rotations import rotation_angle_deg, so3_exp
from kronc_ns.keypoints.schema import APOLLOCAR3D_66, KeypointSchema
from kronc_ns.keypoints.template import CarDimensions, car_template, keypoints_of
from kronc_ns.synthetic.car import CarShape, build_car
from tests.solve.problems import SIMILARITY, randn

TEMPLATE = car_template(APOLLOCAR3D_66)
assert TEMPLATE is not None
FRAMES = {"rough": rough_frame, "template": template_frame}


def inverse(similarity: Similarity) -> Similarity:
    rotation, scale = similarity.rotation.T, 1 / similarity.scale
    return Similarity(scale, rotation, -scale * rotation @ similarity.translation)


def assert_identity(similarity: Similarity, degrees: float, share: float, metres: float) -> None:
    assert rotation_angle_deg(similarity.rotation) < degrees
    assert float(similarity.scale) == pytest.approx(1.0, abs=share)
    assert similarity.translation.norm() < metres


@pytest.mark.parametrize("name", FRAMES)
def test_the_average_car_is_put_where_it_stands(name):
    found = FRAMES[name](SIMILARITY.apply(TEMPLATE.mean), TEMPLATE)
    torch.testing.assert_close(found.apply(SIMILARITY.apply(TEMPLATE.mean)), TEMPLATE.mean, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", FRAMES)
def test_it_does_not_matter_where_the_points_were_before(name):
    points = torch.from_numpy(build_car(CarShape()).keypoints)
    here, there = (FRAMES[name](world.apply(points), TEMPLATE) for world in (inverse(SIMILARITY), SIMILARITY))
    torch.testing.assert_close(
        here.apply(inverse(SIMILARITY).apply(points)), there.apply(SIMILARITY.apply(points)), rtol=0, atol=1e-6
    )


CARS = {
    "city": CarDimensions(length=3.6, width=1.65, height=1.49, wheelbase=2.35),
    "saloon": CarDimensions(length=4.88, width=1.87, height=1.43, wheelbase=2.87, tail_run=1.3),
    "suv": CarDimensions(length=4.7, width=1.9, height=1.72, wheelbase=2.8, sill_height=0.38),
}


@pytest.mark.parametrize("car", CARS)
def test_other_cars_stand_on_the_ground_too_about_as_large_as_they_are(car):
    points = keypoints_of(CARS[car])
    found = template_frame(SIMILARITY.apply(points), TEMPLATE)
    there = found.apply(SIMILARITY.apply(points))
    wheels = there[list(APOLLOCAR3D_66.wheels)]
    assert (wheels[:, 2] - 0.325).abs().max() < 0.05
    assert (there[:, 1] + there[list(APOLLOCAR3D_66.flip), 1]).abs().max() < 1e-3, "left and right of y = 0"
    left_front, _, left_rear, _ = wheels
    assert left_front[0] > left_rear[0]
    size = torch.linalg.vector_norm(there.amax(0) - there.amin(0)) / torch.linalg.vector_norm(
        points.amax(0) - points.amin(0)
    )
    assert float(size) == pytest.approx(1.0, abs=0.12)


def test_the_likely_frame_of_an_odd_car_is_better_than_the_rough_one():
    """Only as far as the template knows cars: the Mahalanobis distance of the carried points is least."""
    points = SIMILARITY.apply(keypoints_of(CARS["suv"]) + 0.02 * randn(66, 3))

    def distance(similarity: Similarity) -> float:
        offset = (similarity.apply(points) - TEMPLATE.mean).flatten()
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
    points = SIMILARITY.apply(TEMPLATE.mean)
    points[::2] = math.nan
    found = FRAMES[name](points, TEMPLATE)
    torch.testing.assert_close(found.apply(points)[1::2], TEMPLATE.mean[1::2], rtol=0, atol=1e-9)


def test_points_that_are_far_off_hardly_turn_it():
    points = TEMPLATE.mean.clone()
    points[[3, 20, 44]] += torch.tensor([3.0, -4.0, 2.0], dtype=torch.float64)
    assert_identity(rough_frame(points, TEMPLATE), 5.0, 0.1, 0.3)


def object_points(count: int = 12) -> Tensor:
    return randn(count, 3) * torch.tensor([2.0, 1.0, 0.5], dtype=torch.float64)


PLAIN = KeypointSchema("thing", tuple(f"point {j}" for j in range(12)), tuple(range(12)))


def test_an_unknown_object_is_upright_centred_and_at_the_radius():
    points, c2w = SIMILARITY.apply(object_points()), SIMILARITY.apply_to_poses(circular_poses(16, 6.0))
    placed = standing(PLAIN, points, c2w, 5.0)
    there, cameras = placed.apply(points), placed.apply_to_poses(c2w)
    torch.testing.assert_close(there.amin(0), -there.amax(0), rtol=0, atol=1e-9)
    assert float(cameras[..., 3].norm(dim=-1).mean()) == pytest.approx(5.0)
    torch.testing.assert_close(
        cameras[..., 1], torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand(16, 3), rtol=0, atol=1e-9
    )


def test_an_unknown_objects_unknown_points_are_left_out():
    points, c2w = object_points(), circular_poses(16, 6.0)
    points[4] = math.nan
    placed = standing(PLAIN, points, c2w, 5.0)
    assert placed.rotation.isfinite().all()
    assert placed.translation.isfinite().all()
    assert placed.scale > 0
