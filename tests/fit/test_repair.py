"""Odd views: found, and put right or left out."""

import json
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from kronc_ns.fit import pipeline
from kronc_ns.fit.attempts import Attempt, adjust_starts
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.repair import repair
from kronc_ns.fit.starts import start_from_poses, start_from_template
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.geometry.camera import reproject
from kronc_ns.scene import Scene
from kronc_ns.synthetic.car import CarShape, build_car
from kronc_ns.synthetic.scenes import Capture, default_camera, make_capture, observe, walk_poses
from kronc_ns.synthetic.variations import noisy_poses, on_wheels, swap_sides
from tests.conftest import SHARED_DATA, scene_of

CONFIG = KroncConfig()
SHAPES = SHARED_DATA / "cars79_keypoints3d.json"


def solved(scene: Scene, c2w: np.ndarray) -> Attempt:
    (attempt,) = adjust_starts([start_from_poses("given", "given", scene, c2w)], CONFIG)
    return attempt


def rng() -> np.random.Generator:
    return np.random.default_rng(1)


@pytest.mark.parametrize("given", [True, False])
def test_swapped_views_are_found_and_repaired_and_no_others(lap, lap_start, given):
    swapped, chosen = swap_sides(lap, 0.15, rng())
    assert chosen.sum() == 3
    scene = scene_of(swapped)
    first = start_from_poses("given", "given", scene, lap_start) if given else start_from_template(scene)
    (attempt,) = repair(adjust_starts([first], CONFIG), CONFIG)
    assert_array_equal(attempt.found.swapped, chosen)
    assert_array_equal(attempt.found.scene.keypoints, lap.keypoints, err_msg="put right")
    assert attempt.agreeing.all()
    rotation, centre = pose_errors(attempt.found.c2w, lap.c2w)
    assert rotation.max() < 2.5
    assert rotation.mean() < 0.6
    assert centre.max() < 0.2


def test_a_view_of_another_car_is_dropped(scene, lap, lap_start):
    other = make_capture("walk", views=20, seed=40, noise_px=0.7)
    keypoints = lap.keypoints.copy()
    keypoints[6] = other.keypoints[15][rng().permutation(66)]  # seen from elsewhere, its points in another order
    (attempt,) = repair([solved(replace(scene, keypoints=keypoints), lap_start)], CONFIG)
    kept = np.arange(20) != 6
    assert_array_equal(attempt.agreeing, kept)
    assert pose_errors(attempt.found.c2w[kept], lap.c2w[kept])[0].mean() < 0.7


def test_a_view_that_was_set_on_the_wrong_side_is_brought_back(scene, lap, lap_start):
    wrong = lap_start.copy()
    wrong[3] = lap_start[13]
    before = solved(scene, wrong)
    (after,) = repair([before], CONFIG)
    assert after.agreeing.all()
    assert pose_errors(after.found.c2w, lap.c2w)[0].max() < 2.5
    assert after.iterations >= before.iterations
    assert after.start is before.start
    assert after.path is before.path


def test_nothing_is_repaired_where_nothing_is_wrong(attempt):
    (after,) = repair([attempt], CONFIG)
    assert after is attempt


def test_only_the_attempts_that_need_it_are_repaired(attempt, lap, lap_start):
    swapped, chosen = swap_sides(lap, 0.15, rng())
    other, same = repair([solved(scene_of(swapped), lap_start), attempt], CONFIG)
    assert_array_equal(other.found.swapped, chosen)
    assert same is attempt


def test_two_starts_of_one_scene_end_in_one_place(template_attempt, attempt):
    one, other = repair([template_attempt, attempt], CONFIG)
    rotation, centre = pose_errors(one.found.c2w, other.found.c2w)
    assert rotation.max() < 0.02
    assert centre.max() < 0.002


# ---- a car that is not the template, with views that look through it


def real_car() -> np.ndarray:
    if not SHAPES.is_file():
        pytest.skip(f"shapes of real cars are not beside the project ({SHAPES})")
    return on_wheels(np.array(json.loads(SHAPES.read_text())["cars"][40]["keypoints"]))


def procedural_car() -> np.ndarray:
    return build_car(CarShape.random(rng())).keypoints


CARS: dict[str, Callable[[], np.ndarray]] = {"a real car": real_car, "a procedural car": procedural_car}


def glass_capture(points: np.ndarray, views: int = 100) -> tuple[Capture, np.ndarray]:
    """1 px of noise; every fifth view also tells most of the points on the car's far side; and these views."""
    draw = rng()
    capture = observe(points, walk_poses(views, draw), default_camera("walk"), draw, noise_px=1.0)
    through = np.arange(views) % 5 == 0
    uv = reproject(points, capture.c2w, capture.camera) + draw.normal(size=(views, len(points), 2))
    hidden = np.concatenate([uv, np.ones((views, len(points), 1))], axis=-1)
    told = through[:, None] & (capture.keypoints[..., 2] == 0) & (draw.random(uv.shape[:2]) < 0.6)
    return replace(capture, keypoints=np.where(told[..., None], hidden, capture.keypoints)), through


@pytest.fixture(scope="module", params=CARS)
def glass(request) -> tuple[Capture, np.ndarray]:
    return glass_capture(CARS[request.param]())


@pytest.fixture
def consensus(monkeypatch) -> list[int]:
    """Every view that is located by RANSAC leaves the number of its points here."""
    calls: list[int] = []
    real = cv2.solvePnPRansac

    def counted(points, *args, **kwargs):
        calls.append(len(points))
        return real(points, *args, **kwargs)

    monkeypatch.setattr(cv2, "solvePnPRansac", counted)
    return calls


def looks_through(attempt: Attempt) -> np.ndarray:
    """Views of which a third of the detections are on the far side of the car."""
    seen = attempt.found.scene.seen
    return 3 * (attempt.found.far_side & seen).sum(1) >= seen.sum(1)


def test_views_that_fit_are_only_asked_whether_their_sides_are_swapped(glass, consensus):
    """They look through the car, are where they belong, and stay there: none is located anew, nothing solved again."""
    capture, through = glass
    before = solved(scene_of(capture), noisy_poses(capture.c2w, 4.0, 0.5, rng()))
    odd = looks_through(before)
    assert odd.sum() >= 10
    assert not odd[~through].any()
    (after,) = repair([before], CONFIG)
    assert after is before
    assert not consensus
    assert pose_errors(after.found.c2w, capture.c2w)[0].mean() < 0.5


def test_a_solution_with_nothing_to_repair_is_the_one_without_repair(glass, consensus, monkeypatch):
    capture, _ = glass
    scene = scene_of(capture, noisy_poses(capture.c2w, 4.0, 0.5, rng()))
    solution = pipeline.solve_scene(scene)
    monkeypatch.setattr(pipeline, "repair", lambda attempts, config: list(attempts))
    without = pipeline.solve_scene(scene)
    assert not consensus
    assert_array_equal(solution.c2w, without.c2w)
    assert_array_equal(solution.points, without.points)
    assert (solution.views, solution.reason) == (without.views, without.reason)


def test_swapped_views_are_found_among_views_that_look_through_the_car(glass, consensus):
    """Also where they do both; only views that do not fit are located by consensus, each as it is and swapped."""
    capture, through = glass
    swapped, chosen = swap_sides(capture, 0.15, np.random.default_rng(4))
    assert (chosen & through).sum() >= 3
    before = solved(scene_of(swapped), noisy_poses(capture.c2w, 4.0, 0.5, rng()))
    (after,) = repair([before], CONFIG)
    assert_array_equal(after.found.swapped, chosen)
    assert_array_equal(after.found.scene.keypoints, capture.keypoints)
    assert after.agreeing.all()
    assert len(consensus) <= 2 * chosen.sum()
