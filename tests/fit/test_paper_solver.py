"""From a scene to a solution by the paper's solver (Algorithm 1)."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.geometry.alignment import pose_errors, umeyama
from kronc_ns.geometry.poses import camera_z
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.scene import Scene
from kronc_ns.solution import Status, ViewStatus
from kronc_ns.solve.options import AdamConfig
from kronc_ns.synthetic.variations import noisy_poses
from tests.conftest import scene_of
from tests.fit.common import assert_stands_as, length_m, without_overlap

pytest.importorskip("torch")

QUICK = KroncConfig(solver="adam", adam=AdamConfig(steps=800, learning_rate=0.03))
BRIEF = KroncConfig(solver="adam", adam=AdamConfig(steps=30))
MEASURED = replace(QUICK, min_status="solved")


@pytest.fixture(scope="module")
def noisy(walk_capture) -> Scene:
    return scene_of(walk_capture, noisy_poses(walk_capture.c2w, 4.0, 0.5, np.random.default_rng(0)))


def test_solving_from_noisy_poses(noisy, walk_capture):
    solution = solve_scene(noisy, QUICK)
    assert solution.status is Status.CONVERGED
    assert solution.views_that_are(ViewStatus.SOLVED).all()
    before, _ = pose_errors(noisy.given_c2w, walk_capture.c2w)
    rotation, translation = pose_errors(solution.c2w, walk_capture.c2w)
    assert np.median(before) > 4.0
    assert np.median(rotation) < 0.6
    assert np.median(translation) < 0.06
    assert 0.2 < solution.rmse_px < 1.0  # half a pixel of noise per axis
    # given poses keep their world: no similarity brings the solution closer to them
    to_given = umeyama(solution.c2w[..., 3], noisy.given_c2w[..., 3])
    assert to_given.scale == pytest.approx(1.0, abs=1e-6)
    assert_allclose(to_given.rotation, np.eye(3), rtol=0, atol=1e-6)
    assert_allclose(to_given.translation, np.zeros(3), rtol=0, atol=1e-6)


def test_solving_from_the_circle_stands_the_car_upright(walk_capture):
    config = replace(QUICK, radius_m=5.0, adam=AdamConfig(steps=1500, learning_rate=0.03))
    solution = solve_scene(scene_of(walk_capture), config)
    assert solution.init == "circular"
    assert solution.status is Status.CONVERGED
    assert_stands_as(solution.points, walk_capture.points)


def test_the_cars_length_sets_the_scale(scene):
    config = replace(QUICK, car_length_m=5.5, radius_m=5.0)
    solution, free = solve_scene(scene, config), solve_scene(scene, replace(config, car_length_m=None))
    assert umeyama(free.points, solution.points).scale * length_m(free.points) == pytest.approx(5.5, rel=1e-3)
    assert length_m(solution.points) == pytest.approx(5.5, rel=1e-3)
    assert np.abs(solution.points[list(APOLLOCAR3D_66.wheels), 2]).mean() < 0.7, "still on the ground"


@pytest.mark.parametrize("init", ["circular", "auto"])  # auto tries one circle only, too
def test_the_wrong_direction_is_not_called_converged(walk_capture, init):
    solution = solve_scene(scene_of(walk_capture), replace(QUICK, init=init, direction="cw"))
    assert solution.init == "circular"
    assert solution.status is not Status.CONVERGED
    assert "other way" in solution.reason
    assert "init auto" in solution.reason


def test_a_poor_view_is_left_out_and_the_others_do_not_suffer(noisy, walk_capture):
    keypoints = noisy.keypoints.copy()
    keypoints[5, np.flatnonzero(keypoints[5, :, 2])[3:]] = 0  # three points left
    solution = solve_scene(replace(noisy, keypoints=keypoints), MEASURED)
    assert solution.views[5].status is ViewStatus.FAILED
    assert solution.views[5].reason == "3 keypoints, at least 4 are needed"
    assert np.isnan(solution.c2w[5]).all()
    kept = solution.views_that_are(ViewStatus.SOLVED)
    assert kept.sum() == 15
    assert np.median(pose_errors(solution.c2w[kept], walk_capture.c2w[kept])[0]) < 0.6
    # unless asked to leave it out, it is placed between its neighbours, the others as before
    whole = solve_scene(replace(noisy, keypoints=keypoints), QUICK)
    assert whole.views[5].status is ViewStatus.COMPLETED
    assert whole.views[5].reason == "placed between its neighbours: 3 keypoints, at least 4 are needed"
    assert_array_equal(whole.c2w[kept], solution.c2w[kept])
    assert pose_errors(whole.c2w, walk_capture.c2w)[0][5] < 6.0


def test_a_view_of_another_car_is_found_out(noisy):
    keypoints = noisy.keypoints.copy()
    seen = np.flatnonzero(keypoints[5, :, 2])
    keypoints[5, seen, :2] = keypoints[5, np.random.default_rng(0).permutation(seen), :2]
    for config, status in ((MEASURED, ViewStatus.FAILED), (QUICK, ViewStatus.COMPLETED)):
        solution = solve_scene(replace(noisy, keypoints=keypoints), config)
        assert solution.views[5].status is status
        assert "agree" in solution.views[5].reason
        assert solution.views_that_are(ViewStatus.SOLVED).sum() == 15


def test_same_seed_same_bits_and_the_seed_matters(noisy):
    # so early no pose is trusted (NaN), but points there are
    first, second, other = (solve_scene(noisy, replace(BRIEF, seed=seed)).points for seed in (0, 0, 1))
    assert np.isfinite(first).any()
    assert_array_equal(first, second)
    assert not np.array_equal(first, other, equal_nan=True)


def test_given_depths_speed_up_and_can_be_fixed(noisy, walk_capture):
    scene = replace(noisy, given_depths=camera_z(walk_capture.c2w, walk_capture.points))
    few = KroncConfig(solver="adam", adam=AdamConfig(steps=600))

    def centre_error(depth_init: str) -> float:
        solution = solve_scene(scene, replace(few, depth_init=depth_init))
        return float(np.median(pose_errors(solution.c2w, walk_capture.c2w)[1]))

    prior = centre_error("prior")
    assert prior < centre_error("random")
    assert centre_error("prior-fixed") < prior
    # 30 % noise on the depths: they recover, unless they may not move
    noise = 1 + 0.3 * np.random.default_rng(1).normal(size=scene.given_depths.shape)
    spoilt = replace(scene, given_depths=scene.given_depths * noise)
    for depth_init, status in (("prior", Status.CONVERGED), ("prior-fixed", Status.FAILED)):
        assert solve_scene(spoilt, replace(QUICK, depth_init=depth_init)).status is status


@pytest.mark.parametrize("views", [[], [0], [0, 4]])
def test_fewer_than_three_views_are_never_trusted(noisy, views):
    keypoints = np.zeros_like(noisy.keypoints)
    keypoints[views] = noisy.keypoints[views]
    solution = solve_scene(replace(noisy, keypoints=keypoints), QUICK)
    assert " of 16 views" in solution.reason
    assert solution.status is not Status.CONVERGED
    assert "template" not in solution.reason
    assert set(np.flatnonzero(solution.posed)) <= set(views)


def test_views_without_overlap_are_never_trusted(noisy):
    solution = solve_scene(without_overlap(noisy), replace(QUICK, init="given"))
    assert solution.status is not Status.CONVERGED
    assert solution.reason
