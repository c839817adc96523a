"""What the solver makes of starts, and telling the right one from the wrong ones."""

from dataclasses import replace

import pytest
import torch

from kronc_ns.fit.attempts import adjust_starts, measured, misfit
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.starts import start_from_poses, start_from_template
from kronc_ns.synthetic.scenes import make_capture
from tests.conftest import scene_of

CONFIG = KroncConfig()


def solved(scene, c2w):
    return adjust_starts([start_from_poses("given", scene, c2w)], KroncConfig())


def test_right_starts_leave_less_unexplained_than_wrong_ones(lap, lap_start):
    scene = scene_of(lap)
    backwards = start_from_poses("backwards", scene, lap_start.flip(0))
    inside_out = start_from_poses("turned", scene, torch.cat([lap_start[..., :3], -lap_start[..., 3:]], dim=-1))
    attempts = adjust_starts([start_from_poses("right", scene, lap_start), backwards, inside_out], CONFIG)
    right, *wrong = map(misfit, attempts)
    assert 0 <= right < 0.05
    assert all(right + 0.1 < other <= 1 for other in wrong)


def test_misfit_counts_views_that_take_no_part(lap, lap_start):
    scene = scene_of(lap)
    (whole,) = solved(scene, lap_start)
    half = torch.arange(20) < 10
    without = replace(whole, start=replace(whole.start, used=whole.start.used & half))
    share = float((scene.visibility[~half]).sum() / scene.visibility.sum())
    assert misfit(without) == pytest.approx(misfit(whole) + share, abs=0.05)


def test_starts_are_solved_together_as_they_are_alone(lap, lap_start):
    scene, small = scene_of(lap), scene_of(make_capture("walk", views=7, seed=5, noise_px=0.7))
    starts = [
        start_from_poses("given", scene, lap_start),
        start_from_template(small),
        start_from_template(scene),
        start_from_poses("given", scene, lap.c2w),
    ]
    together = adjust_starts(starts, CONFIG)
    for one, attempt in zip(starts, together, strict=True):
        (alone,) = adjust_starts([one], CONFIG)
        assert attempt.start.name == one.name
        assert len(attempt.start.scene) == len(one.scene)
        torch.testing.assert_close(attempt.start.c2w, alone.start.c2w, rtol=0, atol=1e-7)
        torch.testing.assert_close(attempt.covariance, alone.covariance, rtol=1e-4, atol=1e-12)
        assert attempt.inlier.equal(alone.inlier)


def test_another_solvers_result_is_measured_alike(lap, lap_start):
    scene = scene_of(lap)
    (ours,) = adjust_starts([start_from_poses("given", scene, lap_start)], CONFIG)
    theirs = measured(ours.start, ours.initial_c2w, 3, {}, ours.path)
    assert theirs.sigma_px == pytest.approx(ours.sigma_px, rel=0.25)
    assert (theirs.inlier == ours.inlier).double().mean() > 0.99
    ratio = theirs.covariance.diagonal(dim1=1, dim2=2).sqrt() / ours.covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert 0.6 < float(ratio.median()) < 1.6
