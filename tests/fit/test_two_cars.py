"""Two cars taken for one."""

from dataclasses import replace

import numpy as np
import pytest

from kronc_ns.fit import pipeline
from kronc_ns.fit.attempts import Attempt
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.fit.two_cars import TwoCars, two_cars
from kronc_ns.keypoints.schema import KeypointSchema
from kronc_ns.scene import Scene
from kronc_ns.solution import Status
from kronc_ns.synthetic.car import build_car
from kronc_ns.synthetic.car_parts import CarShape
from kronc_ns.synthetic.scenes import default_camera, make_capture, observe
from tests.conftest import scene_of

VIEWS = 40


@pytest.fixture(scope="module")
def mixed() -> tuple[Scene, np.ndarray]:
    """Two cars that are alike, each in about half of the views; and which show the second."""
    capture = make_capture("walk", views=VIEWS, seed=4, noise_px=0.5)
    rng = np.random.default_rng(5)
    car = build_car(CarShape.random(np.random.default_rng(3)))
    other = observe(car, capture.c2w, default_camera("walk"), rng, noise_px=0.5)
    second = rng.permutation(VIEWS) < VIEWS // 2 - 2
    keypoints = np.where(second[:, None, None], other.keypoints, capture.keypoints)
    return scene_of(replace(capture, keypoints=keypoints)), second


def explained(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> TwoCars:
    """What is made of the attempt that a solution comes from."""
    seen: list[Attempt] = []
    monkeypatch.setattr(pipeline, "two_cars", lambda attempt: seen.append(attempt) or two_cars(attempt))
    solve_scene(scene)
    return two_cars(seen[-1])


def test_two_cars_are_told_from_one(mixed):
    scene, second = mixed
    solution = solve_scene(scene)
    assert solution.status is Status.WEAK
    first = scene.names[np.flatnonzero(second)[0]]
    assert f"of {VIEWS} views, {first} the first, seem to show another car than the rest" in solution.reason


def test_views_are_told_apart(mixed, monkeypatch):
    scene, second = mixed
    found = explained(scene, monkeypatch)
    assert (found.other == second).mean() >= 0.95
    assert found.explained > 0.55
    assert 0.2 < found.together < 0.7  # mixed at random


def test_two_cars_of_few_points_are_told_from_one(mixed):
    """Neighbouring views have but a few points in common."""
    scene, _ = mixed
    seen = scene.seen & (np.random.default_rng(7).uniform(size=scene.seen.shape) < 0.45)
    sparse = replace(scene, keypoints=np.where(seen[..., None], scene.keypoints, 0.0))
    assert 5 < seen.sum(1).mean() < 16
    assert "seem to show another car" in solve_scene(sparse).reason


@pytest.mark.parametrize("noise_px", [2.0, 3.0])
def test_noise_is_not_taken_for_another_car(noise_px, monkeypatch):
    scene = scene_of(make_capture("walk", views=VIEWS, seed=4, noise_px=noise_px))
    assert explained(scene, monkeypatch).explained < 0.2


@pytest.mark.parametrize("views", [6, 9, 14])
def test_noise_of_few_views_is_not_taken_for_another_car(views):
    for seed in range(5):
        scene = scene_of(make_capture("walk", views=views, seed=seed, noise_px=2.0, missing=0.3))
        assert "another car" not in solve_scene(scene).reason


@pytest.mark.parametrize("habit_px", [1.2, 3.0])
def test_habits_of_a_detector_are_not_taken_for_another_car(habit_px, monkeypatch):
    """Its points are off by more than its noise, alike in views from one side."""
    capture = make_capture("walk", views=VIEWS, seed=4, noise_px=1.0)
    azimuth = np.arctan2(capture.c2w[:, 1, 3], capture.c2w[:, 0, 3])
    turns = np.stack([np.cos(2 * azimuth), np.sin(2 * azimuth)], axis=-1)  # once a lap would be another place
    habits = np.random.default_rng(6).normal(0, habit_px, (2, 66, 2))
    keypoints = capture.keypoints.copy()
    keypoints[..., :2] += np.einsum("nk,kjc->njc", turns, habits)
    scene = scene_of(replace(capture, keypoints=np.where(capture.keypoints[..., 2:] > 0, keypoints, 0.0)))
    found = explained(scene, monkeypatch)
    assert 0.05 < found.explained < 0.45
    assert found.together > 0.8
    assert "another car" not in solve_scene(scene).reason


def test_few_views_are_not_asked(monkeypatch):
    scene = scene_of(make_capture("walk", views=5, seed=4, noise_px=3.0))
    found = explained(scene, monkeypatch)
    assert found.explained == 0
    assert not found.other.any()


def test_objects_without_a_template_are_told_apart_too(mixed, monkeypatch):
    scene, second = mixed
    schema = scene.schema
    anything = KeypointSchema("anything", schema.keypoints, schema.flip)
    capture = make_capture("walk", views=VIEWS, seed=4)
    found = explained(replace(scene, schema=anything, given_c2w=capture.c2w), monkeypatch)
    assert found.explained > 0.55
    assert (found.other == second).mean() >= 0.95
