import pytest
import torch

from kronc_ns.geometry.alignment import Similarity, pose_errors, umeyama
from kronc_ns.geometry.rotations import so3_exp
from tests.geometry.test_poses import poses


def similarity(seed: int = 0) -> Similarity:
    draw = torch.randn(6, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return Similarity(torch.tensor(2.6, dtype=torch.float64), so3_exp(draw[:3]), draw[3:])


def test_umeyama_recovers_the_similarity():
    source = torch.randn(30, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    truth = similarity()
    found = umeyama(source, truth.apply(source))
    torch.testing.assert_close(found.scale, truth.scale)
    torch.testing.assert_close(found.rotation, truth.rotation)
    torch.testing.assert_close(found.translation, truth.translation)


def test_umeyama_never_reflects():
    source = torch.randn(30, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    mirrored = source * torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    assert torch.linalg.det(umeyama(source, mirrored).rotation) == pytest.approx(1.0)


def test_umeyama_minimises_the_squared_distance():
    generator = torch.Generator().manual_seed(5)
    source = torch.randn(20, 3, dtype=torch.float64, generator=generator)
    target = similarity().apply(source) + 0.1 * torch.randn(20, 3, dtype=torch.float64, generator=generator)
    best = umeyama(source, target)

    def cost(s: Similarity) -> float:
        return float((s.apply(source) - target).square().sum())

    for step in torch.randn(20, 3, dtype=torch.float64, generator=generator) * 1e-3:
        assert cost(best) <= cost(Similarity(best.scale, so3_exp(step) @ best.rotation, best.translation))
        assert cost(best) <= cost(Similarity(best.scale * (1 + step[0]), best.rotation, best.translation))
        assert cost(best) <= cost(Similarity(best.scale, best.rotation, best.translation + step))


def test_coincident_points_give_a_finite_translation():
    found = umeyama(torch.zeros(5, 3, dtype=torch.float64), torch.ones(5, 3, dtype=torch.float64))
    torch.testing.assert_close(
        found.apply(torch.zeros(1, 3, dtype=torch.float64)), torch.ones(1, 3, dtype=torch.float64)
    )


def test_pose_errors_do_not_see_the_world_frame():
    c2w = poses(12)
    rotation, translation = pose_errors(similarity().apply_to_poses(c2w), c2w)
    assert rotation.max() < 1e-5
    assert translation.max() < 1e-9


def test_pose_errors_measure_a_turned_camera():
    c2w = poses(12)
    turned = c2w.clone()
    turned[3, :, :3] = c2w[3, :, :3] @ so3_exp(torch.tensor([0.0, 0.1, 0.0], dtype=torch.float64))
    rotation, translation = pose_errors(turned, c2w)
    assert float(rotation[3]) == pytest.approx(5.72958, abs=1e-4)
    assert rotation[[0, 1, 2, 4]].max() < 1e-5
    assert translation.max() < 1e-9
