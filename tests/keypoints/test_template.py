import json
from dataclasses import astuple, fields, replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from kronc_ns.geometry.alignment import umeyama
from kronc_ns.keypoints.schema import APOLLOCAR3D_66, KeypointSchema
from kronc_ns.keypoints.template import (
    DEVIATIONS,
    PUBLISHED_MM,
    CarDimensions,
    CarTemplate,
    car_template,
    dimension_covariance,
    keypoints_of,
)
from tests.conftest import SHARED_DATA

MIRROR = np.array([1.0, -1.0, 1.0])
FLIP = list(APOLLOCAR3D_66.flip)


@pytest.fixture(scope="module")
def template() -> CarTemplate:
    made = car_template(APOLLOCAR3D_66)
    assert made is not None
    return made


def subset(indices: list[int], flip: tuple[int, ...] | None = None) -> KeypointSchema:
    """A schema of some of the 66 points, in the order given."""
    partners = tuple(indices.index(FLIP[j]) if FLIP[j] in indices else i for i, j in enumerate(indices))
    return KeypointSchema("part", tuple(APOLLOCAR3D_66.keypoints[j] for j in indices), flip or partners)


def drawn_cars(count: int, seed: int) -> list[CarDimensions]:
    """Cars whose dimensions follow the prior."""
    noise = np.random.default_rng(seed).normal(size=(count, len(fields(CarDimensions))))
    rows = np.array(astuple(CarDimensions())) + noise @ np.linalg.cholesky(dimension_covariance()).T
    return [CarDimensions(*row) for row in rows.tolist()]


@pytest.mark.parametrize("car", [CarDimensions(), *drawn_cars(5, seed=1)])
def test_points_are_exactly_mirror_symmetric(car):
    points = keypoints_of(car)
    assert np.isfinite(points).all()
    assert_array_equal(points[FLIP] * MIRROR, points)
    assert (points[list(APOLLOCAR3D_66.left), 1] > 0).all()


@pytest.mark.parametrize("car", [CarDimensions(), *drawn_cars(5, seed=2)])
def test_points_lie_within_the_box_of_the_dimensions(car):
    points = keypoints_of(car)
    low, high = points.min(0), points.max(0)
    assert -0.2 < car.length / 2 + low[0] - 0.1 < 0.2
    assert -0.2 < car.length / 2 - high[0] - 0.1 < 0.2
    assert high[1] <= car.width / 2
    assert low[2] > 0.1
    assert high[2] < car.height


def test_wheel_centres_have_the_wheelbase_and_radius():
    car = CarDimensions()
    left_front, right_front, left_rear, right_rear = keypoints_of(car)[list(APOLLOCAR3D_66.wheels)]
    assert (left_front - left_rear).tolist() == pytest.approx([car.wheelbase, 0, 0])
    assert (right_front - right_rear).tolist() == pytest.approx([car.wheelbase, 0, 0])
    assert left_front[2] == pytest.approx(car.wheel_radius)


def test_defaults_and_deviations_of_the_published_dimensions_come_from_the_table():
    published = np.array(list(PUBLISHED_MM.values())) / 1000
    assert_allclose(astuple(CarDimensions())[:4], published.mean(0), atol=1e-3, rtol=0)
    assert_allclose(astuple(DEVIATIONS)[:4], published.std(0, ddof=1), atol=1e-3, rtol=0)


@pytest.mark.parametrize("name", PUBLISHED_MM)
def test_published_cars_are_plausible_under_the_prior(name):
    offset = np.array(PUBLISHED_MM[name]) / 1000 - astuple(CarDimensions())[:4]
    covariance = dimension_covariance()[:4, :4]
    assert (np.abs(offset) <= 2.5 * np.sqrt(covariance.diagonal())).all()
    # 99.9% of a chi-squared distribution with four degrees of freedom
    assert offset @ np.linalg.solve(covariance, offset) < 18.5


def test_basis_is_the_derivative_of_the_points(template):
    factor = np.linalg.cholesky(dimension_covariance())
    at = np.array(astuple(CarDimensions()))
    for k, direction in enumerate(factor.T):
        remainders = []
        for step in (0.02, 0.01):
            moved = keypoints_of(CarDimensions(*(at + step * direction).tolist()))
            remainders.append(np.abs(moved - template.mean - step * template.basis[k]).max())
        # What a derivative leaves is of second order in the step.
        assert remainders[0] < 1e-4
        assert remainders[1] < 0.3 * remainders[0] + 1e-10


def test_basis_and_length_basis_reproduce_the_covariance_of_the_dimensions(template):
    axles = template.basis[:, 7, 0] - template.basis[:, 20, 0]
    covariance = dimension_covariance()
    assert axles @ axles == pytest.approx(covariance[3, 3])
    assert template.length_basis @ axles == pytest.approx(covariance[0, 3])
    assert np.square(template.length_basis).sum() == pytest.approx(covariance[0, 0])


def test_covariance_is_symmetric_positive_definite_and_precision_its_inverse(template):
    covariance, precision = template.covariance(), template.precision()
    assert_allclose(covariance, covariance.T, atol=1e-12)
    smallest = np.linalg.eigvalsh(covariance)[0]
    assert smallest == pytest.approx(2 * min(template.sigma_symmetric_m, template.sigma_asymmetric_m) ** 2)
    assert_allclose(precision @ covariance, np.eye(len(covariance)), atol=1e-9)
    assert template.covariance() is covariance
    assert template.precision() is precision


def test_covariance_commutes_with_mirroring(template):
    covariance = template.covariance().reshape(66, 3, 66, 3)
    mirrored = covariance[FLIP][:, :, FLIP] * MIRROR[:, None, None] * MIRROR
    assert_allclose(mirrored, covariance, atol=1e-12)


def test_covariance_is_that_of_cars_drawn_from_the_model(template):
    count, rng = 40_000, np.random.default_rng(3)
    noise = lambda axes: rng.normal(size=(count, axes))  # noqa: E731
    cars = np.tensordot(noise(len(template.basis)), template.basis, axes=1)
    for left, right in APOLLOCAR3D_66.mirror_pairs:
        shared, differing = template.sigma_symmetric_m * noise(3), template.sigma_asymmetric_m * noise(3)
        cars[:, left] += shared + differing
        cars[:, right] += (shared - differing) * MIRROR
    covariance = template.covariance()
    deviation = np.sqrt(covariance.diagonal())
    error = (np.cov(cars.reshape(count, -1).T) - covariance) / (deviation[:, None] * deviation)
    # An entry of a sample correlation has a deviation of at most sqrt(2 / count); six of them for 20,000 entries.
    assert np.abs(error).max() < 6 * (2 / count) ** 0.5


def test_sides_differ_and_agree_by_the_two_deviations(template):
    left, right = 3 * 13 + 1, 3 * 44 + 1
    own = template.basis.reshape(len(template.basis), -1)[:, [left, right]]
    residual = template.covariance()[[left, right]][:, [left, right]] - own.T @ own
    widening, shift = np.array([0.5, -0.5]), np.array([0.5, 0.5])
    assert widening @ residual @ widening == pytest.approx(template.sigma_symmetric_m**2)
    assert shift @ residual @ shift == pytest.approx(template.sigma_asymmetric_m**2)


def test_normals_are_unit_mirrored_and_point_outward(template):
    assert_allclose(np.linalg.norm(template.normals, axis=1), np.ones(66))
    assert_array_equal(template.normals[FLIP] * MIRROR, template.normals)
    for car in (template.mean, *map(keypoints_of, drawn_cars(5, seed=4))):
        assert ((car - [0.0, 0.0, 0.75]) * template.normals).sum(1).min() > 0


@pytest.mark.parametrize(("missing", "rms_m"), [(0, 0.015), (33, 0.02), (50, 0.035)])
def test_length_is_recovered_though_points_are_missing(template, missing, rms_m):
    """Over two draws of 2,000 cars the last is 0.0317 and 0.0330 m; of 400 it is known to 4 %."""
    rng = np.random.default_rng(5)
    errors = []
    for car in drawn_cars(400, seed=6):
        points = keypoints_of(car)
        points[rng.permutation(66)[:missing]] = np.nan
        errors.append(template.length_m(points) - car.length)
    assert np.sqrt(np.square(errors).mean()) < rms_m


def test_length_of_typical_cars():
    template = car_template(APOLLOCAR3D_66)
    assert template is not None
    golf = CarDimensions(length=4.284, width=1.789, height=1.491, wheelbase=2.636, tail_run=0.6)
    camry = CarDimensions(length=4.885, width=1.840, height=1.445, wheelbase=2.825, tail_run=1.3)
    for car in (golf, camry, replace(golf, front_share=0.53), replace(camry, nose_sweep=0.40)):
        assert template.length_m(keypoints_of(car)) == pytest.approx(car.length, abs=0.02)


def test_length_of_the_unknown_car_is_the_average(template):
    assert template.length_m(np.full((66, 3), np.nan)) == pytest.approx(CarDimensions().length)
    assert template.length_m(template.mean) == pytest.approx(CarDimensions().length)


def test_length_does_not_depend_on_where_the_origin_is(template):
    points = keypoints_of(CarDimensions(length=4.7, wheelbase=2.8))
    moved = points + np.array([0.3, -0.2, 0.4])
    assert template.length_m(moved) == pytest.approx(template.length_m(points), abs=0.005)


def test_a_schema_of_some_of_the_points_takes_them_in_its_order(template):
    indices = [20, 37, 7, 50, 62, 63, 11]
    part = car_template(subset(indices))
    assert part is not None
    assert_array_equal(part.mean, template.mean[indices])
    assert_array_equal(part.basis, template.basis[:, indices])
    assert_array_equal(part.normals, template.normals[indices])
    assert part.flip == (1, 0, 3, 2, 5, 4, 6)
    rows = [3 * j + axis for j in indices for axis in range(3)]
    assert_allclose(part.covariance(), template.covariance()[rows][:, rows], atol=1e-12)


def test_the_template_of_a_schema_is_made_once():
    assert car_template(APOLLOCAR3D_66) is car_template(APOLLOCAR3D_66)


@pytest.mark.parametrize(
    "schema",
    [
        KeypointSchema("cube", ("a", "b", "c", "d"), (0, 1, 2, 3)),
        KeypointSchema("other", (*APOLLOCAR3D_66.keypoints, "spoiler"), (*APOLLOCAR3D_66.flip, 66)),
        subset([7, 50, 20, 37], flip=(2, 3, 0, 1)),
    ],
    ids=["unknown", "one unknown point", "pairs front and rear"],
)
def test_no_template_for_other_schemas(schema):
    assert car_template(schema) is None


def shape_distances(template: CarTemplate, points: np.ndarray) -> tuple[float, float]:
    """RMS distance of a car, aligned by a similarity, to the mean and to the best car of the model, metres."""

    def rms(car: np.ndarray) -> float:
        return float(np.sqrt(np.square(umeyama(points, car).apply(points) - car).sum(1).mean()))

    basis = template.basis.reshape(len(template.basis), -1)
    ridge = basis @ basis.T + 0.05**2 * np.eye(len(basis))
    car = template.mean
    for _ in range(20):
        offset = umeyama(points, car).apply(points) - template.mean
        coefficients = np.linalg.solve(ridge, basis @ offset.ravel())
        car = template.mean + np.tensordot(coefficients, template.basis, axes=1)
    return rms(template.mean), rms(car)


def test_labelled_cars_are_near_the_template(template):
    path = SHARED_DATA / "cars79_keypoints3d.json"
    if not path.is_file():
        pytest.skip(f"the labelled shapes are not beside the project ({path})")
    cars = json.loads(path.read_text())["cars"][:40]
    distances = [shape_distances(template, np.array(car["keypoints"])) for car in cars]
    to_mean, to_model = np.sqrt(np.square(distances).mean(0))
    assert to_mean < 0.16
    assert to_model < 0.08
