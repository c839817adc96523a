import math

import cv2
import numpy as np
import pytest
import torch

from kronc_ns.errors import KroncError
from kronc_ns.geometry.camera import Camera, backproject, project, rays
from kronc_ns.geometry.poses import invert, transform
from tests.geometry.test_poses import poses

CAMERA = Camera(500.0, 520.0, 310.0, 240.0, 640, 480)


def test_projection_inverts_backprojection():
    generator = torch.Generator().manual_seed(0)
    uv = torch.rand(6, 9, 2, dtype=torch.float64, generator=generator) * 400
    z = 1 + torch.rand(6, 9, dtype=torch.float64, generator=generator) * 5
    c2w = poses(6)
    world = backproject(uv, z, c2w, CAMERA)
    in_camera = transform(invert(c2w), world)
    torch.testing.assert_close(in_camera[..., 2], z)
    torch.testing.assert_close(project(in_camera, CAMERA), uv)


def test_backprojection_is_the_papers_equation_1():
    c2w, uv, z = (
        poses(1),
        torch.tensor([[[100.0, 50.0]]], dtype=torch.float64),
        torch.tensor([[3.0]], dtype=torch.float64),
    )
    k_inverse = np.linalg.inv(CAMERA.matrix)
    expected = c2w[0].numpy() @ np.append(k_inverse @ [100.0, 50.0, 1.0] * 3.0, 1.0)
    np.testing.assert_allclose(backproject(uv, z, c2w, CAMERA)[0, 0].numpy(), expected)


def test_project_jacobian_against_finite_differences():
    points = torch.tensor([[0.2, -0.3, 2.0], [1.0, 0.5, 4.0]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p: project(p, CAMERA), points)


@pytest.mark.parametrize("lens", [(-0.12, 0.03, 0.001, -0.002), (-0.35, 0.12, 0.0, 0.0), (0.6, 0.3, 0.0, 0.0)])
def test_undistort_inverts_opencvs_distortion(lens: tuple[float, ...]):
    camera = Camera(500.0, 500.0, 320.0, 240.0, 640, 480, *lens)
    ideal = torch.rand(20, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 300 + 100
    directions = rays(ideal, camera).numpy()
    distorted, _ = cv2.projectPoints(directions, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))
    np.testing.assert_allclose(camera.distort(ideal), distorted[:, 0], atol=1e-9)
    np.testing.assert_allclose(camera.undistort(torch.from_numpy(distorted[:, 0])), ideal, atol=1e-6)


def test_scaling_the_image_scales_the_pixels():
    points = torch.tensor([[0.2, -0.3, 2.0]], dtype=torch.float64)
    torch.testing.assert_close(project(points, CAMERA.scaled(0.5)), 0.5 * project(points, CAMERA))


@pytest.mark.parametrize(("field", "value"), [("fx", 0.0), ("fy", -3.0), ("cx", math.nan), ("width", 0)])
def test_impossible_cameras_are_refused(field, value):
    values = {"fx": 500.0, "fy": 500.0, "cx": 1.0, "cy": 1.0, "width": 10, "height": 10, field: value}
    with pytest.raises(KroncError):
        Camera(**values)
