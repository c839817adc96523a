import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from kronc_ns.geometry.poses import (
    camera_z,
    compose,
    flip_camera_axes,
    invert,
    look_at,
    make_pose,
    posed,
    transform,
    unit,
)
from kronc_ns.geometry.rotations import so3_exp


def poses(n: int, seed: int = 0) -> np.ndarray:
    draw = np.random.default_rng(seed).normal(size=(n, 6))
    return make_pose(so3_exp(draw[:, :3]), draw[:, 3:])


def identity(n: int) -> np.ndarray:
    return np.broadcast_to(np.eye(3, 4), (n, 3, 4))


def test_group_axioms():
    a, b, c = poses(20, 0), poses(20, 1), poses(20, 2)
    assert_allclose(compose(compose(a, b), c), compose(a, compose(b, c)), atol=1e-12)
    assert_allclose(compose(a, invert(a)), identity(20), atol=1e-12)
    assert_allclose(compose(invert(a), a), identity(20), atol=1e-12)
    assert_allclose(compose(a, identity(20)), a, atol=1e-12)
    assert_allclose(invert(compose(a, b)), compose(invert(b), invert(a)), atol=1e-12)


def test_transform_acts_as_a_group():
    a, b = poses(5, 0), poses(5, 1)
    points = np.random.default_rng(3).normal(size=(5, 7, 3))
    assert_allclose(transform(compose(a, b), points), transform(a, transform(b, points)), atol=1e-12)


def test_posed_are_the_views_without_a_hole():
    c2w = poses(4)
    c2w[1] = np.nan
    c2w[2, 0, 3] = np.inf
    assert_array_equal(posed(c2w), [True, False, False, True])
    assert_array_equal(posed(c2w.reshape(2, 2, 3, 4)), [[True, False], [False, True]])


def test_camera_z_is_the_third_coordinate_before_the_camera():
    c2w, points = poses(5), np.random.default_rng(3).normal(size=(7, 3))
    in_camera = transform(invert(c2w), np.broadcast_to(points, (5, 7, 3)))
    assert_allclose(camera_z(c2w, points), in_camera[..., 2], atol=1e-12)


def test_camera_z_does_not_depend_on_the_world_frame():
    c2w, points, world = poses(5), np.random.default_rng(3).normal(size=(7, 3)), poses(1, 9)
    moved = compose(np.broadcast_to(world, c2w.shape), c2w)
    assert_allclose(camera_z(moved, transform(world[0], points)), camera_z(c2w, points), atol=1e-12)


def test_unit_keeps_directions_and_leaves_zero_at_zero():
    vectors = np.random.default_rng(3).normal(size=(4, 5, 3)) * 10.0 ** np.arange(-6, 9, 3)[:, None]
    assert_allclose(np.linalg.norm(unit(vectors), axis=-1), np.ones((4, 5)), atol=1e-12)
    assert_allclose(unit(vectors) * np.linalg.norm(vectors, axis=-1, keepdims=True), vectors, rtol=1e-12)
    assert_array_equal(unit(np.zeros((2, 3))), np.zeros((2, 3)))


def test_look_at_puts_the_target_on_the_axis_and_up_upwards():
    centres = np.array([[3.0, 1.0, 2.0], [-2.0, 4.0, 0.5]])
    target = np.array([[0.1, 0.2, 0.3], [0.0, 0.0, 0.7]])
    up = np.array([0.0, 0.0, 1.0])
    w2c = invert(look_at(centres, target, up))
    seen = transform(w2c, target[:, None])[:, 0]
    assert_allclose(seen[:, :2], np.zeros((2, 2)), atol=1e-12)
    assert (seen[:, 2] > 0).all()
    higher = transform(w2c, (target + 0.1 * up)[:, None])[:, 0]
    assert (higher[:, 1] < 0).all(), "image y points down"


def test_flip_is_its_own_inverse_and_keeps_rotations():
    a = poses(10)
    flipped = flip_camera_axes(a)
    assert_array_equal(flip_camera_axes(flipped), a)
    assert_allclose(np.linalg.det(flipped[..., :3]), np.ones(10))
    assert_array_equal(flipped[..., 2], -a[..., 2])
    assert_array_equal(flipped[..., 3], a[..., 3])
