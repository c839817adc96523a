import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from kronc_ns.errors import KroncError
from kronc_ns.files.cache import fingerprint
from kronc_ns.files.output import claim_output
from kronc_ns.files.record import write_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.fit.car_frame import car_axes, template_frame
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.fit.verdict import residuals_px
from kronc_ns.geometry.alignment import Similarity, pose_errors, umeyama
from kronc_ns.geometry.rotations import rotation_angle_deg, so3_exp
from kronc_ns.keypoints.schema import APOLLOCAR3D_66, KeypointSchema
from kronc_ns.keypoints.template import car_template
from kronc_ns.scene import Scene
from kronc_ns.solution import Status, ViewStatus
from kronc_ns.solve.adam import AdamConfig
from kronc_ns.solve.lm import LmConfig
from kronc_ns.synthetic.car import CarShape, build_car
from kronc_ns.synthetic.scenes import Capture, default_camera, make_capture, observe, walk_poses
from kronc_ns.synthetic.variations import empty_views, noisy_poses, reverse, shuffle, swap_sides
from tests.conftest import scene_of

QUICK = KroncConfig(solver="adam", adam=AdamConfig(steps=800, learning_rate=0.03))
MEASURED = replace(QUICK, min_status="solved")
FEW_STEPS = LmConfig(iterations=40)


@pytest.fixture(scope="module")
def noisy(walk_capture) -> Scene:
    return scene_of(walk_capture, noisy_poses(walk_capture.c2w, 4.0, 0.5, torch.Generator().manual_seed(0)))


@pytest.mark.slow
def test_solving_from_noisy_poses(noisy, walk_capture):
    solution = solve_scene(noisy, QUICK)
    assert solution.status is Status.CONVERGED
    assert all(view.status is ViewStatus.SOLVED for view in solution.views)
    before, _ = pose_errors(noisy.given_c2w, walk_capture.c2w)
    rotation, translation = pose_errors(solution.c2w, walk_capture.c2w)
    assert before.median() > 4.0
    assert rotation.median() < 0.6
    assert translation.median() < 0.06
    assert 0.2 < solution.rmse_px < 1.0  # half a pixel of noise per axis
    # given poses keep their world: no similarity brings the solution closer to them
    to_given = umeyama(solution.c2w[..., 3], noisy.given_c2w[..., 3])
    assert float(to_given.scale) == pytest.approx(1.0, abs=1e-6)
    torch.testing.assert_close(to_given.rotation, torch.eye(3, dtype=torch.float64), atol=1e-6, rtol=0)
    torch.testing.assert_close(to_given.translation, torch.zeros(3, dtype=torch.float64), atol=1e-6, rtol=0)


@pytest.mark.slow
def test_solving_from_the_circle_stands_the_car_upright(walk_capture):
    solution = solve_scene(
        scene_of(walk_capture), replace(QUICK, radius_m=5.0, adam=AdamConfig(steps=1500, learning_rate=0.03))
    )
    assert solution.init == "circular"
    assert solution.status is Status.CONVERGED
    assert_stands_as(solution.points, walk_capture.points)


def assert_stands_as(points, truth):
    """x forward, y left, z up, ground at z = 0; metres up to the template's guess of the car's size."""
    known = points.isfinite().all(-1)
    assert int(known.sum()) > 60
    to_truth = umeyama(points[known], truth[known])
    assert rotation_angle_deg(to_truth.rotation) < 1.0
    assert float(to_truth.scale) == pytest.approx(1.0, abs=0.06)
    assert to_truth.translation.norm() < 0.1
    assert (to_truth.apply(points[known]) - truth[known]).norm(dim=-1).median() < 0.02


def test_the_wrong_direction_is_not_called_converged(walk_capture):
    solution = solve_scene(scene_of(walk_capture), replace(QUICK, init="circular", direction="cw"))
    assert solution.status is not Status.CONVERGED
    assert "other way" in solution.reason
    assert "init auto" in solution.reason


def test_adam_which_tries_one_circle_only_hints_at_the_direction_too(walk_capture):
    solution = solve_scene(scene_of(walk_capture), replace(QUICK, direction="cw"))
    assert solution.init == "circular"
    assert solution.status is not Status.CONVERGED
    assert "other way" in solution.reason


@pytest.mark.slow
def test_a_poor_view_is_left_out_and_the_others_do_not_suffer(noisy, walk_capture):
    keypoints = noisy.keypoints.clone()
    keypoints[5, torch.nonzero(keypoints[5, :, 2])[3:, 0]] = 0  # three points left
    solution = solve_scene(replace(noisy, keypoints=keypoints), MEASURED)
    assert solution.views[5].status is ViewStatus.FAILED
    assert solution.views[5].reason == "3 keypoints, at least 4 are needed"
    assert solution.c2w[5].isnan().all()
    kept = torch.tensor(solution.solved)
    assert int(kept.sum()) == 15
    assert pose_errors(solution.c2w[kept], walk_capture.c2w[kept])[0].median() < 0.6
    # unless asked to leave it out, it is placed between its neighbours, the others as before
    whole = solve_scene(replace(noisy, keypoints=keypoints), QUICK)
    assert whole.views[5].status is ViewStatus.COMPLETED
    assert whole.views[5].reason == "placed between its neighbours: 3 keypoints, at least 4 are needed"
    assert torch.equal(whole.c2w[kept], solution.c2w[kept])
    assert pose_errors(whole.c2w, walk_capture.c2w)[0][5] < 6.0


@pytest.mark.slow
def test_a_view_of_another_car_is_found_out(noisy):
    keypoints = noisy.keypoints.clone()
    seen = torch.nonzero(keypoints[5, :, 2])[:, 0]
    shuffled = seen[torch.randperm(len(seen), generator=torch.Generator().manual_seed(0))]
    keypoints[5, seen, :2] = keypoints[5, shuffled, :2]
    for config, status in ((MEASURED, ViewStatus.FAILED), (QUICK, ViewStatus.COMPLETED)):
        solution = solve_scene(replace(noisy, keypoints=keypoints), config)
        assert solution.views[5].status is status
        assert "agree" in solution.views[5].reason
        assert sum(view.status is ViewStatus.SOLVED for view in solution.views) == 15


def test_same_seed_same_bits_and_the_seed_matters(noisy):
    short = KroncConfig(solver="adam", adam=AdamConfig(steps=30))
    # so early no pose is trusted (NaN), but points there are
    first, second, other = (solve_scene(noisy, replace(short, seed=seed)).points.nan_to_num() for seed in (0, 0, 1))
    assert first.any()
    assert torch.equal(first, second)
    assert not torch.equal(first, other)


@pytest.mark.slow
def test_given_depths_speed_up_and_can_be_fixed(noisy, walk_capture):
    from kronc_ns.geometry.poses import invert, transform

    world = torch.from_numpy(walk_capture.car.keypoints).expand(16, -1, -1)
    scene = replace(noisy, given_depths=transform(invert(walk_capture.c2w), world)[..., 2])
    few = AdamConfig(steps=300)
    prior = solve_scene(scene, KroncConfig(solver="adam", depth_init="prior", adam=few))
    random = solve_scene(scene, KroncConfig(solver="adam", depth_init="random", adam=few))
    error = [pose_errors(s.c2w, walk_capture.c2w)[1].median() for s in (prior, random)]
    assert error[0] < error[1]
    fixed = solve_scene(scene, KroncConfig(solver="adam", depth_init="prior-fixed", adam=few))
    assert pose_errors(fixed.c2w, walk_capture.c2w)[1].median() < error[0]
    # 30 % noise on the depths: they recover, unless they may not move
    noise = 1 + 0.3 * torch.randn(scene.given_depths.shape, generator=torch.Generator().manual_seed(1))
    spoilt = replace(scene, given_depths=scene.given_depths * noise)
    for depth_init, status in (("prior", Status.CONVERGED), ("prior-fixed", Status.FAILED)):
        assert solve_scene(spoilt, replace(QUICK, depth_init=depth_init)).status is status


def test_residuals_are_infinite_behind_a_camera(noisy, walk_capture):
    solution = solve_scene(noisy, KroncConfig(solver="adam", adam=AdamConfig(steps=10)))
    behind = walk_capture.c2w.clone()
    behind[0, :, [0, 2]] *= -1  # turned away from the car
    truth = torch.from_numpy(walk_capture.car.keypoints)
    error = residuals_px(noisy, replace(solution, c2w=behind, points=truth))
    seen = noisy.visibility[0] > 0
    assert error[0, seen].isinf().all()
    assert error[0, ~seen].isnan().all()
    assert error[1][error[1].isfinite()].median() < 1.0


@pytest.mark.parametrize("views", [[], [0], [0, 4]])
@pytest.mark.parametrize("solver", ["adam", "lm"])
def test_fewer_than_three_usable_views_are_never_trusted(noisy, views, solver):
    keypoints = torch.zeros_like(noisy.keypoints)
    keypoints[views] = noisy.keypoints[views]
    solution = solve_scene(replace(noisy, keypoints=keypoints), replace(QUICK, solver=solver))
    assert " of 16 views" in solution.reason
    posed = solution.c2w.isfinite().all(-1).all(-1)
    if solver == "lm":  # the car template holds them
        assert solution.status is (Status.WEAK if views else Status.FAILED)
        assert f"{len(views)} of 16 views" in solution.reason
        assert posed.tolist() == [i in views for i in range(16)]
    else:
        assert solution.status is not Status.CONVERGED
        assert "template" not in solution.reason
        assert not posed[[i for i in range(16) if i not in views]].any()


@pytest.mark.parametrize("solver", ["adam", "lm"])
def test_views_without_overlap_are_never_trusted(noisy, solver):
    keypoints = noisy.keypoints.clone()
    keypoints[..., 2] = 0
    for view in range(3):
        keypoints[view, 5 * view : 5 * view + 5] = torch.tensor([10.0, 20.0, 1.0], dtype=torch.float64)
    solution = solve_scene(
        replace(noisy, keypoints=keypoints), replace(QUICK, solver=solver, init="given", lm=FEW_STEPS)
    )
    assert solution.status is not Status.CONVERGED
    assert solution.reason


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (KroncConfig(init="given"), "transform_matrix"),
        (KroncConfig(solver="adam", depth_init="prior"), "depth_file_path"),
        (KroncConfig(device="cuda"), "CUDA"),
    ],
)
def test_what_the_scene_lacks_is_named(walk_capture, config, message):
    if config.device == "cuda" and torch.cuda.is_available():
        pytest.skip("this machine has a CUDA GPU")
    with pytest.raises(KroncError, match=message):
        solve_scene(scene_of(walk_capture), config)


def test_impossible_options_are_refused():
    for change in (
        {"radius_m": 0.0},
        {"laps": -1.0},
        {"adam": AdamConfig(steps=0)},
        {"adam": AdamConfig(learning_rate=math.nan)},
    ):
        with pytest.raises(KroncError):
            KroncConfig(**change)
    for weights in ((0.0, 0.0), (-1.0, 1.0), (math.nan, 1.0), (1.0, math.inf)):
        with pytest.raises(KroncError, match="not both 0"):
            KroncConfig(solver="adam", adam=AdamConfig(weight_2d=weights[0], weight_3d=weights[1]))


def test_car_axes_follow_the_car():
    capture = make_capture("walk", views=2)
    points = torch.from_numpy(capture.car.keypoints)
    rotation = so3_exp(torch.tensor([0.4, -0.8, 1.9], dtype=torch.float64))
    turned = points @ rotation.T
    turned[[1, 7, 30]] = math.nan
    axes = car_axes(APOLLOCAR3D_66, turned, rotation @ torch.tensor([0.1, 0.0, 1.0], dtype=torch.float64))
    torch.testing.assert_close(axes @ rotation, torch.eye(3, dtype=torch.float64), atol=1e-3, rtol=0)


def test_fingerprint_knows_contents_and_options_but_no_paths(noisy):
    same = replace(noisy, names=tuple(f"elsewhere/{name.split('/')[-1]}" for name in noisy.names))
    assert fingerprint(noisy, QUICK) == fingerprint(same, QUICK)
    assert fingerprint(noisy, QUICK) == fingerprint(noisy, replace(QUICK, device="cpu"))
    assert fingerprint(noisy, QUICK) != fingerprint(noisy, replace(QUICK, seed=1))
    renamed = replace(APOLLOCAR3D_66, keypoints=APOLLOCAR3D_66.keypoints[::-1])  # another order under the same name
    assert fingerprint(noisy, QUICK) != fingerprint(replace(noisy, schema=renamed), QUICK)
    keypoints = noisy.keypoints.clone()
    keypoints[0, 0, 0] += 1e-6
    assert fingerprint(noisy, QUICK) != fingerprint(replace(noisy, keypoints=keypoints), QUICK)


# ---- the default: lm from wherever the inputs allow


@pytest.fixture(scope="module")
def scene(lap) -> Scene:
    return scene_of(lap)


def assert_recovered(solution, capture, degrees=1.0):
    assert solution.status is Status.CONVERGED, solution.reason
    assert all(view.status is ViewStatus.SOLVED for view in solution.views)
    assert pose_errors(solution.c2w, capture.c2w)[0].mean() < degrees


def walk(views: int = 20, noise_px: float = 1.0, seed: int = 3, **options) -> Capture:
    rng = np.random.default_rng(seed)
    return observe(build_car(CarShape()), walk_poses(views, rng, **options), default_camera("walk"), rng, noise_px)


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


def test_the_reason_says_where_it_started(scene, lap, lap_start):
    assert "start: template" in solve_scene(scene).reason
    assert "start: given" in solve_scene(replace(scene, given_c2w=lap_start)).reason
    assert "start: circular" in solve_scene(scene, KroncConfig(init="circular", radius_m=5.0)).reason


def test_a_solver_that_ran_out_of_steps_says_so(scene, lap_start):
    config = KroncConfig(init="given", lm=LmConfig(iterations=3))
    solution = solve_scene(replace(scene, given_c2w=lap_start), config)
    assert solution.status is Status.WEAK
    assert "still moving after 3 steps" in solution.reason


def test_useless_given_poses_do_no_harm(scene, lap):
    elsewhere = lap.c2w[torch.from_numpy(np.random.default_rng(0).permutation(20))]
    solution = solve_scene(replace(scene, given_c2w=elsewhere))
    assert_recovered(solution, lap)
    assert "start: " in solution.reason
    to_truth = umeyama(solution.c2w[..., 3], lap.c2w[..., 3])
    assert float(to_truth.scale) == pytest.approx(1.0, abs=0.1), "their scale is as useless"


def test_given_poses_keep_their_frame_and_scale(scene, lap, lap_start):
    world = Similarity(
        torch.tensor(0.4, dtype=torch.float64),
        so3_exp(torch.tensor([0.4, -1.1, 0.7], dtype=torch.float64)),
        torch.tensor([5.0, -2.0, 3.0], dtype=torch.float64),
    )
    given = world.apply_to_poses(lap_start)
    solution = solve_scene(replace(scene, given_c2w=given))
    assert solution.init == "given"
    assert_recovered(solution, lap)
    to_given = umeyama(solution.c2w[..., 3], given[..., 3])
    assert float(to_given.scale) == pytest.approx(1.0, abs=1e-6)
    assert rotation_angle_deg(to_given.rotation) < 1e-4
    assert to_given.translation.norm() < 1e-6
    sigma = torch.tensor([view.sigma_trans_m for view in solution.views])
    metres = torch.tensor([view.sigma_trans_m for view in solve_scene(scene).views])
    assert float((sigma / metres).median()) == pytest.approx(0.4, rel=0.05)


@pytest.mark.parametrize(
    ("solver", "given"), [("lm", False), ("lm", True), pytest.param("adam", False, marks=pytest.mark.slow)]
)
def test_the_cars_length_sets_the_scale(scene, lap_start, solver, given):
    config = replace(QUICK, solver=solver, car_length_m=5.5, radius_m=5.0)
    given_c2w = lap_start if given else None
    solution = solve_scene(replace(scene, given_c2w=given_c2w), config)
    free = solve_scene(replace(scene, given_c2w=given_c2w), replace(config, car_length_m=None))
    template = car_template(APOLLOCAR3D_66)
    frame = template_frame(free.points, template)
    true_length = template.length_m(frame.apply(free.points)) / float(frame.scale)
    growth = umeyama(free.points, solution.points).scale
    assert float(growth) * true_length == pytest.approx(5.5, rel=1e-3)
    if not given:
        back = template_frame(solution.points, template)
        in_metres = template.length_m(back.apply(solution.points)) / float(back.scale)
        assert in_metres == pytest.approx(5.5, rel=1e-3)
        assert solution.points[list(APOLLOCAR3D_66.wheels), 2].abs().mean() < 0.7, "still on the ground"


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
    scene, camera = scene_of(capture), capture.camera
    centre, focal = torch.tensor([camera.cx, camera.cy]), torch.tensor([camera.fx, camera.fy])
    plane = (scene.keypoints[..., :2] - centre) / focal
    there = plane * (1 + k1 * plane.square().sum(-1, keepdim=True)) * focal + centre
    uv = torch.where(scene.visibility[..., None] > 0, there, scene.keypoints[..., :2])
    return replace(scene, keypoints=torch.cat([uv, scene.keypoints[..., 2:]], dim=-1))


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


def test_intrinsics_are_left_alone_unless_asked(scene):
    assert solve_scene(scene).camera == scene.camera


PLAIN = KeypointSchema("things-66", (*APOLLOCAR3D_66.keypoints[:-1], "something else"), tuple(range(66)))


@pytest.mark.parametrize("direction", ["ccw", pytest.param("cw", marks=pytest.mark.slow)])
def test_something_without_a_template_needs_no_direction(direction):
    capture = walk(10, noise_px=0.5, clockwise=True)
    scene = replace(scene_of(capture), schema=PLAIN)
    solution = solve_scene(scene, KroncConfig(direction=direction, radius_m=5.0))
    assert_recovered(solution, capture)
    assert solution.init.startswith("circular (cw")
    assert float(solution.c2w[..., 3].norm(dim=-1).mean()) == pytest.approx(5.0, rel=0.01)
    up = -solution.c2w[..., 1].mean(0)
    assert up[2] / up.norm() > 0.99


@pytest.mark.parametrize("options", [{"init": "template"}, {"car_length_m": 4.0}])
def test_something_without_a_template_refuses_what_needs_one(scene, options):
    with pytest.raises(KroncError, match="things-66"):
        solve_scene(replace(scene, schema=PLAIN), KroncConfig(**options))


def test_confidences_count():
    capture = make_capture("walk", views=16, seed=5, noise_px=0.3)
    noise = 4.0 * torch.randn(16, 66, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    doubtful = torch.rand(16, 66, generator=torch.Generator().manual_seed(1)) < 0.5
    keypoints = capture.keypoints.clone()
    keypoints[..., :2] += torch.where((doubtful & (keypoints[..., 2] > 0))[..., None], noise, 0.0)
    told = keypoints.clone()
    told[..., 2] *= torch.where(doubtful, 0.01, 1.0)
    flat, weighted = (solve_scene(replace(scene_of(capture), keypoints=k)) for k in (keypoints, told))
    error = [pose_errors(solution.c2w, capture.c2w)[0].mean() for solution in (flat, weighted)]
    assert error[1] < 0.8 * error[0]
    scaled = keypoints.clone()
    scaled[..., 2] *= 0.37
    same = solve_scene(replace(scene_of(capture), keypoints=scaled))
    torch.testing.assert_close(same.c2w, flat.c2w, rtol=0, atol=1e-6)


def test_views_without_keypoints_are_placed_between_their_neighbours_or_left_out():
    capture, empty = empty_views(make_capture("walk", views=30, seed=2, noise_px=1.0), 0.1, np.random.default_rng(4))
    scene = scene_of(capture)
    whole, measured = (solve_scene(scene, KroncConfig(min_status=status)) for status in ("completed", "solved"))
    assert whole.status is measured.status is Status.CONVERGED
    for solution, status in ((whole, ViewStatus.COMPLETED), (measured, ViewStatus.FAILED)):
        assert [view.status is status for view in solution.views] == empty.tolist()
    torch.testing.assert_close(whole.c2w[~empty], measured.c2w[~empty], rtol=0, atol=0)
    assert measured.c2w[empty].isnan().all()
    rotation, centre = pose_errors(whole.c2w, capture.c2w)
    assert rotation[empty].max() < 6
    assert centre[empty].max() < 0.4
    sigma = torch.tensor([[view.sigma_rot_deg, view.sigma_trans_m] for view in whole.views])
    assert (sigma[empty].amin(0) > 1.5 * sigma[~empty].median(0).values).all()
    for view in (view for view, hidden in zip(whole.views, empty, strict=True) if hidden):
        assert "between its neighbours" in view.reason
        assert "0 keypoints" in view.reason
        assert view.rmse_px is None


def test_views_in_any_order_are_not_completed():
    capture = shuffle(make_capture("walk", views=20, seed=2, noise_px=1.0), np.random.default_rng(0))
    capture, empty = empty_views(capture, 0.1, np.random.default_rng(4))
    solution = solve_scene(scene_of(capture))
    assert [view.status is ViewStatus.FAILED for view in solution.views] == empty.tolist()


def test_every_solved_view_has_sigmas_of_the_right_size():
    share = []
    for seed in range(4):
        capture = make_capture("walk", views=16, seed=20 + seed, noise_px=1.0)
        solution = solve_scene(scene_of(capture))
        known = solution.points.isfinite().all(-1)
        to_truth = umeyama(solution.points[known], capture.points[known])
        aligned = to_truth.apply_to_poses(solution.c2w)
        angle = rotation_angle_deg(aligned[..., :3].mT @ capture.c2w[..., :3])
        centre = (aligned - capture.c2w)[..., 3].norm(dim=-1)
        for view, degrees, metres in zip(solution.views, angle, centre, strict=True):
            share.append([float(degrees) / view.sigma_rot_deg, float(metres) / view.sigma_trans_m])
    rms = torch.tensor(share).square().mean(0).sqrt()
    assert (rms > 0.75).all()
    assert (rms < 1.25).all()


def test_the_result_says_which_views_were_swapped_and_holds_no_nan(tmp_path, lap):
    swapped, chosen = swap_sides(lap, 0.15, np.random.default_rng(1))
    keypoints = swapped.keypoints.clone()
    hidden = int(torch.nonzero(~chosen)[9])
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


def test_the_same_input_gives_the_same_bits(scene):
    first, second = solve_scene(scene), solve_scene(scene)
    assert torch.equal(first.c2w, second.c2w)
    assert torch.equal(first.points, second.points)
    assert first.reason == second.reason


def test_nothing_of_the_scene_is_changed(scene):
    before = scene.keypoints.clone()
    solve_scene(scene)
    assert torch.equal(scene.keypoints, before)


@pytest.mark.slow
def test_real_photos_from_the_circle_alone(spin_suv):
    from kronc_ns.files.presets import load_config
    from kronc_ns.files.transforms import read_poses

    scene = load_scene(spin_suv)
    solution = solve_scene(scene, load_config("turntable"))
    reference = read_poses(spin_suv / "reference.json")
    assert solution.status is Status.CONVERGED
    assert all(solution.solved)
    rotation, translation = pose_errors(solution.c2w, torch.stack([reference[name] for name in scene.names]))
    assert rotation.median() <= 0.6
    assert translation.median() <= 0.10
