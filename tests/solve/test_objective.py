"""The paper's equations, and the gradient that is written out."""

import numpy as np
import pytest
import torch

from kronc_ns.fit.starts import circular_poses
from kronc_ns.geometry.camera import Camera, project
from kronc_ns.geometry.poses import invert, make_pose, transform
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.solve.adam import LossGradient, rotation_from_r6, rotation_to_r6
from kronc_ns.solve.objective import backproject, centroids, distances, loss, reproject

CAMERA = Camera(555.0, 540.0, 200.0, 190.0, 400, 400)


def observed(noise: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Poses moved by ``noise``; z-depths, pixels and visibility of 9 points in 6 views before it; the points."""
    rng = np.random.default_rng(0)
    points, c2w = 0.5 * rng.normal(size=(9, 3)), circular_poses(6)
    seen = transform(invert(c2w), np.broadcast_to(points, (6, 9, 3)))
    m = (rng.random((6, 9)) < 0.7).astype(float)
    draw = noise * rng.normal(size=(6, 6))
    moved = make_pose(c2w[..., :3] @ so3_exp(draw[:, :3]), c2w[..., 3] + draw[:, 3:])
    return moved, seen[..., 2], project(seen, CAMERA), m, points


def problem(noise: float = 0.0) -> list[torch.Tensor]:
    return [torch.from_numpy(array) for array in observed(noise)]


def posed(rotation: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    return torch.cat([rotation, translation[..., None]], dim=-1)


def test_loss_vanishes_at_the_truth_only():
    c2w, z, uv, m, points = problem()
    assert loss(c2w, z, uv, m, CAMERA, 1.0) < 1e-9
    world = centroids(points.expand(6, -1, -1), m)
    torch.testing.assert_close(world[m.sum(0) > 0], points[m.sum(0) > 0])
    assert loss(problem(0.05)[0], z, uv, m, CAMERA, 1.0) > 1.0


def test_pixels_and_depths_go_there_and_back():
    c2w, z, uv, _, points = problem()
    torch.testing.assert_close(backproject(uv, z, c2w, CAMERA), points.expand(6, -1, -1))
    torch.testing.assert_close(reproject(points, c2w, CAMERA), uv)


def test_unseen_points_do_not_count():
    c2w, z, uv, m, _ = problem(0.05)
    wild = torch.where(m[..., None] > 0, uv, torch.full_like(uv, 1e4))
    torch.testing.assert_close(loss(c2w, z, wild, m, CAMERA, 1.0), loss(c2w, z, uv, m, CAMERA, 1.0))


def test_rigid_motion_of_the_world_leaves_the_loss():
    c2w, z, uv, m, _ = problem(0.05)
    rotation = torch.from_numpy(so3_exp(np.array([0.3, -0.2, 0.9])))
    moved = posed(rotation @ c2w[..., :3], c2w[..., 3] @ rotation.T + 2.0)
    torch.testing.assert_close(loss(moved, z, uv, m, CAMERA, 0.3), loss(c2w, z, uv, m, CAMERA, 0.3))


def test_scaling_the_world_scales_metres_and_keeps_pixels():
    c2w, z, uv, m, _ = problem(0.05)
    larger = posed(c2w[..., :3], 3 * c2w[..., 3])
    metres, pixels = distances(c2w, z, uv, m, CAMERA)
    metres_3, pixels_3 = distances(larger, 3 * z, uv, m, CAMERA)
    torch.testing.assert_close(metres_3, 3 * metres)
    torch.testing.assert_close(pixels_3, pixels)


def test_lambda_weighs_pixels_against_metres():
    c2w, z, uv, m, _ = problem(0.05)
    metres, pixels = distances(c2w, z, uv, m, CAMERA)
    torch.testing.assert_close(loss(c2w, z, uv, m, CAMERA, 0.25), (metres.sum() + 0.25 * pixels.sum()) / 9)
    torch.testing.assert_close(loss(c2w, z, uv, m, CAMERA, 1.0, weight_3d=0.0), pixels.sum() / 9)


def test_written_out_gradient_against_autograd():
    c2w, z, uv, m, _ = problem(0.1)
    m[:, 4] = 0  # a keypoint that nobody sees
    for weight_3d, weight_2d in ((1.0, 0.3), (1.0, 0.0), (0.0, 1.0)):
        ours = LossGradient(c2w, z, uv, m, (CAMERA.fx, CAMERA.fy), (CAMERA.cx, CAMERA.cy), (weight_3d, weight_2d))
        with torch.no_grad():
            ours.r6.mul_(1.4)  # unnormalised, as in mid-optimisation
            value = ours.value(ours.evaluate())
        r6 = (1.4 * rotation_to_r6(c2w[..., :3])).requires_grad_()
        t, depth = c2w[..., 3].clone().requires_grad_(), z.clone().requires_grad_()
        expected = loss(posed(rotation_from_r6(r6), t), depth, uv, m, CAMERA, weight_2d, weight_3d)
        gradient = torch.autograd.grad(expected, (r6, t, depth))
        assert value == pytest.approx(expected.item(), rel=1e-9, abs=1e-9)
        flat = torch.cat([g.flatten() for g in gradient])
        torch.testing.assert_close(ours.parameters.grad, flat, rtol=1e-9, atol=1e-9)
