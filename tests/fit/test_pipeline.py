"""From a scene to a solution by the default solver, from wherever the inputs allow."""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from kronc_ns.errors import KroncError
from kronc_ns.files.output import claim_output
from kronc_ns.files.record import write_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene, solve_scenes
from kronc_ns.geometry.alignment import Similarity, pose_errors, umeyama
from kronc_ns.geometry.rotations import rotation_angle_deg, so3_exp
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status, ViewStatus
from kronc_ns.solve.options import LmConfig
from kronc_ns.synthetic.car import CarShape, build_car
from kronc_ns.synthetic.scenes import Capture, default_camera, make_capture, observe, walk_poses
from kronc_ns.synthetic.variations import reverse, shuffle, swap_sides
from tests.conftest import scene_of
from tests.fit.common import PLAIN, assert_stands_as, length_m, without_overlap


def assert_recovered(solution: Solution, capture: Capture, degrees: float = 1.0) -> None:
    assert solution.status is Status.CONVERGED, solution.reason
    assert solution.posed.all()
    assert solution.views_that_are(ViewStatus.SOLVED).mean() >= 0.95
    assert pose_errors(solution.c2w, capture.c2w)[0].mean() < degrees


def walk(views: int = 20, noise_px: float = 1.0, seed: int = 3, **options) -> Capture:
    rng = np.random.default_rng(seed)
    return observe(build_car(CarShape()), walk_poses(views, rng, **options), default_camera("walk"), rng, noise_px)


# ---- where it starts

CAPTURES = {
    "a walk": lambda: walk(),
    "a hemisphere": lambda: make_capture("carpatch", views=20, seed=3, noise_px=1.0),
    "clockwise": lambda: walk(clockwise=True),
    "half a lap": lambda: walk(laps=0.5),
    "a lap and a half": lambda: walk(30, laps=1.5),
    "the last view first": lambda: reverse(walk()),
    "in any order": lambda: shuffle(walk(), np.random.default_rng(0)),
    "with one detection in ten wrong": lambda: make_capture("walk", views=20, seed=3, noise_px=1.0, outliers=0.1),
}


@pytest.mark.parametrize("name", CAPTURES)
def test_no_initial_pose_is_needed(name):
    capture = CAPTURES[name]()
    solution = solve_scene(scene_of(capture))
    assert_recovered(solution, capture)
    assert solution.solver == "lm"
    assert_stands_as(solution.points, capture.points)


def test_the_reason_says_where_it_started(scene, solution, given_solution):
    assert "start: template" in solution.reason
    assert "start: given" in given_solution.reason
    assert "start: circular" in solve_scene(scene, KroncConfig(init="circular", radius_m=5.0)).reason


def test_useless_given_poses_do_no_harm(lap):
    elsewhere = lap.c2w[np.random.default_rng(0).permutation(20)]
    solution = solve_scene(scene_of(lap, elsewhere))
    assert_recovered(solution, lap)
    assert "start: " in solution.reason
    to_truth = umeyama(solution.c2w[..., 3], lap.c2w[..., 3])
    assert to_truth.scale == pytest.approx(1.0, abs=0.1), "their scale is as useless"


def test_given_poses_keep_their_frame_and_scale(lap, lap_start, solution):
    world = Similarity(0.4, so3_exp(np.array([0.4, -1.1, 0.7])), np.array([5.0, -2.0, 3.0]))
    given = world.apply_to_poses(lap_start)
    there = solve_scene(scene_of(lap, given))
    assert there.init == "given"
    assert_recovered(there, lap)
    to_given = umeyama(there.c2w[..., 3], given[..., 3])
    assert to_given.scale == pytest.approx(1.0, abs=1e-6)
    assert rotation_angle_deg(to_given.rotation) < 1e-4
    assert np.linalg.norm(to_given.translation) < 1e-6
    sigma, metres = (np.array([view.sigma_trans_m for view in one.views]) for one in (there, solution))
    assert np.median(sigma / metres) == pytest.approx(0.4, rel=0.05)


@pytest.mark.parametrize("direction", ["ccw", "cw"])
def test_something_without_a_template_needs_no_direction(direction):
    capture = walk(10, noise_px=0.5, clockwise=True)
    scene = replace(scene_of(capture), schema=PLAIN)
    solution = solve_scene(scene, KroncConfig(direction=direction, radius_m=5.0))
    assert_recovered(solution, capture)
    assert solution.init.startswith("circular (cw")
    assert np.linalg.norm(solution.c2w[..., 3], axis=-1).mean() == pytest.approx(5.0, rel=0.01)
    up = -solution.c2w[..., 1].mean(0)
    assert up[2] / np.linalg.norm(up) > 0.99


@pytest.mark.parametrize("options", [{"init": "template"}, {"car_length_m": 4.0}])
def test_something_without_a_template_refuses_what_needs_one(scene, options):
    with pytest.raises(KroncError, match="things-66"):
        solve_scene(replace(scene, schema=PLAIN), KroncConfig(**options))


def test_real_photos_from_the_circle_alone(spin_suv):
    from kronc_ns.files.presets import load_config
    from kronc_ns.files.transforms import read_poses

    scene = load_scene(spin_suv)
    solution = solve_scene(scene, load_config("turntable"))
    reference = read_poses(spin_suv / "reference.json")
    assert solution.status is Status.CONVERGED
    assert solution.views_that_are(ViewStatus.SOLVED).all()
    rotation, translation = pose_errors(solution.c2w, np.stack([reference[name] for name in scene.names]))
    assert np.median(rotation) <= 0.6
    assert np.median(translation) <= 0.10


# ---- scale and intrinsics


@pytest.mark.parametrize("given", [False, True])
def test_the_cars_length_sets_the_scale(scene, given_scene, solution, given_solution, given):
    free = given_solution if given else solution
    scaled = solve_scene(given_scene if given else scene, KroncConfig(car_length_m=5.5))
    growth = umeyama(free.points, scaled.points).scale
    assert growth * length_m(free.points) == pytest.approx(5.5, rel=1e-3)
    if not given:
        assert length_m(scaled.points) == pytest.approx(5.5, rel=1e-3)
        assert np.abs(scaled.points[list(APOLLOCAR3D_66.wheels), 2]).mean() < 0.7, "still on the ground"


@pytest.mark.parametrize("factor", [0.75, 1.25])
def test_a_focal_length_a_quarter_off_is_found(factor):
    capture = make_capture("walk", views=30, seed=3, noise_px=1.0)
    wrong = replace(capture.camera, fx=400.0 * factor, fy=400.0 * factor)
    solution = solve_scene(replace(scene_of(capture), camera=wrong), KroncConfig(refine_focal=True))
    assert solution.camera.fx == pytest.approx(400.0, rel=0.015)
    assert solution.camera.fy == pytest.approx(400.0, rel=0.015)
    assert_recovered(solution, capture)
    assert solution.median_px < 1.5


def bent(capture: Capture, k1: float) -> Scene:
    """The scene through a lens with distortion; its camera does not know."""
    scene, lens = scene_of(capture), replace(capture.camera, k1=k1)
    there = np.where(scene.seen[..., None], lens.distort(scene.uv), scene.uv)
    return replace(scene, keypoints=np.concatenate([there, scene.keypoints[..., 2:]], axis=-1))


def test_radial_distortion_is_found():
    capture = make_capture("walk", views=40, seed=3, noise_px=0.5)
    solution = solve_scene(bent(capture, -0.05), KroncConfig(refine_k1=True))
    assert solution.camera.k1 == pytest.approx(-0.05, rel=0.2)
    assert_recovered(solution, capture, 0.5)
    both = solve_scene(
        replace(bent(capture, -0.05), camera=replace(capture.camera, fx=360.0, fy=360.0)),
        KroncConfig(refine_k1=True, refine_focal=True),
    )
    assert both.camera.k1 == pytest.approx(-0.05, rel=0.3)
    assert both.camera.fx == pytest.approx(400.0, rel=0.02)


def test_intrinsics_are_left_alone_unless_asked(scene, solution):
    assert solution.camera == scene.camera


# ---- what it makes of the detections


def test_confidences_count():
    capture = make_capture("walk", views=16, seed=5, noise_px=0.3)
    rng = np.random.default_rng(0)
    noise, doubtful = 4.0 * rng.normal(size=(16, 66, 2)), rng.random((16, 66)) < 0.5
    keypoints = capture.keypoints.copy()
    keypoints[..., :2] += np.where((doubtful & (keypoints[..., 2] > 0))[..., None], noise, 0.0)
    told, scaled = keypoints.copy(), keypoints.copy()
    told[..., 2] *= np.where(doubtful, 0.01, 1.0)
    scaled[..., 2] *= 0.37
    flat, weighted, same = (solve_scene(replace(scene_of(capture), keypoints=k)) for k in (keypoints, told, scaled))
    error = [pose_errors(solution.c2w, capture.c2w)[0].mean() for solution in (flat, weighted)]
    assert error[1] < 0.8 * error[0]
    assert_allclose(same.c2w, flat.c2w, rtol=0, atol=1e-6)


@pytest.mark.parametrize("views", [[], [0], [0, 4]])
def test_fewer_than_three_views_are_held_by_the_template_and_not_trusted(given_scene, views):
    keypoints = np.zeros_like(given_scene.keypoints)
    keypoints[views] = given_scene.keypoints[views]
    solution = solve_scene(replace(given_scene, keypoints=keypoints))
    assert f"{len(views)} of 20 views" in solution.reason
    assert solution.status is (Status.WEAK if views else Status.FAILED)
    assert solution.posed.tolist() == [i in views for i in range(20)]


def test_views_without_overlap_are_never_trusted(given_scene):
    solution = solve_scene(without_overlap(given_scene), KroncConfig(init="given", lm=LmConfig(iterations=40)))
    assert solution.status is not Status.CONVERGED
    assert solution.reason


# ---- what it says


def test_a_solver_that_ran_out_of_steps_says_so(given_scene):
    solution = solve_scene(given_scene, KroncConfig(init="given", lm=LmConfig(iterations=3)))
    assert solution.status is Status.WEAK
    assert "still moving after 3 steps" in solution.reason


def test_every_solved_view_has_sigmas_of_the_right_size():
    share = []
    for seed in range(4):
        capture = make_capture("walk", views=16, seed=20 + seed, noise_px=1.0)
        solution = solve_scene(scene_of(capture))
        known = np.isfinite(solution.points).all(-1)
        aligned = umeyama(solution.points[known], capture.points[known]).apply_to_poses(solution.c2w)
        angle = rotation_angle_deg(aligned[..., :3].swapaxes(-1, -2) @ capture.c2w[..., :3])
        centre = np.linalg.norm((aligned - capture.c2w)[..., 3], axis=-1)
        sigma = np.array([[view.sigma_rot_deg, view.sigma_trans_m] for view in solution.views])
        share.append(np.stack([angle, centre], axis=1) / sigma)
    rms = np.sqrt(np.square(np.concatenate(share)).mean(0))
    assert (rms > 0.75).all()
    assert (rms < 1.25).all()


def test_the_result_says_which_views_were_swapped_and_holds_no_nan(tmp_path, lap):
    swapped, chosen = swap_sides(lap, 0.15, np.random.default_rng(1))
    keypoints = swapped.keypoints.copy()
    hidden = int(np.flatnonzero(~chosen)[9])
    keypoints[hidden] = 0
    scene = replace(scene_of(swapped), keypoints=keypoints)
    solution = solve_scene(scene)
    claim_output(tmp_path / "out")
    write_solution(tmp_path / "out", scene, solution, tmp_path, "inputs")

    def refuse(token):
        raise AssertionError(f"{token} is no JSON")

    report = json.loads((tmp_path / "out/kronc.json").read_text(), parse_constant=refuse)
    assert [view["swapped"] for view in report["views"]] == chosen.tolist()
    assert [view["status"] for view in report["views"]] == ["completed" if i == hidden else "solved" for i in range(20)]
    for view in report["views"]:
        assert view["sigma_rot_deg"] > 0
        assert view["sigma_trans_m"] > 0


def test_the_same_input_gives_the_same_bits(scene, solution):
    again = solve_scene(scene)
    assert_array_equal(again.c2w, solution.c2w)
    assert_array_equal(again.points, solution.points)
    assert again.reason == solution.reason


def test_nothing_of_the_scene_is_changed(given_scene):
    before = given_scene.keypoints.copy(), given_scene.given_c2w.copy()
    solve_scene(given_scene)
    assert_array_equal(given_scene.keypoints, before[0])
    assert_array_equal(given_scene.given_c2w, before[1])


def test_progress_is_told_step_by_step(given_scene, given_solution):
    told = []
    solution = solve_scene(given_scene, progress=lambda *step: told.append(step))
    assert [step for step, _, _ in told] == list(range(1, solution.iterations + 1))
    assert {steps for _, steps, _ in told} == {LmConfig().iterations}
    assert [loss for _, _, loss in told] == list(given_solution.history["loss"])


def test_an_error_takes_the_place_of_its_scene_only(scene, given_scene, given_solution):
    done = []
    config = KroncConfig(init="given")
    bad, good = solve_scenes([scene, given_scene], config, lambda *step: done.append(step[:2]))
    assert isinstance(bad, KroncError)
    assert isinstance(good, Solution)
    assert_array_equal(good.c2w, given_solution.c2w)
    assert done == [(1, 2), (2, 2)]


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (KroncConfig(init="given"), "transform_matrix"),
        (KroncConfig(solver="adam", depth_init="prior"), "depth_file_path"),
        (KroncConfig(solver="adam", init="template"), 'needs solver "lm"'),
    ],
)
def test_what_the_scene_lacks_is_named(scene, config, message):
    with pytest.raises(KroncError, match=message):
        solve_scene(scene, config)


def test_a_machine_without_a_gpu_is_told_so(scene, monkeypatch):
    torch = pytest.importorskip("torch")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(KroncError, match="CUDA"):
        solve_scene(scene, KroncConfig(device="cuda"))
