"""Detectors that know their noise: what they say of it decides how much each point counts."""

from dataclasses import replace

import numpy as np
import pytest

from kronc_ns.files.output import claim_output
from kronc_ns.files.record import read_solution, write_solution
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.synthetic.scenes import make_capture
from tests.conftest import scene_of


@pytest.fixture(scope="module")
def uneven():
    """A lap on which half of the points are six times as noisy as the others; and its truth."""
    rng = np.random.default_rng(7)
    capture = make_capture("walk", views=30, seed=7)
    scene = scene_of(capture)
    sigma = np.where(rng.uniform(size=scene.seen.shape) < 0.5, 0.7, 4.2) * scene.seen
    keypoints = scene.keypoints.copy()
    keypoints[..., :2] += sigma[..., None] * rng.normal(size=(*sigma.shape, 2))
    return replace(scene, keypoints=keypoints), sigma, capture.c2w


def test_what_is_known_of_the_noise_makes_poses_better(uneven):
    scene, sigma, truth = uneven

    def error(of):
        return np.median(pose_errors(solve_scene(of, KroncConfig()).c2w, truth)[0])

    assert error(replace(scene, sigma_px=sigma)) < 0.75 * error(scene)


def test_equal_noise_changes_nothing(uneven):
    scene, _, _ = uneven
    plain = solve_scene(scene, KroncConfig())
    told = solve_scene(replace(scene, sigma_px=2.0 * scene.visibility), KroncConfig())
    np.testing.assert_allclose(told.c2w, plain.c2w, atol=1e-9)


def test_sides_are_swapped_with_what_is_known_of_them(uneven):
    scene, sigma, _ = uneven
    scene = replace(scene, sigma_px=sigma)
    some = np.arange(len(scene)) % 3 == 0
    twice = scene.with_sides_swapped(some).with_sides_swapped(some)
    np.testing.assert_array_equal(twice.keypoints, scene.keypoints)
    np.testing.assert_array_equal(twice.sigma_px, sigma)
    once = scene.with_sides_swapped(some)
    np.testing.assert_array_equal(once.sigma_px > 0, once.seen)


def test_it_is_written_with_a_solution_and_read_again(uneven, tmp_path):
    scene, sigma, _ = uneven
    scene = replace(scene, sigma_px=sigma)
    claim_output(tmp_path / "out")
    write_solution(tmp_path / "out", scene, solve_scene(scene, KroncConfig()), tmp_path, "abc")
    again, _ = read_solution(tmp_path / "out")
    np.testing.assert_allclose(again.sigma_px, sigma, atol=1e-3)
