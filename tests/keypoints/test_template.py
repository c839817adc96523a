import json
from dataclasses import astuple, fields, replace

import pytest
import torch

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

MIRROR = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
FLIP = list(APOLLOCAR3D_66.flip)
NAN = float("nan")


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
    noise = torch.randn(count, len(fields(CarDimensions)), generator=torch.Generator().manual_seed(seed)).double()
    at = torch.tensor(astuple(CarDimensions()), dtype=torch.float64)
    return [CarDimensions(*row) for row in (at + noise @ torch.linalg.cholesky(dimension_covariance()).T).tolist()]


@pytest.mark.parametrize("car", [CarDimensions(), *drawn_cars(5, seed=1)])
def test_points_are_exactly_mirror_symmetric(car):
    points = keypoints_of(car)
    assert points.isfinite().all()
    assert torch.equal(points[FLIP] * MIRROR, points)
    assert (points[list(APOLLOCAR3D_66.left), 1] > 0).all()


@pytest.mark.parametrize("car", [CarDimensions(), *drawn_cars(5, seed=2)])
def test_points_lie_within_the_box_of_the_dimensions(car):
    points = keypoints_of(car)
    low, high = points.amin(0), points.amax(0)
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
    assert left_front[2].item() == pytest.approx(car.wheel_radius)


def test_defaults_and_deviations_of_the_published_dimensions_come_from_the_table():
    published = torch.tensor(list(PUBLISHED_MM.values()), dtype=torch.float64) / 1000
    torch.testing.assert_close(
        torch.tensor(astuple(CarDimensions())[:4]).double(), published.mean(0), atol=1e-3, rtol=0
    )
    torch.testing.assert_close(torch.tensor(astuple(DEVIATIONS)[:4]).double(), published.std(0), atol=1e-3, rtol=0)


@pytest.mark.parametrize("name", PUBLISHED_MM)
def test_published_cars_are_plausible_under_the_prior(name):
    offset = torch.tensor(PUBLISHED_MM[name], dtype=torch.float64) / 1000
    offset -= torch.tensor(astuple(CarDimensions())[:4], dtype=torch.float64)
    covariance = dimension_covariance()[:4, :4]
    assert (offset.abs() <= 2.5 * covariance.diagonal().sqrt()).all()
    # 99.9% of a chi-squared distribution with four degrees of freedom
    assert offset @ torch.linalg.solve(covariance, offset) < 18.5


def test_basis_is_the_derivative_of_the_points(template):
    factor = torch.linalg.cholesky(dimension_covariance())
    at = torch.tensor(astuple(CarDimensions()), dtype=torch.float64)
    for k, direction in enumerate(factor.T):
        remainders = []
        for step in (0.02, 0.01):
            moved = keypoints_of(CarDimensions(*(at + step * direction).tolist()))
            remainders.append((moved - template.mean - step * template.basis[k]).abs().max().item())
        # What a derivative leaves is of second order in the step.
        assert remainders[0] < 1e-4
        assert remainders[1] < 0.3 * remainders[0] + 1e-10


def test_basis_and_length_basis_reproduce_the_covariance_of_the_dimensions(template):
    axles = template.basis[:, 7, 0] - template.basis[:, 20, 0]
    covariance = dimension_covariance()
    assert (axles @ axles).item() == pytest.approx(covariance[3, 3].item())
    assert (template.length_basis @ axles).item() == pytest.approx(covariance[0, 3].item())
    assert template.length_basis.square().sum().item() == pytest.approx(covariance[0, 0].item())


def test_covariance_is_symmetric_positive_definite_and_precision_its_inverse(template):
    covariance, precision = template.covariance(), template.precision()
    torch.testing.assert_close(covariance, covariance.T)
    smallest = torch.linalg.eigvalsh(covariance)[0].item()
    assert smallest == pytest.approx(2 * min(template.sigma_symmetric_m, template.sigma_asymmetric_m) ** 2)
    torch.testing.assert_close(precision @ covariance, torch.eye(len(covariance), dtype=torch.float64))
    assert template.covariance() is covariance
    assert template.precision() is precision


def test_covariance_commutes_with_mirroring(template):
    covariance = template.covariance().reshape(66, 3, 66, 3)
    mirrored = covariance[FLIP][:, :, FLIP] * MIRROR[:, None, None] * MIRROR
    torch.testing.assert_close(mirrored, covariance)


def test_covariance_is_that_of_cars_drawn_from_the_model(template):
    count, generator = 40_000, torch.Generator().manual_seed(3)
    noise = lambda *shape: torch.randn(count, *shape, generator=generator).double()  # noqa: E731
    cars = torch.einsum("nk,kjc->njc", noise(len(template.basis)), template.basis)
    for left, right in APOLLOCAR3D_66.mirror_pairs:
        shared, differing = template.sigma_symmetric_m * noise(3), template.sigma_asymmetric_m * noise(3)
        cars[:, left] += shared + differing
        cars[:, right] += (shared - differing) * MIRROR
    covariance = template.covariance()
    deviation = covariance.diagonal().sqrt()
    error = (cars.flatten(1).T.cov() - covariance) / (deviation[:, None] * deviation)
    # An entry of a sample correlation has a deviation of at most sqrt(2 / count); six of them for 20,000 entries.
    assert error.abs().max() < 6 * (2 / count) ** 0.5


def test_sides_differ_and_agree_by_the_two_deviations(template):
    left, right = 3 * 13 + 1, 3 * 44 + 1
    own = template.basis.flatten(1)[:, [left, right]]
    residual = template.covariance()[[left, right]][:, [left, right]] - own.T @ own
    widening, shift = torch.tensor([0.5, -0.5]).double(), torch.tensor([0.5, 0.5]).double()
    assert (widening @ residual @ widening).item() == pytest.approx(template.sigma_symmetric_m**2)
    assert (shift @ residual @ shift).item() == pytest.approx(template.sigma_asymmetric_m**2)


def test_normals_are_unit_mirrored_and_point_outward(template):
    torch.testing.assert_close(template.normals.norm(dim=1), torch.ones(66, dtype=torch.float64))
    assert torch.equal(template.normals[FLIP] * MIRROR, template.normals)
    for car in (template.mean, *map(keypoints_of, drawn_cars(5, seed=4))):
        centre = torch.tensor([0.0, 0.0, 0.75], dtype=torch.float64)
        assert ((car - centre) * template.normals).sum(1).min() > 0


@pytest.mark.parametrize(("missing", "rms_m"), [(0, 0.015), (33, 0.02), (50, 0.03)])
def test_length_is_recovered_though_points_are_missing(template, missing, rms_m):
    generator = torch.Generator().manual_seed(5)
    errors = []
    for car in drawn_cars(100, seed=6):
        points = keypoints_of(car)
        points[torch.randperm(66, generator=generator)[:missing]] = NAN
        errors.append(template.length_m(points) - car.length)
    assert torch.tensor(errors).square().mean().sqrt() < rms_m


def test_length_of_typical_cars():
    template = car_template(APOLLOCAR3D_66)
    assert template is not None
    golf = CarDimensions(length=4.284, width=1.789, height=1.491, wheelbase=2.636, tail_run=0.6)
    camry = CarDimensions(length=4.885, width=1.840, height=1.445, wheelbase=2.825, tail_run=1.3)
    for car in (golf, camry, replace(golf, front_share=0.53), replace(camry, nose_sweep=0.40)):
        assert template.length_m(keypoints_of(car)) == pytest.approx(car.length, abs=0.02)


def test_length_of_the_unknown_car_is_the_average(template):
    assert template.length_m(torch.full((66, 3), NAN)) == pytest.approx(CarDimensions().length)
    assert template.length_m(template.mean) == pytest.approx(CarDimensions().length)


def test_length_does_not_depend_on_where_the_origin_is(template):
    points = keypoints_of(CarDimensions(length=4.7, wheelbase=2.8))
    moved = points + torch.tensor([0.3, -0.2, 0.4], dtype=torch.float64)
    assert template.length_m(moved) == pytest.approx(template.length_m(points), abs=0.005)


def test_a_schema_of_some_of_the_points_takes_them_in_its_order(template):
    indices = [20, 37, 7, 50, 62, 63, 11]
    part = car_template(subset(indices))
    assert part is not None
    assert torch.equal(part.mean, template.mean[indices])
    assert torch.equal(part.basis, template.basis[:, indices])
    assert torch.equal(part.normals, template.normals[indices])
    assert part.flip == (1, 0, 3, 2, 5, 4, 6)
    rows = [3 * j + axis for j in indices for axis in range(3)]
    torch.testing.assert_close(part.covariance(), template.covariance()[rows][:, rows])


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


def shape_distances(template: CarTemplate, points: torch.Tensor) -> tuple[float, float]:
    """RMS distance of a car, aligned by a similarity, to the mean and to the best car of the model, metres."""

    def rms(car: torch.Tensor) -> float:
        return (umeyama(points, car).apply(points) - car).square().sum(1).mean().sqrt().item()

    basis = template.basis.flatten(1)
    ridge = basis @ basis.T + 0.05**2 * torch.eye(len(basis), dtype=torch.float64)
    car = template.mean
    for _ in range(20):
        offset = umeyama(points, car).apply(points) - template.mean
        coefficients = torch.linalg.solve(ridge, basis @ offset.flatten())
        car = template.mean + torch.einsum("k,kjc->jc", coefficients, template.basis)
    return rms(template.mean), rms(car)


def test_labelled_cars_are_near_the_template(template):
    path = SHARED_DATA / "cars79_keypoints3d.json"
    if not path.is_file():
        pytest.skip(f"the labelled shapes are not beside the project ({path})")
    cars = json.loads(path.read_text())["cars"][:40]
    distances = [shape_distances(template, torch.tensor(car["keypoints"], dtype=torch.float64)) for car in cars]
    to_mean, to_model = torch.tensor(distances).square().mean(0).sqrt().tolist()
    assert to_mean < 0.16
    assert to_model < 0.08
