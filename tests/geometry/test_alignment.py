import numpy as np
import pytest
from numpy.testing import assert_allclose

from kronc_ns.geometry.alignment import Similarity, pose_errors, umeyama
from kronc_ns.geometry.rotations import so3_exp
from tests.geometry.test_poses import poses


def similarity(seed: int = 0) -> Similarity:
    draw = np.random.default_rng(seed).normal(size=6)
    return Similarity(2.6, so3_exp(draw[:3]), draw[3:])


def cloud(n: int, seed: int = 4) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, 3))


def test_umeyama_recovers_the_similarity():
    source, truth = cloud(30), similarity()
    found = umeyama(source, truth.apply(source))
    assert found.scale == pytest.approx(truth.scale)
    assert_allclose(found.rotation, truth.rotation, atol=1e-12)
    assert_allclose(found.translation, truth.translation, atol=1e-12)


def test_points_without_weight_do_not_count():
    source, truth = cloud(30), similarity()
    target = truth.apply(source)
    target[20:] += cloud(10, seed=6)
    found = umeyama(source, target, np.repeat([3.0, 0.0], [20, 10]))
    assert_allclose(found.apply(source), truth.apply(source), atol=1e-12)


def test_umeyama_never_reflects():
    source = cloud(30)
    assert np.linalg.det(umeyama(source, source * [1.0, -1.0, 1.0]).rotation) == pytest.approx(1.0)


def test_umeyama_minimises_the_squared_distance():
    source = cloud(20)
    target = similarity().apply(source) + 0.1 * cloud(20, seed=5)
    best = umeyama(source, target)

    def cost(s: Similarity) -> float:
        return float(np.square(s.apply(source) - target).sum())

    for step in 1e-3 * cloud(20, seed=6):
        assert cost(best) <= cost(Similarity(best.scale, so3_exp(step) @ best.rotation, best.translation))
        assert cost(best) <= cost(Similarity(best.scale * (1 + float(step[0])), best.rotation, best.translation))
        assert cost(best) <= cost(Similarity(best.scale, best.rotation, best.translation + step))


def test_coincident_points_give_a_finite_translation():
    found = umeyama(np.zeros((5, 3)), np.ones((5, 3)))
    assert_allclose(found.apply(np.zeros((1, 3))), np.ones((1, 3)))


def test_pose_errors_do_not_see_the_world_frame():
    c2w = poses(12)
    rotation, translation = pose_errors(similarity().apply_to_poses(c2w), c2w)
    assert rotation.max() < 1e-5
    assert translation.max() < 1e-9


def test_pose_errors_measure_a_turned_camera():
    c2w = poses(12)
    turned = c2w.copy()
    turned[3, :, :3] = c2w[3, :, :3] @ so3_exp(np.array([0.0, 0.1, 0.0]))
    rotation, translation = pose_errors(turned, c2w)
    assert rotation[3] == pytest.approx(5.72958, abs=1e-4)
    assert rotation[[0, 1, 2, 4]].max() < 1e-5
    assert translation.max() < 1e-9
