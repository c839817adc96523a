"""Algorithm 1 of the paper, and its six numbers of a rotation."""

import numpy as np
import pytest
import torch

from kronc_ns.geometry.alignment import pose_errors, umeyama
from kronc_ns.solve.adam import AdamConfig, AdamResult, minimise, rotation_from_r6, rotation_to_r6
from kronc_ns.synthetic.variations import noisy_poses
from tests.geometry.test_rotations import rotations
from tests.solve.test_objective import CAMERA, observed

TRUTH, DEPTHS, UV, VISIBLE, POINTS = observed()
START = noisy_poses(TRUTH, 3.0, 0.2, np.random.default_rng(0))


def run(config: AdamConfig, m: np.ndarray = VISIBLE, progress=None, device="cpu") -> AdamResult:
    return minimise(START, DEPTHS, UV, m, CAMERA, config, device, progress)


def test_exact_keypoints_give_exact_poses():
    result = run(AdamConfig(steps=6000))
    rotation, translation = pose_errors(result.c2w, TRUTH)
    assert rotation.max() < 0.01
    assert translation.max() < 0.001


def test_equal_seeds_give_equal_bits():
    first, second = run(AdamConfig(steps=50)), run(AdamConfig(steps=50))
    np.testing.assert_array_equal(first.c2w, second.c2w)
    np.testing.assert_array_equal(first.depths, second.depths)


def test_results_are_double_precision_as_everywhere():
    result = run(AdamConfig(steps=3))
    assert {x.dtype for x in (result.c2w, result.depths, result.points, result.path)} == {np.dtype(np.float64)}


def test_the_schedule_is_a_cosine_to_the_decay():
    """Adam's first step moves every parameter by the learning rate; the last ones by decay times it."""
    result = run(AdamConfig(steps=1, learning_rate=0.01))
    moved = np.abs(result.depths - DEPTHS)[VISIBLE > 0]
    np.testing.assert_allclose(moved, 0.01, rtol=1e-3)


def test_views_and_points_without_evidence_do_not_move():
    m = VISIBLE.copy()
    m[2] = 0
    result = run(AdamConfig(steps=100), m=m)
    np.testing.assert_allclose(result.c2w[2], START[2], rtol=1.3e-6, atol=1e-5)
    assert np.abs(result.c2w[3] - START[3]).max() > 1e-4
    np.testing.assert_allclose(result.depths[m == 0], DEPTHS[m == 0], rtol=1e-6)


def test_fixed_depths_stay_fixed():
    result = run(AdamConfig(steps=100, optimise_depths=False))
    np.testing.assert_array_equal(result.depths, DEPTHS.astype(np.float32))


def test_points_are_the_centroids_of_what_is_seen():
    m = VISIBLE.copy()
    m[:, 4] = 0
    result, seen = run(AdamConfig(steps=3000), m=m), m.any(0)
    aligned = umeyama(result.points[seen], POINTS[seen]).apply(result.points)
    assert np.abs(aligned - POINTS)[seen].max() < 0.01
    assert np.abs(result.points[4]).max() == 0.0


def test_patience_stops_early_only_when_asked():
    assert run(AdamConfig(steps=2000, learning_rate=1e-7)).steps == 2000
    assert run(AdamConfig(steps=2000, learning_rate=1e-7, patience=100)).steps < 300


def test_progress_is_reported_about_a_hundred_times():
    calls = []
    result = run(AdamConfig(steps=1000), progress=lambda step, value: calls.append((step, value)))
    assert 100 <= len(calls) <= 102
    assert calls[-1][0] == 1000
    assert calls[-1][1] < calls[0][1]
    assert result.history == {"step": [float(s) for s, _ in calls], "loss": [value for _, value in calls]}
    assert len(result.path) == len(calls)


def test_one_thread_computes_and_the_others_are_given_back():
    inside = []
    torch.set_num_threads(2)
    try:
        run(AdamConfig(steps=2), progress=lambda step, value: inside.append(torch.get_num_threads()))
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(1)
    assert set(inside) == {1}


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU on this machine")
def test_cuda_agrees_with_the_cpu():
    cpu, gpu = (run(AdamConfig(steps=200), device=device) for device in ("cpu", "cuda"))
    np.testing.assert_allclose(gpu.c2w, cpu.c2w, atol=1e-4, rtol=1e-4)


def test_r6_round_trip_and_scale_invariance():
    r = torch.from_numpy(rotations(50))
    torch.testing.assert_close(rotation_from_r6(rotation_to_r6(r)), r)
    torch.testing.assert_close(rotation_from_r6(3.7 * rotation_to_r6(r)), r)


def test_r6_of_anything_is_a_rotation():
    r = rotation_from_r6(torch.randn(100, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))
    torch.testing.assert_close(r.transpose(1, 2) @ r, torch.eye(3, dtype=r.dtype).expand_as(r))
    torch.testing.assert_close(torch.linalg.det(r), torch.ones(100, dtype=r.dtype))


def test_r6_jacobian_against_finite_differences():
    r6 = rotation_to_r6(torch.from_numpy(rotations(4))) * 1.3
    assert torch.autograd.gradcheck(rotation_from_r6, r6.requires_grad_())
