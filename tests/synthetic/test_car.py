"""The procedural car: dimensions, mirror symmetry, keypoints on the skin."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from kronc_ns.synthetic.car import MIRROR, CarModel, build_car, features
from kronc_ns.synthetic.car_paint import METRES_PER_TEXEL
from kronc_ns.synthetic.car_parts import STYLES, CarShape
from kronc_ns.synthetic.render import keypoint_visibility

SHAPES = {
    "hatchback": CarShape(),
    "saloon": CarShape(**STYLES["saloon"]),
    "random": CarShape.random(np.random.default_rng(104)),
}


@pytest.fixture(params=SHAPES)
def car(request: pytest.FixtureRequest) -> CarModel:
    return build_car(SHAPES[request.param])


def test_keypoints_lie_on_the_mesh(car: CarModel) -> None:
    # the nearest of the large faces and of some small ones around each point: never closer than the nearest of all
    triangles = car.mesh.triangles
    large = np.flatnonzero(np.ptp(triangles, axis=1).max(1) > 0.2)
    _, near = cKDTree(car.mesh.triangles_center).query(car.keypoints, k=60)
    faces = np.hstack([near, np.tile(large, (66, 1))])
    points = np.repeat(car.keypoints, faces.shape[1], axis=0)
    distance = np.linalg.norm(trimesh.triangles.closest_point(triangles[faces.ravel()], points) - points, axis=1)
    distance = distance.reshape(faces.shape).min(1)
    assert car.keypoints.shape == (66, 3)
    assert car.keypoints.dtype == np.float64
    assert distance.max() < 1e-3


def test_keypoints_and_mesh_are_mirror_symmetric(car: CarModel) -> None:
    flip = np.array([1.0, -1.0, 1.0])
    np.testing.assert_allclose(car.keypoints[MIRROR], car.keypoints * flip, atol=1e-9)
    np.testing.assert_array_equal(MIRROR[MIRROR], np.arange(66))
    assert (np.arange(66) != MIRROR).all()
    vertices = np.unique(np.round(car.mesh.vertices, 6) + 0.0, axis=0)
    mirrored = np.unique(np.round(car.mesh.vertices * flip, 6) + 0.0, axis=0)
    np.testing.assert_allclose(vertices, mirrored, atol=1e-9)


def test_dimensions_are_those_of_the_shape(car: CarModel) -> None:
    body = car.mesh.vertices[car.mesh.faces[car.face_material == 0]].reshape(-1, 3)
    s = car.shape
    np.testing.assert_allclose(np.ptp(body[:, :2], axis=0), [s.length, s.width], atol=0.02)
    np.testing.assert_allclose([body[:, 2].max(), body[:, 2].min()], [s.height, s.clearance], atol=0.02)
    np.testing.assert_allclose(car.mesh.bounds[:, 2], [0, s.height], atol=0.02)
    np.testing.assert_allclose(car.mesh.bounds[:, 0], [-s.length / 2, s.length / 2], atol=0.02)
    assert np.abs(car.mesh.bounds[:, 1]).max() < s.width / 2 + 0.25


def test_normals_are_unit_and_body_normals_point_outwards(car: CarModel) -> None:
    np.testing.assert_allclose(np.linalg.norm(car.mesh.vertex_normals, axis=1), 1, atol=1e-6)
    body = car.face_material == 0
    smooth = car.mesh.vertex_normals[car.mesh.faces[body]].mean(1)
    agree = np.einsum("fi,fi->f", smooth, car.mesh.face_normals[body])
    assert (agree > 0).mean() > 0.995
    assert len(car.face_material) == len(car.mesh.faces)


def test_keypoints_have_their_meaning(car: CarModel) -> None:
    k, s = car.keypoints, car.shape
    left = np.arange(29)
    assert (k[left, 1] > 0.2).all()
    assert (k[MIRROR[left], 1] < -0.2).all()
    for wheel, x in ((7, s.front_axle_x), (20, s.rear_axle_x)):
        np.testing.assert_allclose(k[wheel, [0, 2]], [x, s.wheel_radius], atol=1e-3)
        assert s.width / 2 - 0.12 < k[wheel, 1] < s.width / 2
    assert k[6, 0] > k[7, 0] + s.wheel_radius
    assert k[21, 0] < k[20, 0] - s.wheel_radius
    assert (k[[0, 1, 2, 3, 4, 5, 58, 59, 60, 61], 0] > s.front_axle_x).all()
    assert (k[[22, 23, 25, 26, 27, 28, 62, 63, 64, 65], 0] < s.rear_axle_x).all()
    assert (k[[0, 2, 4, 59, 62, 22, 25], 2] > k[[1, 3, 5, 61, 65, 23, 26], 2] + 0.05).all()
    assert (k[[2, 3, 22, 23], 1] > k[[0, 1, 25, 26], 1] + 0.2).all()
    assert k[9, 0] > k[13, 0] > k[14, 0] > k[12, 0] > k[17, 0] > k[18, 0] > k[20, 0]
    assert s.height > k[8, 2] > k[9, 2] > k[13, 2] > k[10, 2]
    assert k[11, 2] > k[12, 2] > k[14, 2] > k[15, 2]
    assert k[49, 1] < 0 < k[8, 1]
    assert k[8, 0] > k[11, 0] > k[24, 0]


def test_lamps_are_painted_where_their_keypoints_are() -> None:
    car = build_car(SHAPES["hatchback"])
    for name, corners in (("front", [0, 1, 3, 2]), ("rear", [25, 26, 23, 22])):
        lamp, layer = car.keypoints[corners], car.layers[name]
        np.testing.assert_allclose(lamp[:, 1:], features(car.shape)[f"{name}_lamp"], atol=1e-6)
        for side in (1, -1):
            middle = lamp.mean(0) * (1, side, 1) + (0, 0, 0.05)
            column = int((middle @ layer.right - layer.corner[0]) / METRES_PER_TEXEL)
            row = int((layer.corner[1] - middle[2]) / METRES_PER_TEXEL)
            red, green, _, alpha, _ = layer.levels[0][row, column].astype(int)
            assert alpha == 255
            assert (red > green + 60) == (name == "rear")


def test_every_keypoint_can_be_seen_from_somewhere(car: CarModel) -> None:
    azimuth = np.radians(np.arange(0, 360, 10))
    centres = np.stack([4.5 * np.cos(azimuth), 4.5 * np.sin(azimuth), np.full(36, 1.5)], 1)
    assert keypoint_visibility(car.mesh, car.keypoints, centres).any(0).all()


def test_impossible_dimensions_are_refused() -> None:
    with pytest.raises(ValueError, match=r"height 0\.9"):
        build_car(CarShape(height=0.9))


def test_random_shapes_vary_and_follow_the_seed() -> None:
    shapes = [CarShape.random(np.random.default_rng(seed)) for seed in range(20)]
    assert shapes[3] == CarShape.random(np.random.default_rng(3))
    assert len({s.length for s in shapes}) == 20
    assert np.ptp([s.height for s in shapes]) > 0.1
    assert np.ptp([s.boot_length for s in shapes]) > 0.3
    assert all(s.rear_axle_x - s.arch_radius > -s.length / 2 + 0.2 for s in shapes)
