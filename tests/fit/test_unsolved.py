"""Given poses handed on as they are."""

from dataclasses import replace

import numpy as np
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene, solve_scenes
from kronc_ns.geometry.camera import reproject
from kronc_ns.solution import Status
from tests.conftest import scene_of

NONE = KroncConfig(solver="none")


def test_poses_are_those_that_were_given_and_never_called_converged(lap, lap_start):
    solution = solve_scene(scene_of(lap, lap_start), NONE)
    assert np.array_equal(solution.c2w, lap_start)
    assert solution.status is Status.WEAK
    assert "nothing was solved" in solution.reason
    assert solution.posed.all()
    assert (solution.solver, solution.iterations) == ("none", 0)


def test_points_say_where_the_car_is(lap, lap_start):
    points = solve_scene(scene_of(lap, lap_start), NONE).points
    known = np.isfinite(points).all(-1)
    assert known.sum() > 40
    assert np.abs(points[known].min(0) - lap.points.min(0)).max() < 0.8
    assert np.abs(points[known].max(0) - lap.points.max(0)).max() < 0.8


def test_a_point_far_from_all_others_is_none(lap):
    scene = scene_of(lap, lap.c2w)
    keypoints = scene.keypoints.copy()
    column = int((scene.seen.sum(0) >= 3).argmax())
    seen = np.flatnonzero(scene.seen[:, column])
    keypoints[seen[2:], column, 2] = 0
    behind = lap.c2w[seen[0], :, 3] + 15 * lap.c2w[seen[0], :, 2]
    keypoints[seen[:2], column, :2] = reproject(behind[None], lap.c2w[seen[:2]], lap.camera)[:, 0]
    points = solve_scene(replace(scene, keypoints=keypoints), NONE).points
    assert not np.isfinite(points[column]).any()


def test_without_poses_there_is_nothing_to_hand_on(lap, lap_start):
    with pytest.raises(KroncError, match="expected a transform_matrix in every frame"):
        solve_scene(scene_of(lap), NONE)
    good, bad = solve_scenes([scene_of(lap, lap_start), scene_of(lap)], NONE)
    assert not isinstance(good, KroncError)
    assert isinstance(bad, KroncError)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"init": "circular"}, "hands given poses on as they are"),
        ({"refine_focal": True}, "none takes the intrinsics as given"),
        ({"depth_init": "prior"}, "none has no depths"),
    ],
)
def test_what_only_a_solver_can_do_is_refused(options, message):
    with pytest.raises(KroncError, match=message):
        KroncConfig(solver="none", **options)
