import pytest
import torch

from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.solve.adam import AdamConfig, minimise
from kronc_ns.synthetic.variations import noisy_poses
from tests.test_objective import CAMERA, problem


def run(config: AdamConfig, seed: int = 0, m=None, progress=None):
    c2w, z, uv, visible, _ = problem()
    start = noisy_poses(c2w, 3.0, 0.2, torch.Generator().manual_seed(seed))
    m = visible if m is None else m
    result = minimise(start, z, uv, m, (CAMERA.fx, CAMERA.fy), (CAMERA.cx, CAMERA.cy), config, progress)
    return result, start, c2w, m


def test_exact_keypoints_give_exact_poses():
    result, _, truth, _ = run(AdamConfig(steps=3000))
    rotation, translation = pose_errors(result.c2w, truth)
    assert rotation.max() < 0.01
    assert translation.max() < 0.001


def test_equal_seeds_give_equal_bits():
    first, *_ = run(AdamConfig(steps=50))
    second, *_ = run(AdamConfig(steps=50))
    assert torch.equal(first.c2w, second.c2w)
    assert torch.equal(first.depths, second.depths)


def test_the_schedule_is_a_cosine_to_the_decay():
    """Adam's first step moves every parameter by the learning rate; the last ones by decay times it."""
    z = problem()[1]
    result, _, _, m = run(AdamConfig(steps=1, learning_rate=0.01))
    moved = (result.depths - z)[m > 0].abs()
    torch.testing.assert_close(moved, torch.full_like(moved, 0.01), rtol=1e-3, atol=0)


def test_views_and_points_without_evidence_do_not_move():
    m = problem()[3].clone()
    m[2] = 0
    result, start, _, _ = run(AdamConfig(steps=100), m=m)
    torch.testing.assert_close(result.c2w[2], start[2])
    assert (result.c2w[3] - start[3]).abs().max() > 1e-4
    torch.testing.assert_close(result.depths[m == 0], problem()[1][m == 0])


def test_fixed_depths_stay_fixed():
    result, _, _, _ = run(AdamConfig(steps=100, optimise_depths=False))
    assert torch.equal(result.depths, problem()[1])


def test_patience_stops_early_only_when_asked():
    full, *_ = run(AdamConfig(steps=2000, learning_rate=1e-7))
    early, *_ = run(AdamConfig(steps=2000, learning_rate=1e-7, patience=100))
    assert full.steps == 2000
    assert early.steps < 300


def test_progress_is_reported_about_a_hundred_times():
    calls = []
    run(AdamConfig(steps=1000), progress=lambda step, value: calls.append((step, value)))
    assert 100 <= len(calls) <= 102
    assert calls[-1][0] == 1000
    assert calls[-1][1] < calls[0][1]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU on this machine")
def test_cuda_agrees_with_the_cpu():
    c2w, z, uv, m, _ = problem()
    start = noisy_poses(c2w, 3.0, 0.2, torch.Generator().manual_seed(0))
    arguments = ((CAMERA.fx, CAMERA.fy), (CAMERA.cx, CAMERA.cy), AdamConfig(steps=200))
    cpu = minimise(start, z, uv, m, *arguments)
    gpu = minimise(start.cuda(), z.cuda(), uv.cuda(), m.cuda(), *arguments)
    torch.testing.assert_close(gpu.c2w.cpu(), cpu.c2w, atol=1e-6, rtol=1e-6)
