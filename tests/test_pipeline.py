import math
from dataclasses import replace

import pytest
import torch

from kronc_ns.errors import KroncError
from kronc_ns.frame import car_axes
from kronc_ns.geometry.alignment import pose_errors, umeyama
from kronc_ns.geometry.rotations import rotation_angle_deg, so3_exp
from kronc_ns.init import noisy_poses
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.pipeline import KroncConfig, fingerprint, solve_scene
from kronc_ns.scene import Scene, load_scene
from kronc_ns.solve.adam import AdamConfig
from kronc_ns.solve.solution import Status, ViewStatus
from kronc_ns.synthetic.scenes import make_capture
from kronc_ns.verify import residuals_px
from tests.conftest import scene_of

QUICK = KroncConfig(solver="adam", adam=AdamConfig(steps=800, learning_rate=0.03))
MEASURED = replace(QUICK, min_status="solved")


@pytest.fixture(scope="module")
def noisy(walk_capture) -> Scene:
    return scene_of(walk_capture, noisy_poses(walk_capture.c2w, 4.0, 0.5, torch.Generator().manual_seed(0)))


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
    solution = solve_scene(replace(noisy, keypoints=keypoints), replace(QUICK, solver=solver))
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
    with pytest.raises(KroncError, match="not both be 0"):
        KroncConfig(solver="adam", adam=AdamConfig(weight_2d=0.0, weight_3d=0.0))


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
    keypoints = noisy.keypoints.clone()
    keypoints[0, 0, 0] += 1e-6
    assert fingerprint(noisy, QUICK) != fingerprint(replace(noisy, keypoints=keypoints), QUICK)


@pytest.mark.slow
def test_real_photos_from_the_circle_alone(spin_suv):
    from kronc_ns.config import load_config
    from kronc_ns.scene import read_poses

    scene = load_scene(spin_suv)
    solution = solve_scene(scene, load_config("turntable"))
    reference = read_poses(spin_suv / "reference.json")
    assert solution.status is Status.CONVERGED
    assert all(solution.solved)
    rotation, translation = pose_errors(solution.c2w, torch.stack([reference[name] for name in scene.names]))
    assert rotation.median() <= 0.6
    assert translation.median() <= 0.10
