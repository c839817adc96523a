"""The weights in the package, on cars that are rendered here: whole and right, small enough, of use."""

import cv2
import numpy as np
import pytest

from kronc_ns.capture.detection.builtin.detector import BuiltinDetector
from kronc_ns.capture.detection.builtin.weights import WEIGHTS, Network
from kronc_ns.capture.detection.detector import CarImage
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.scene import Scene
from kronc_ns.solution import Status
from kronc_ns.synthetic.car import build_car
from kronc_ns.synthetic.render import render_view
from kronc_ns.synthetic.scenes import make_capture
from kronc_ns.training.network import POINTS

VIEWS = 16


@pytest.fixture(scope="module")
def detector():
    return BuiltinDetector()


@pytest.fixture(scope="module")
def walk(tmp_path_factory, detector):
    """A rendered walk around the synthetic car: truth, images, and the first car of each."""
    folder, capture = tmp_path_factory.mktemp("walk"), make_capture("walk", views=VIEWS, seed=4)
    files = []
    for number, pose in enumerate(capture.c2w):
        files.append(folder / f"{number:02d}.png")
        picture = render_view(build_car(), pose, capture.camera, ground=True).rgba
        cv2.imwrite(str(files[-1]), cv2.cvtColor(picture, cv2.COLOR_RGBA2BGR))
    return capture, files, list(detector.detect([CarImage(file) for file in files]))


def test_the_file_is_small_and_the_one_its_card_speaks_of():
    assert WEIGHTS.stat().st_size < 12e6
    answer = Network()(np.zeros((224, 320, 3), np.uint8))
    assert answer.heat.shape[0] == POINTS
    np.testing.assert_allclose(answer.heat.sum((1, 2)), 1, atol=1e-3)


def test_points_are_found_where_they_are(walk):
    capture, _, found = walk
    errors, visible = [], 0
    for rows, cars in zip(capture.keypoints, found, strict=True):
        seen = rows[:, 2] > 0
        visible += int(seen.sum())
        if not cars:
            continue
        diagonal = np.linalg.norm(np.ptp(rows[seen, :2], axis=0))
        both = seen & (cars[0].confidence > 0)
        errors.append(np.linalg.norm(cars[0].uv - rows[:, :2], axis=1)[both] / diagonal)
    distance = np.concatenate(errors)
    assert len(distance) > 0.6 * visible
    assert np.median(distance) < 0.015


def test_poses_follow_from_bare_pictures(walk, detector):
    capture, files, found = walk
    rows = np.zeros((VIEWS, POINTS, 3))
    sigma = np.zeros((VIEWS, POINTS))
    for number, cars in enumerate(found):
        if cars:
            rows[number] = np.column_stack([cars[0].uv, cars[0].confidence])
            sigma[number] = np.where(cars[0].confidence > 0, cars[0].sigma_px, 0.0)
    names = tuple(file.name for file in files)
    solution = solve_scene(Scene(names, capture.camera, detector.schema, rows, sigma_px=sigma), KroncConfig())
    assert solution.status is Status.CONVERGED
    rotation, _ = pose_errors(solution.c2w, capture.c2w)
    assert np.nanmedian(rotation) < 2.0


def test_an_empty_picture_holds_no_car(detector, tmp_path):
    rng = np.random.default_rng(0)
    for number, picture in enumerate((np.full((300, 400, 3), 128), rng.integers(0, 255, (300, 400, 3)))):
        file = tmp_path / f"{number}.png"
        cv2.imwrite(str(file), picture.astype(np.uint8))
        assert next(iter(detector.detect([CarImage(file)]))) == []
