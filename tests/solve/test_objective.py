import pytest
import torch

from kronc_ns.fit.starts import circular_poses
from kronc_ns.geometry.camera import Camera, project
from kronc_ns.geometry.poses import invert, make_pose, transform
from kronc_ns.geometry.rotations import rotation_from_r6, rotation_to_r6, so3_exp
from kronc_ns.solve.adam import LossGradient
from kronc_ns.solve.objective import centroids, distances, loss

CAMERA = Camera(555.0, 540.0, 200.0, 190.0, 400, 400)


def problem(noise: float = 0.0, seed: int = 0):
    """Consistent observations of 9 points in 6 views, then poses moved by ``noise``."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(9, 3, dtype=torch.float64, generator=generator) * 0.5
    c2w = circular_poses(6)
    seen = transform(invert(c2w), points.expand(6, -1, -1))
    m = (torch.rand(6, 9, dtype=torch.float64, generator=generator) < 0.7).double()
    draw = torch.randn(6, 6, dtype=torch.float64, generator=generator) * noise
    moved = make_pose(c2w[..., :3] @ so3_exp(draw[:, :3]), c2w[..., 3] + draw[:, 3:])
    return moved, seen[..., 2], project(seen, CAMERA), m, points


def test_loss_vanishes_at_the_truth_only():
    c2w, z, uv, m, points = problem()
    assert loss(c2w, z, uv, m, CAMERA, 1.0) < 1e-9
    world = centroids(points.expand(6, -1, -1), m)
    torch.testing.assert_close(world[m.sum(0) > 0], points[m.sum(0) > 0])
    assert loss(problem(0.05)[0], z, uv, m, CAMERA, 1.0) > 1.0


def test_unseen_points_do_not_count():
    c2w, z, uv, m, _ = problem(0.05)
    wild = torch.where(m[..., None] > 0, uv, torch.full_like(uv, 1e4))
    torch.testing.assert_close(loss(c2w, z, wild, m, CAMERA, 1.0), loss(c2w, z, uv, m, CAMERA, 1.0))


def test_rigid_motion_of_the_world_leaves_the_loss():
    c2w, z, uv, m, _ = problem(0.05)
    rotation = so3_exp(torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64))
    moved = make_pose(rotation @ c2w[..., :3], c2w[..., 3] @ rotation.T + 2.0)
    torch.testing.assert_close(loss(moved, z, uv, m, CAMERA, 0.3), loss(c2w, z, uv, m, CAMERA, 0.3))


def test_scaling_the_world_scales_metres_and_keeps_pixels():
    c2w, z, uv, m, _ = problem(0.05)
    larger = make_pose(c2w[..., :3], 3 * c2w[..., 3])
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
        expected = loss(make_pose(rotation_from_r6(r6), t), depth, uv, m, CAMERA, weight_2d, weight_3d)
        gradient = torch.autograd.grad(expected, (r6, t, depth))
        assert value == pytest.approx(expected.item(), rel=1e-9, abs=1e-9)
        flat = torch.cat([g.flatten() for g in gradient])
        torch.testing.assert_close(ours.parameters.grad, flat, rtol=1e-9, atol=1e-9)
