"""Single views around known points, from no start at all."""

import math
from dataclasses import replace

import numpy as np
import pytest

from kronc_ns.fit.starts import circular_poses
from kronc_ns.geometry.alignment import Similarity
from kronc_ns.geometry.poses import invert, look_at, unit
from kronc_ns.geometry.rotations import rotation_angle_deg, so3_exp
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.keypoints.template import car_template
from kronc_ns.solve import resection
from kronc_ns.solve.problem import State
from kronc_ns.solve.resection import Located, Views, locate, runner_up, unexplained
from tests.solve.problems import FOCAL, projections, randn

TEMPLATE = car_template(APOLLOCAR3D_66)
assert TEMPLATE is not None
FLIP = np.array(APOLLOCAR3D_66.flip)
TOLERANCE_PX = 3.0


def views_of(points: np.ndarray, c2w: np.ndarray, noise_px: float = 0.0) -> Views:
    """As a camera at each pose sees the points, also through the body."""
    uv = projections(State.of(c2w, points))
    return Views(
        uv + noise_px * randn(*uv.shape, seed=3),
        np.ones(uv.shape[:2]),
        points,
        np.tile(np.arange(len(points)), (len(c2w), 1)),
        FOCAL,
        np.full(len(c2w), TOLERANCE_PX),
        np.zeros_like(points),
    )


def of_the_car(c2w: np.ndarray, noise_px: float = 0.5) -> Views:
    """As a camera sees those points whose side of the car faces it."""
    ray = unit(c2w[:, None, :, 3] - TEMPLATE.mean)
    facing = (ray * TEMPLATE.normals).sum(-1) > 0.1
    seen = views_of(TEMPLATE.mean, c2w, noise_px)
    return replace(seen, weight=facing.astype(float), normals=TEMPLATE.normals)


def chosen(views: Views, index: np.ndarray) -> Views:
    per_view = ("uv", "weight", "label", "tolerance_px")
    return replace(views, **{name: getattr(views, name)[index] for name in per_view})


def off(located: Located, c2w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ours = invert(located.w2c)
    angle = rotation_angle_deg(ours[..., :3].swapaxes(1, 2) @ c2w[..., :3])
    return angle, np.linalg.norm(ours[..., 3] - c2w[..., 3], axis=-1)


def around(views: int = 24, radius_m: float = 5.0, height_m: float = 1.5, phase: float = 0.37) -> np.ndarray:
    azimuth = 2 * math.pi * (np.arange(views) + phase) / views
    centres = np.stack([radius_m * np.cos(azimuth), radius_m * np.sin(azimuth), np.full(views, height_m)], axis=1)
    return look_at(centres, np.broadcast_to([0.2, -0.1, 0.6], centres.shape), np.array([0.0, 0.0, 1.0]))


def rolled(c2w: np.ndarray, degrees: float) -> np.ndarray:
    turn = so3_exp(np.array([0.0, 0.0, math.radians(degrees)]))
    return np.concatenate([c2w[..., :3] @ turn, c2w[..., 3:]], axis=-1)


def with_outliers(views: Views, share: float) -> Views:
    rng = np.random.default_rng(1)
    wild = rng.random(views.weight.shape) < share
    return replace(views, uv=np.where(wild[..., None], rng.uniform(-125.0, 125.0, views.uv.shape), views.uv))


@pytest.mark.parametrize("height_m", [0.3, 1.5, 4.0, 9.0])
@pytest.mark.parametrize("exact", [False, True])
def test_exact_points_give_the_exact_pose_from_every_side(height_m, exact):
    c2w = around(36, height_m=height_m)
    located = locate(views_of(TEMPLATE.mean, c2w), exact)
    rotation, centre = off(located, c2w)
    assert rotation.max() < 1e-3
    assert centre.max() < 1e-4
    assert located.cost.max() < 1e-6


@pytest.mark.parametrize("degrees", [-90.0, 30.0, 60.0, 90.0, 135.0, 180.0])
def test_rolled_cameras_are_found_too(degrees):
    c2w = rolled(around(), degrees)
    rotation, centre = off(locate(views_of(TEMPLATE.mean, c2w)), c2w)
    assert rotation.max() < 1e-3
    assert centre.max() < 1e-4


def test_half_of_the_detections_may_be_outliers_where_the_points_are_exact():
    c2w = around()
    rotation, centre = off(locate(with_outliers(of_the_car(c2w), 0.5), exact=True), c2w)
    assert (rotation < 3).mean() > 0.85
    assert (centre < 0.3).mean() > 0.85


def test_outliers_do_not_count():
    c2w = around()
    rotation, centre = off(locate(with_outliers(of_the_car(c2w), 0.25)), c2w)
    assert np.median(rotation) < 0.5
    assert (rotation < 3).mean() > 0.9
    assert np.median(centre) < 0.1


def test_the_cars_own_shape_is_told_from_its_mirror_image():
    right = of_the_car(around())
    wrong = replace(right, uv=right.uv[:, FLIP], weight=right.weight[:, FLIP])
    cost, swapped = locate(right).cost, locate(wrong).cost
    assert (cost < 0.3).all()
    assert (swapped > 2 * cost).all()


def test_exchanged_labels_are_exchanged_detections():
    views = of_the_car(around())
    mirrored = replace(views, uv=views.uv[:, FLIP], weight=views.weight[:, FLIP])
    labelled = replace(mirrored, label=FLIP[mirrored.label])
    ours, theirs = locate(labelled), locate(views)
    np.testing.assert_allclose(ours.w2c, theirs.w2c, atol=1e-8)
    np.testing.assert_allclose(ours.cost, theirs.cost, rtol=1e-6)


def test_a_view_whose_rival_is_clearly_ahead_is_given_up():
    """Both labellings of a view compete: the right one ends where it ends alone."""
    views, count = of_the_car(around()), 24
    both = Views(
        np.concatenate([views.uv] * 2),
        np.concatenate([views.weight] * 2),
        views.points,
        np.concatenate([views.label, FLIP[views.label]]),
        views.focal,
        np.concatenate([views.tolerance_px] * 2),
        views.normals,
    )
    alone, competing = locate(both), locate(both, rival=np.roll(np.arange(2 * count), count))
    np.testing.assert_allclose(competing.w2c[:count], alone.w2c[:count], atol=1e-8)
    np.testing.assert_allclose(competing.cost[:count], alone.cost[:count], rtol=1e-6)
    given_up = np.isinf(competing.cost[count:])
    assert given_up.mean() > 0.5
    assert np.isnan(competing.w2c[count:][given_up]).all()
    np.testing.assert_allclose(competing.cost[count:][~given_up], alone.cost[count:][~given_up], rtol=1e-6)


def test_a_pose_that_looks_through_the_car_costs_more_with_normals():
    glass = views_of(TEMPLATE.mean, around())
    assert locate(glass).cost.max() < 1e-6
    assert (locate(replace(glass, normals=TEMPLATE.normals)).cost > 0.2).all()


def test_what_a_given_pose_leaves_unexplained():
    c2w = around(12)
    views = of_the_car(c2w)
    located = locate(views)
    np.testing.assert_allclose(unexplained(views, located.w2c), located.cost, rtol=1e-9)
    exact, away = of_the_car(c2w, noise_px=0.0), c2w * np.array([-1.0, 1.0, -1.0, 1.0])  # half a turn about y
    assert unexplained(exact, invert(c2w)).max() < 1e-9
    np.testing.assert_allclose(unexplained(exact, invert(away)), 1.0, rtol=1e-6)  # all points behind
    square = (exact.uv[..., 0] ** 2 + 1) / TOLERANCE_PX**2
    aside = replace(exact, uv=exact.uv * np.array([0.0, 1.0]) + np.array([0.0, 1.0]))
    expected = ((1 - 1 / (1 + square)) * exact.weight).sum(1) / exact.weight.sum(1)
    np.testing.assert_allclose(unexplained(aside, invert(c2w)), expected, rtol=1e-6)
    nowhere = np.where(np.arange(12)[:, None, None] == 3, np.nan, invert(c2w))
    np.testing.assert_allclose(unexplained(exact, nowhere), np.arange(12) == 3, atol=1e-6)


def test_the_second_best_pose_of_many_points_in_space_is_far_worse():
    c2w = circular_poses(8)
    views = of_the_car(c2w)
    assert unexplained(views, invert(c2w)).max() < 0.1
    assert runner_up(views, invert(c2w), 10.0).min() > 0.3


def test_a_few_points_of_a_plane_far_away_are_met_from_two_sides():
    """Necker's reversal: seen from afar a plane leans this way or that."""
    plane = 0.3 * np.array([[x, 0.0, z] for x in (-1, 0, 1) for z in (-1, 0, 1)])
    c2w = look_at(np.array([[3.0, 9.0, 2.0]]), np.zeros((1, 3)), np.array([0.0, 0.0, 1.0]))
    views = views_of(plane, c2w)
    assert runner_up(views, invert(c2w), 10.0)[0] < 0.2


def test_a_pose_is_no_rival_of_itself():
    views = of_the_car(circular_poses(4), noise_px=0.0)
    w2c = invert(circular_poses(4))
    assert runner_up(views, w2c, -1.0) == pytest.approx(0.0, abs=1e-6)  # without a distance it is found again
    assert runner_up(views, w2c, 10.0).min() > 0.3


def test_unknown_points_are_ignored():
    c2w = around(12)
    views = views_of(TEMPLATE.mean, c2w)
    points = TEMPLATE.mean.copy()
    points[20:] = math.nan
    views.uv[:, 20:] = 1e4
    located = locate(replace(views, points=points))
    rotation, centre = off(located, c2w)
    assert rotation.max() < 1e-3
    assert centre.max() < 1e-4
    assert located.cost.max() < 1e-6


def test_unseen_points_are_ignored():
    c2w = around(12)
    views = views_of(TEMPLATE.mean, c2w)
    views.weight[:, ::3] = 0
    views.uv[:, ::3] = 1e5
    assert off(locate(views), c2w)[0].max() < 1e-3


@pytest.mark.parametrize("views", [6, 40])
def test_every_view_is_found_by_itself(views):
    """Also where guesses are refined in parts."""
    all_of_them = views_of(TEMPLATE.mean, around(views), noise_px=1.0)
    together = locate(all_of_them)
    for i in range(0, views, 5):
        alone = locate(chosen(all_of_them, np.array([i])))
        np.testing.assert_allclose(alone.w2c[0], together.w2c[i], rtol=0, atol=1e-8)
        assert alone.cost[0] == pytest.approx(together.cost[i], rel=1e-6, abs=1e-12)


def test_size_and_place_of_the_points_do_not_matter_as_long_as_up_is_up():
    world = Similarity(3.0, so3_exp(np.array([0.0, 0.0, 2.0])), np.array([10.0, -4.0, 2.0]))
    there = world.apply_to_poses(around(8))
    rotation, centre = off(locate(views_of(world.apply(TEMPLATE.mean), there)), there)
    assert rotation.max() < 1e-3
    assert centre.max() < 1e-3


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("count", range(4))
def test_views_with_too_few_points_have_no_cost_that_is_not_a_number(count, exact):
    c2w = around(3)
    views = views_of(TEMPLATE.mean, c2w)
    views.weight[1, count:] = 0
    located = locate(views, exact)
    assert np.isfinite(located.cost).all()
    assert off(located, c2w)[0][[0, 2]].max() < 1e-3


@pytest.mark.parametrize("exact", [False, True])
def test_no_views_have_no_poses(exact):
    located = locate(chosen(views_of(TEMPLATE.mean, circular_poses(4)), np.array([], dtype=int)), exact)
    assert located.w2c.shape == (0, 3, 4)


def test_arrays_of_any_layout_are_compiled_once():
    """What numba compiles depends on the strides' kind, and it takes seconds."""
    views = of_the_car(around(12))
    expected = locate(views)
    functions = [value for value in vars(resection).values() if hasattr(value, "signatures")]
    ready = [len(function.signatures) for function in functions]
    turned = {name: np.asfortranarray(getattr(views, name)) for name in ("uv", "weight", "points", "label", "normals")}
    found = locate(replace(views, **turned, tolerance_px=np.repeat(views.tolerance_px, 2)[::2]))
    np.testing.assert_allclose(found.w2c, expected.w2c, atol=1e-8)
    again = unexplained(views, np.asfortranarray(found.w2c))
    np.testing.assert_allclose(again, found.cost, rtol=1e-9)
    assert [len(function.signatures) for function in functions] == ready
