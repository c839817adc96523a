"""Single views around known points, from no start at all."""

import math

import pytest
import torch
from torch import Tensor

from kronc_ns.fit.starts import circular_poses
from kronc_ns.geometry.alignment import Similarity
from kronc_ns.geometry.poses import invert, look_at
from kronc_ns.geometry.rotations import rotation_angle_deg, so3_exp
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.keypoints.template import car_template
from kronc_ns.solve.resection import Located, locate
from tests.solve.problems import generator, randn

FOCAL = torch.tensor([400.0, 390.0], dtype=torch.float64)
TEMPLATE = car_template(APOLLOCAR3D_66)
assert TEMPLATE is not None
FLIP = torch.tensor(APOLLOCAR3D_66.flip)


def views_of(points: Tensor, c2w: Tensor, noise_px: float = 0.0) -> Tensor:
    """Pixels less the principal point, planar, as a camera at each pose sees the points (also through the body)."""
    w2c = invert(c2w)
    camera = w2c[..., :3] @ points.T + w2c[..., 3:]
    uv = camera[:, :2] / camera[:, 2:] * FOCAL[:, None]
    return uv + noise_px * randn(*uv.shape, seed=3)


def found(
    points: Tensor, uv: Tensor, weight: Tensor | None = None, normals: Tensor | None = None, exact: bool = False
) -> Located:
    views = len(uv)
    return locate(
        points.expand(views, -1, -1),
        uv,
        torch.ones(views, uv.shape[-1], dtype=torch.float64) if weight is None else weight,
        FOCAL.expand(views, 2),
        torch.full((views,), 3.0, dtype=torch.float64),
        normals,
        exact,
    )


def off(located: Located, c2w: Tensor) -> tuple[Tensor, Tensor]:
    ours = invert(located.w2c)
    angle = rotation_angle_deg(ours[..., :3].mT @ c2w[..., :3])
    return angle, (ours[..., 3] - c2w[..., 3]).norm(dim=-1)


def around(views: int = 24, radius_m: float = 5.0, height_m: float = 1.5, phase: float = 0.0) -> Tensor:
    azimuth = 2 * math.pi * (torch.arange(views, dtype=torch.float64) + phase) / views
    centres = torch.stack(
        [radius_m * azimuth.cos(), radius_m * azimuth.sin(), torch.full_like(azimuth, height_m)], dim=1
    )
    target = torch.tensor([0.2, -0.1, 0.6], dtype=torch.float64)
    return look_at(centres, target.expand_as(centres), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


def rolled(c2w: Tensor, degrees: float) -> Tensor:
    turn = so3_exp(torch.tensor([0.0, 0.0, math.radians(degrees)], dtype=torch.float64))
    return torch.cat([c2w[..., :3] @ turn, c2w[..., 3:]], dim=-1)


@pytest.mark.parametrize("height_m", [0.3, 1.5, 4.0, 9.0])
@pytest.mark.parametrize("exact", [False, True])
def test_exact_points_give_the_exact_pose_from_every_side(height_m, exact):
    c2w = around(36, height_m=height_m, phase=0.37)
    located = found(TEMPLATE.mean, views_of(TEMPLATE.mean, c2w), exact=exact)
    rotation, centre = off(located, c2w)
    assert rotation.max() < 1e-3
    assert centre.max() < 1e-4
    assert located.cost.max() < 1e-6


@pytest.mark.parametrize("degrees", [-90.0, 30.0, 60.0, 90.0, 135.0, 180.0])
def test_rolled_cameras_are_found_too(degrees):
    c2w = rolled(around(24, phase=0.37), degrees)
    rotation, centre = off(found(TEMPLATE.mean, views_of(TEMPLATE.mean, c2w)), c2w)
    assert rotation.max() < 1e-3
    assert centre.max() < 1e-4


def visible(c2w: Tensor) -> Tensor:
    """Points whose side of the car faces the camera."""
    ray = torch.nn.functional.normalize(c2w[:, None, :, 3] - TEMPLATE.mean, dim=-1)
    return ((ray * TEMPLATE.normals).sum(-1) > 0.1).double()


def test_half_of_the_detections_may_be_outliers_where_the_points_are_exact():
    c2w = around(24, phase=0.37)
    uv = views_of(TEMPLATE.mean, c2w, noise_px=0.5)
    wild = torch.rand(24, 66, generator=generator(1)) < 0.5
    anywhere = 250 * (torch.rand(uv.shape, dtype=torch.float64, generator=generator(2)) - 0.5)
    located = found(TEMPLATE.mean, torch.where(wild[:, None], anywhere, uv), visible(c2w), TEMPLATE.normals, exact=True)
    rotation, centre = off(located, c2w)
    assert (rotation < 3).double().mean() > 0.85
    assert (centre < 0.3).double().mean() > 0.85


def test_outliers_do_not_count():
    c2w = around(24, phase=0.37)
    uv = views_of(TEMPLATE.mean, c2w, noise_px=0.5)
    wild = torch.rand(24, 66, generator=generator(1)) < 0.25
    anywhere = 250 * (torch.rand(uv.shape, dtype=torch.float64, generator=generator(2)) - 0.5)
    located = found(TEMPLATE.mean, torch.where(wild[:, None], anywhere, uv), visible(c2w), TEMPLATE.normals)
    rotation, centre = off(located, c2w)
    assert rotation.median() < 0.5
    assert (rotation < 3).double().mean() > 0.9
    assert centre.median() < 0.1


def test_the_cars_own_shape_is_told_from_its_mirror_image():
    c2w = around(24, phase=0.37)
    seen, uv = visible(c2w), views_of(TEMPLATE.mean, c2w, noise_px=0.5)
    right = found(TEMPLATE.mean, uv, seen, TEMPLATE.normals)
    wrong = found(TEMPLATE.mean, uv[..., FLIP], seen[..., FLIP], TEMPLATE.normals)
    assert (right.cost < 0.3).all()
    assert (wrong.cost > 2 * right.cost).all()


def test_a_pose_that_looks_through_the_car_costs_more_with_normals():
    c2w = around(24, phase=0.37)
    uv = views_of(TEMPLATE.mean, c2w)
    everything = torch.ones(24, 66, dtype=torch.float64)
    glass, solid = (found(TEMPLATE.mean, uv, everything, normals) for normals in (None, TEMPLATE.normals))
    assert glass.cost.max() < 1e-6
    assert (solid.cost > 0.2).all()


def test_unknown_points_are_ignored():
    c2w = around(12, phase=0.37)
    points = TEMPLATE.mean.clone()
    uv = views_of(points, c2w)
    points[20:] = math.nan
    uv[..., 20:] = 1e4
    located = found(points, uv)
    rotation, centre = off(located, c2w)
    assert rotation.max() < 1e-3
    assert centre.max() < 1e-4
    assert located.cost.max() < 1e-6


def test_unseen_points_are_ignored():
    c2w = around(12, phase=0.37)
    weight = torch.ones(12, 66, dtype=torch.float64)
    weight[:, ::3] = 0
    uv = torch.where(weight[:, None] > 0, views_of(TEMPLATE.mean, c2w), 1e5)
    assert off(found(TEMPLATE.mean, uv, weight), c2w)[0].max() < 1e-3


def test_every_view_is_found_by_itself():
    c2w = around(6, phase=0.37)
    uv = views_of(TEMPLATE.mean, c2w, noise_px=1.0)
    together = found(TEMPLATE.mean, uv)
    for i in range(6):
        alone = found(TEMPLATE.mean, uv[i : i + 1])
        torch.testing.assert_close(alone.w2c[0], together.w2c[i], rtol=0, atol=1e-8)
        torch.testing.assert_close(alone.cost[0], together.cost[i], rtol=1e-6, atol=1e-12)


def test_size_and_place_of_the_points_do_not_matter_as_long_as_up_is_up():
    c2w = around(8, phase=0.37)
    world = Similarity(
        torch.tensor(3.0, dtype=torch.float64),
        so3_exp(torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)),
        torch.tensor([10.0, -4.0, 2.0], dtype=torch.float64),
    )
    points, there = world.apply(TEMPLATE.mean), world.apply_to_poses(c2w)
    rotation, centre = off(found(points, views_of(points, there)), there)
    assert rotation.max() < 1e-3
    assert centre.max() < 1e-3


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("count", range(4))
def test_views_with_too_few_points_have_no_cost_that_is_not_a_number(count, exact):
    weight = torch.ones(3, 66, dtype=torch.float64)
    weight[1, count:] = 0
    c2w = around(3, phase=0.37)
    located = found(TEMPLATE.mean, views_of(TEMPLATE.mean, c2w), weight, exact=exact)
    assert located.cost.isfinite().all()
    assert off(located, c2w)[0][[0, 2]].max() < 1e-3


def test_no_views_have_no_poses():
    located = found(TEMPLATE.mean, views_of(TEMPLATE.mean, circular_poses(4))[:0])
    assert located.w2c.shape == (0, 3, 4)
