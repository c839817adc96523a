import math

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from kronc_ns.errors import KroncError
from kronc_ns.geometry.camera import Camera, project, rays, reproject
from kronc_ns.geometry.poses import camera_z, invert, transform
from tests.geometry.test_poses import poses

CAMERA = Camera(500.0, 520.0, 310.0, 240.0, 640, 480)


def test_projection_inverts_backprojection():
    rng = np.random.default_rng(0)
    uv, z, c2w = rng.uniform(0, 400, (6, 9, 2)), rng.uniform(1, 6, (6, 9)), poses(6)
    world = transform(c2w, z[..., None] * rays(uv, CAMERA))
    in_camera = transform(invert(c2w), world)
    assert_allclose(in_camera[..., 2], z)
    assert_allclose(project(in_camera, CAMERA), uv)


def test_backprojection_is_the_papers_equation_1():
    c2w, uv, z = poses(1), np.array([[[100.0, 50.0]]]), 3.0
    expected = c2w[0] @ np.append(np.linalg.inv(CAMERA.matrix) @ [100.0, 50.0, 1.0] * z, 1.0)
    assert_allclose(transform(c2w, z * rays(uv, CAMERA))[0, 0], expected)


def test_projection_is_that_of_the_matrix():
    points = np.array([[0.2, -0.3, 2.0], [1.0, 0.5, 4.0]])
    homogeneous = points @ CAMERA.matrix.T
    assert_allclose(project(points, CAMERA), homogeneous[:, :2] / homogeneous[:, 2:])


def test_reprojection_is_projection_in_every_view_and_inf_behind():
    c2w, points = poses(6), np.random.default_rng(3).normal(size=(9, 3))
    uv, before = reproject(points, c2w, CAMERA), camera_z(c2w, points) > 0
    assert before.any()
    assert not before.all()
    in_camera = transform(invert(c2w), np.broadcast_to(points, (6, 9, 3)))
    assert_allclose(uv[before], project(in_camera[before], CAMERA))
    assert_array_equal(uv[~before], np.inf)


def test_a_point_in_the_cameras_plane_is_behind_it(recwarn):
    uv = reproject(np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 0.0]]), np.eye(3, 4)[None], CAMERA)
    assert_array_equal(uv, np.full((1, 2, 2), np.inf))
    assert not recwarn.list


@pytest.mark.parametrize("lens", [(-0.12, 0.03, 0.001, -0.002), (-0.35, 0.12, 0.0, 0.0), (0.6, 0.3, 0.0, 0.0)])
def test_undistort_inverts_opencvs_distortion(lens: tuple[float, ...]):
    camera = Camera(500.0, 500.0, 320.0, 240.0, 640, 480, *lens)
    ideal = np.random.default_rng(1).uniform(100, 400, (20, 2))
    directions = rays(ideal, camera)
    distorted, _ = cv2.projectPoints(directions, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion))
    assert_allclose(camera.distort(ideal), distorted[:, 0], atol=1e-9)
    assert_allclose(camera.undistort(distorted[:, 0]), ideal, atol=1e-6)


def test_scaling_the_image_scales_the_pixels():
    points = np.array([[0.2, -0.3, 2.0]])
    assert_allclose(project(points, CAMERA.scaled(0.5)), 0.5 * project(points, CAMERA))


@pytest.mark.parametrize(("field", "value"), [("fx", 0.0), ("fy", -3.0), ("cx", math.nan), ("width", 0)])
def test_impossible_cameras_are_refused(field, value):
    values = {"fx": 500.0, "fy": 500.0, "cx": 1.0, "cy": 1.0, "width": 10, "height": 10, field: value}
    with pytest.raises(KroncError):
        Camera(**values)
