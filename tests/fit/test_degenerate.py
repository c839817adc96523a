"""Inputs that tell too little or nothing: they end in a status, never in a traceback or a NaN."""

import json
from dataclasses import replace

import numpy as np
import pytest

from kronc_ns.files.output import claim_output
from kronc_ns.files.record import write_solution
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.geometry.alignment import umeyama
from kronc_ns.geometry.camera import reproject
from kronc_ns.geometry.poses import camera_z, make_pose, posed
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.keypoints.schema import APOLLOCAR3D_66, KeypointSchema
from kronc_ns.scene import Scene
from kronc_ns.show.report import write_report
from kronc_ns.solution import Solution, Status, ViewStatus
from kronc_ns.solve.options import AdamConfig, LmConfig
from kronc_ns.synthetic.scenes import make_capture
from tests.conftest import scene_of
from tests.fit.common import PLAIN

VIEWS = 9
CAPTURE = make_capture("walk", views=VIEWS, seed=7, noise_px=0.5)


def pictures(c2w: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Every point from every pose, half a pixel of noise."""
    noise = np.random.default_rng(0).normal(size=(len(c2w), len(points), 2))
    uv = reproject(points, c2w, CAPTURE.camera) + 0.5 * noise
    seen = camera_z(c2w, points) > 0
    return np.concatenate([np.where(seen[..., None], uv, 0.0), seen[..., None]], axis=-1)


def only(views: list[int]) -> np.ndarray:
    keypoints = np.zeros_like(CAPTURE.keypoints)
    keypoints[views] = CAPTURE.keypoints[views]
    return keypoints


def thinned(count: int, offset: int = 0) -> np.ndarray:
    """``count`` points of each view, others in each view by ``offset``."""
    everything, keypoints = pictures(CAPTURE.c2w, CAPTURE.points), np.zeros_like(CAPTURE.keypoints)
    for i in range(VIEWS):
        chosen = slice(offset * i, offset * i + count)
        keypoints[i, chosen] = everything[i, chosen]
    return keypoints


def one_place() -> np.ndarray:
    turn = so3_exp(np.linspace(-0.15, 0.15, VIEWS)[:, None] * [0.0, 1.0, 0.0])
    rotation, centre = CAPTURE.c2w[0, :, :3], CAPTURE.c2w[0, :, 3]
    return pictures(make_pose(rotation @ turn, np.tile(centre, (VIEWS, 1))), CAPTURE.points)


def flat(axis: int) -> np.ndarray:
    points = CAPTURE.points.copy()
    points[:, axis] = 0.5
    return pictures(CAPTURE.c2w, points)


def one_pixel(everything: bool) -> np.ndarray:
    keypoints = np.ones_like(CAPTURE.keypoints) if everything else CAPTURE.keypoints.copy()
    keypoints[..., :2] = [240.0, 135.0]
    return np.where(keypoints[..., 2:] > 0, keypoints, 0.0)


def anywhere() -> np.ndarray:
    keypoints = CAPTURE.keypoints.copy()
    keypoints[..., :2] = np.random.default_rng(0).random((VIEWS, 66, 2)) * [480.0, 270.0]
    return keypoints


KEYPOINTS = {
    "all cameras in one place": one_place,
    "all points in a level plane": lambda: flat(2),
    "all points in an upright plane": lambda: flat(1),
    "one view": lambda: only([3]),
    "two views": lambda: only([3, 4]),
    "two views of opposite sides": lambda: only([0, 4]),
    "views without overlap": lambda: thinned(5, 6),
    "no keypoints": lambda: only([]),
    "one view again and again": lambda: CAPTURE.keypoints[[3] * VIEWS],
    "what is seen in one pixel": lambda: one_pixel(everything=False),
    "everything in one pixel": lambda: one_pixel(everything=True),
    "two points a view": lambda: thinned(2),
    "four points a view, always the same": lambda: thinned(4),
    "keypoints anywhere": anywhere,
    "keypoints far outside of the image": lambda: CAPTURE.keypoints * [1e6, 1e6, 1.0],
}
"""Name of the trouble: keypoints of nine views."""

TEMPLATE_TELLS = {"two views", "all cameras in one place", "one view again and again"}
"""Trouble that is none where the usual shape of cars is known: sigmas say how much that is worth."""
UNTRUSTED = KEYPOINTS.keys() - TEMPLATE_TELLS - {"all points in a level plane", "all points in an upright plane"}
FAILED = {"no keypoints", "two points a view", "keypoints anywhere", "keypoints far outside of the image"}


def scene_with(trouble: str, schema: KeypointSchema) -> Scene:
    return replace(scene_of(CAPTURE), keypoints=KEYPOINTS[trouble](), schema=schema)


def refuse(token: str) -> None:
    raise AssertionError(f"{token} is no JSON")


def assert_says_what_it_is(solution: Solution, trouble: str, scene: Scene, folder) -> None:
    if trouble in UNTRUSTED or (trouble in TEMPLATE_TELLS and scene.schema is PLAIN):
        assert solution.status is not Status.CONVERGED
    if trouble in FAILED:
        assert solution.status is Status.FAILED
    assert solution.reason
    assert "\n" not in solution.reason
    assert "nan" not in solution.reason
    assert posed(solution.c2w).tolist() == solution.posed.tolist()
    for view in solution.views:
        assert view.reason or view.status is ViewStatus.SOLVED
    claim_output(folder)
    write_solution(folder, scene, solution, folder.parent, "inputs")
    for file in ("kronc.json", "transforms.json"):
        json.loads((folder / file).read_text(), parse_constant=refuse)
    assert len(json.loads((folder / "transforms.json").read_text())["frames"]) == solution.posed.sum()


@pytest.mark.parametrize("trouble", KEYPOINTS)
@pytest.mark.parametrize(("schema", "init"), [(APOLLOCAR3D_66, "template"), (PLAIN, "circular")])
def test_trouble_from_one_start_ends_in_a_status(trouble, schema, init, tmp_path):
    scene = scene_with(trouble, schema)
    steps = 40 if init == "template" else 200
    solution = solve_scene(scene, KroncConfig(init=init, lm=LmConfig(iterations=steps)))
    assert_says_what_it_is(solution, trouble, scene, tmp_path / "out")


@pytest.mark.parametrize("trouble", KEYPOINTS)
@pytest.mark.parametrize("schema", [APOLLOCAR3D_66, PLAIN])
def test_trouble_from_every_start_ends_in_a_status(trouble, schema, tmp_path):
    scene = scene_with(trouble, schema)
    assert_says_what_it_is(solve_scene(scene), trouble, scene, tmp_path / "out")
    if trouble in FAILED - {"no keypoints"}:  # no such scene can be read
        assert "failed" in write_report(tmp_path / "out").read_text()


@pytest.mark.parametrize("trouble", KEYPOINTS)
@pytest.mark.parametrize("options", [{"refine_focal": True, "refine_k1": True}, {"min_status": "solved"}])
def test_trouble_with_options_ends_in_a_status(trouble, options, tmp_path):
    scene = scene_with(trouble, APOLLOCAR3D_66)
    assert_says_what_it_is(
        solve_scene(scene, KroncConfig(init="template", **options)), trouble, scene, tmp_path / "out"
    )


@pytest.mark.parametrize(
    "trouble", ["no keypoints", "two points a view", "one view", "two views", "keypoints anywhere"]
)
def test_trouble_for_adam_ends_in_a_status(trouble, tmp_path):
    scene = scene_with(trouble, PLAIN)
    solution = solve_scene(scene, KroncConfig(solver="adam", adam=AdamConfig(steps=50)))
    assert_says_what_it_is(solution, trouble, scene, tmp_path / "out")


@pytest.mark.parametrize("views", [1, 2, 3, 4])
@pytest.mark.parametrize("schema", [APOLLOCAR3D_66, PLAIN])
def test_scenes_of_a_few_views_are_scenes(views, schema, tmp_path):
    capture = make_capture("walk", views=views, seed=1, noise_px=0.3)
    scene = replace(scene_of(capture), schema=schema)
    solution = solve_scene(scene, KroncConfig(init="template" if schema is APOLLOCAR3D_66 else "circular"))
    assert_says_what_it_is(solution, "", scene, tmp_path / "out")


def test_a_single_view_of_a_car_is_placed_by_the_template():
    scene = scene_with("one view", APOLLOCAR3D_66)
    solution = solve_scene(scene)
    assert solution.status is Status.WEAK
    assert "template" in solution.reason
    assert solution.views_that_are(ViewStatus.COMPLETED).tolist() == [i == 3 for i in range(VIEWS)]
    assert solution.posed.tolist() == [i == 3 for i in range(VIEWS)]
    assert np.linalg.norm(solution.c2w[3, :, 3] - CAPTURE.c2w[3, :, 3]) < 0.8


@pytest.mark.parametrize("trouble", ["all cameras in one place", "one view again and again", "one view"])
def test_the_sigmas_know_that_only_the_template_tells(trouble):
    solution = solve_scene(scene_with(trouble, APOLLOCAR3D_66), KroncConfig(init="template"))
    walk = solve_scene(scene_of(CAPTURE), KroncConfig(init="template"))
    place = 0 if trouble == "all cameras in one place" else 3
    sigma, usual = solution.views[3].sigma_trans_m, walk.views[3].sigma_trans_m
    assert sigma is not None
    assert usual is not None
    assert sigma > 2 * usual
    known = np.isfinite(solution.points).all(-1)
    to_truth = umeyama(solution.points[known], CAPTURE.points[known])
    centre = to_truth.apply(solution.c2w[3, :, 3])
    assert np.linalg.norm(centre - CAPTURE.c2w[place, :, 3]) < 3 * sigma


@pytest.mark.parametrize("seed", [162, 251])
def test_a_focal_length_that_the_solver_lets_vanish_is_no_error(seed):
    """Four views, few points, many of them wrong: the smallest picture of the car is the best."""
    scene = scene_of(make_capture("carpatch", views=4, seed=seed, noise_px=0.6, missing=0.68, outliers=0.37))
    camera = replace(scene.camera, fx=0.85 * scene.camera.fx, fy=0.85 * scene.camera.fy)
    solution = solve_scene(replace(scene, camera=camera), KroncConfig(refine_focal=True))
    assert solution.status is not Status.CONVERGED
    assert solution.camera.fx > 1
