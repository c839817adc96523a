import torch

from kronc_ns.benchmark.likelihood import maximum_likelihood
from kronc_ns.benchmark.poses import capture_scene
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.init import noisy_poses
from kronc_ns.pipeline import KroncConfig, solve_scene
from kronc_ns.solve.adam import AdamConfig
from kronc_ns.synthetic.scenes import make_capture


def test_maximum_likelihood_finds_the_truth_of_exact_keypoints():
    capture = make_capture("walk", views=8, seed=11)
    points = torch.from_numpy(capture.car.keypoints)
    moved = points + 0.02 * torch.randn(points.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    found = maximum_likelihood(capture_scene(capture), capture.c2w, moved, robust=False)
    rotation, translation = pose_errors(found, capture.c2w)
    assert rotation.max() < 0.05
    assert translation.max() < 0.005


def test_no_solver_beats_it_by_much():
    capture = make_capture("walk", views=12, seed=12, noise_px=1.0)
    given = noisy_poses(capture.c2w, 4.0, 0.5, torch.Generator().manual_seed(0))
    solved = solve_scene(capture_scene(capture, given), KroncConfig(adam=AdamConfig(steps=1500)))
    best = maximum_likelihood(
        capture_scene(capture), capture.c2w, torch.from_numpy(capture.car.keypoints), robust=False
    )
    assert pose_errors(best, capture.c2w)[1].mean() < 1.1 * pose_errors(solved.c2w, capture.c2w)[1].mean()
