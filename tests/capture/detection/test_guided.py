from dataclasses import replace

import numpy as np
import pytest

from kronc_ns.capture.detection.detector import CarDetection
from kronc_ns.capture.detection.guided import expected_places, is_better, look_again
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.solution import Status
from kronc_ns.synthetic.scenes import make_capture
from tests.conftest import scene_of


class _Eye:
    """Sees every point that is expected in the image, almost there."""

    def __init__(self, scene):
        self._size, self._rng = np.array([scene.camera.width, scene.camera.height]), np.random.default_rng(0)

    def look_again(self, images, expected):
        for places in expected:
            seen = np.isfinite(places).all(1) & (places > 0).all(1) & (places < self._size).all(1)
            places = places + self._rng.normal(0, 0.5, places.shape)
            yield CarDetection(places, 0.9 * seen, np.zeros(4), 0.9, np.ones(len(places)))


@pytest.fixture(scope="module")
def solved():
    scene = scene_of(make_capture("walk", views=12, seed=1, noise_px=0.5))
    return scene, solve_scene(scene, KroncConfig())


def test_points_are_expected_where_they_were_found(solved):
    scene, solution = solved
    off = np.linalg.norm(expected_places(solution) - scene.keypoints[..., :2], axis=-1)
    assert np.median(off[scene.seen]) < 1.0


def test_views_with_a_pose_get_new_points_and_others_keep_theirs(solved, tmp_path):
    scene, solution = solved
    c2w = solution.c2w.copy()
    c2w[3] = np.nan
    looked = look_again(_Eye(scene), tmp_path, scene, replace(solution, c2w=c2w))
    np.testing.assert_array_equal(looked.keypoints[3], scene.keypoints[3])
    assert looked.seen[0].sum() > scene.seen[0].sum()
    again = solve_scene(looked, KroncConfig())
    assert is_better(again, solution)
    assert not is_better(solution, again)


def test_what_loses_a_view_or_trust_is_no_better(solved):
    _, solution = solved
    surer = [replace(view, sigma_trans_m=0.5 * view.sigma_trans_m) for view in solution.views]
    assert is_better(replace(solution, views=surer), solution)
    assert not is_better(replace(solution, views=surer, status=Status.WEAK), solution)
    assert not is_better(replace(solution, views=solution.views[:-1]), solution)
