import numpy as np
import pytest
from numpy.testing import assert_allclose

from kronc_ns.geometry.camera import Camera, rays, reproject
from kronc_ns.geometry.poses import look_at
from kronc_ns.geometry.triangulation import triangulate
from tests.geometry.test_alignment import similarity

CAMERA = Camera(400.0, 390.0, 240.0, 135.0, 480, 270)
UNSEEN, ONCE = 3, 7
NEAR_M = 1e-5  # along its only ray a point hangs on a weight of 1e-9, which leaves rounding of about 1e-6


@pytest.fixture
def problem() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Cameras about a cloud of points, the true points, the rays to them, and who sees what."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(12, 3))
    centres = 8 * rng.normal(size=(9, 3))
    centres[:, :2] += 8 * np.sign(centres[:, :2])
    c2w = look_at(centres, 0.3 * rng.normal(size=(9, 3)), np.array([0.0, 0.0, 1.0]))
    m = (rng.uniform(size=(9, 12)) < 0.7) * rng.uniform(0.2, 1.0, (9, 12))
    m[:, UNSEEN] = 0
    m[:, ONCE] = np.eye(9)[2]
    return c2w, points, rays(reproject(points, c2w, CAMERA), CAMERA), m


def test_exact_rays_meet_in_their_point(problem):
    c2w, points, directions, m = problem
    found = triangulate(c2w, directions, m)
    twice = (m > 0).sum(0) >= 2
    assert twice.sum() == 10
    assert_allclose(found[twice], points[twice], atol=1e-6)


def test_rays_that_do_not_see_a_point_do_not_count(problem):
    c2w, _, directions, m = problem
    wild = np.where(m[..., None] > 0, directions, np.random.default_rng(1).normal(size=directions.shape))
    assert_allclose(triangulate(c2w, wild, m), triangulate(c2w, directions, m), atol=1e-9)


def test_the_world_frame_and_its_scale_do_not_matter(problem):
    c2w, _, directions, m = problem
    noisy = directions + 0.01 * np.random.default_rng(2).normal(size=directions.shape)
    world = similarity()
    expected = world.apply(triangulate(c2w, noisy, m))
    assert_allclose(triangulate(world.apply_to_poses(c2w), noisy, m), expected, atol=NEAR_M)


def test_the_lengths_of_the_rays_do_not_matter(problem):
    c2w, _, directions, m = problem
    longer = directions * np.random.default_rng(3).uniform(0.1, 10, (*m.shape, 1))
    assert_allclose(triangulate(c2w, longer, m), triangulate(c2w, directions, m), atol=NEAR_M)


def test_points_minimise_the_weighted_squared_distance_to_their_rays(problem):
    c2w, _, directions, m = problem
    noisy = directions + 0.01 * np.random.default_rng(2).normal(size=directions.shape)
    world = noisy @ c2w[..., :3].swapaxes(1, 2)

    def cost(points: np.ndarray) -> np.ndarray:
        offset = points - c2w[:, None, :, 3]
        across = np.cross(offset, world) / np.linalg.norm(world, axis=-1, keepdims=True)
        return (m * np.square(across).sum(-1)).sum(0)

    best = triangulate(c2w, noisy, m)
    for step in 1e-3 * np.random.default_rng(4).normal(size=(20, 3)):
        assert (cost(best) <= cost(best + step) + 1e-12).all()


def test_what_no_camera_sees_is_at_their_mean_centre(problem):
    c2w, _, directions, m = problem
    assert_allclose(triangulate(c2w, directions, m)[UNSEEN], c2w[..., 3].mean(0), atol=1e-9)


def test_what_one_camera_sees_is_on_its_ray_nearest_to_their_mean_centre(problem):
    c2w, _, directions, m = problem
    ray, start, mean = c2w[2, :, :3] @ directions[2, ONCE], c2w[2, :, 3], c2w[..., 3].mean(0)
    expected = start + ray * (ray @ (mean - start)) / (ray @ ray)
    assert_allclose(triangulate(c2w, directions, m)[ONCE], expected, atol=NEAR_M)
