"""What the suite of the detector measures, on made answers."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from kronc_ns.benchmark.photos import (
    ON_PART,
    PartPhoto,
    outline_distance,
    part_errors,
    read_part_photos,
    solve_photos,
    takes_left_for_right,
    turn_steps,
    wheel_errors,
)
from kronc_ns.benchmark.renders import calibration_error, judged_points, without_car
from kronc_ns.benchmark.suites.detector import detector_rows
from kronc_ns.capture.detection.detector import CarDetection
from kronc_ns.files.output import write_json
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.synthetic.scenes import make_capture
from kronc_ns.training.shards import Picture
from tests.capture.detection.builtin_net import builtin_net

FLIP = list(APOLLOCAR3D_66.flip)


def _square(u: float, v: float, side: float = 20.0) -> np.ndarray:
    return np.array([u, v]) + side * np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


@pytest.fixture
def photo():
    """Seen from before: the car's left light is on the viewer's right; two wheels."""
    outlines = {
        "front_left_light": [_square(300, 100)],
        "front_right_light": [_square(100, 100)],
        "wheel": [_square(120, 190), _square(280, 190)],
    }
    return PartPhoto(Path("x.jpg"), outlines)


def _car(places: dict[int, tuple[float, float]]) -> CarDetection:
    uv, confidence = np.zeros((66, 2)), np.zeros(66)
    for index, place in places.items():
        uv[index], confidence[index] = place, 0.9
    return CarDetection(uv, confidence, np.zeros(4), 0.9)


def test_wheels_and_corners_are_measured_in_diagonals(photo):
    car = _car({7: (280, 190), 50: (123, 194), 0: (290, 90), 57: (100, 100)})
    np.testing.assert_allclose(sorted(wheel_errors(photo, car) * photo.diagonal), [0, 5], atol=1e-4)
    np.testing.assert_allclose(sorted(part_errors(photo, car) * photo.diagonal), [0, 10], atol=1e-4)


def test_sides_are_told_by_the_nearer_part(photo):
    places = {0: (290.0, 95.0), 1: (295.0, 105.0), 2: (308.0, 92.0), 57: (110.0, 95.0), 56: (104.0, 108.0)}
    right = _car(places)
    swapped = _car({FLIP[j]: place for j, place in places.items()})
    assert takes_left_for_right(photo, right) is False
    assert takes_left_for_right(photo, swapped) is True
    assert takes_left_for_right(photo, _car({7: (280, 190)})) is None


def test_distance_to_an_outline():
    assert outline_distance([_square(0, 0)], np.array([0.0, 0.0])) == pytest.approx(10)
    assert outline_distance([_square(0, 0)], np.array([0.0, 0.0]), inside_is_zero=True) == 0
    assert outline_distance([_square(0, 0), _square(50, 0)], np.array([30.0, 0.0])) == pytest.approx(10)


def test_left_and_right_parts_have_left_and_right_points():
    for part, points in ON_PART.items():
        side = "left" if "left" in part else "right" if "right" in part else None
        assert side is None or all((j in APOLLOCAR3D_66.left) == (side == "left") for j in points)


def _orbit(degrees: np.ndarray) -> np.ndarray:
    c2w = np.tile(np.eye(3, 4), (len(degrees), 1, 1))
    c2w[:, 0, 3], c2w[:, 1, 3] = 6 * np.cos(np.deg2rad(degrees)), 6 * np.sin(np.deg2rad(degrees))
    return c2w


def test_steps_of_a_turn():
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 0.8, 36)
    residual, confused = turn_steps(_orbit(200 - 10.0 * np.arange(36) + noise))
    assert np.sqrt(np.mean(residual**2)) == pytest.approx(noise.std(), rel=0.1)
    assert not confused.any()
    wrong = 10.0 * np.arange(36)
    wrong[[4, 20]] += 180
    c2w = _orbit(wrong)
    c2w[7] = np.nan
    residual, confused = turn_steps(c2w)
    assert confused.sum() == 2
    assert np.median(np.abs(residual)) < 1e-6


def test_annotations_are_read(tmp_path):
    parts = [{"id": 1, "name": "wheel"}]
    outlines = [{"image_id": 3, "category_id": 1, "segmentation": [[0, 0, 4, 0, 4, 4], [9, 9, 12, 9, 12, 12]]}]
    images = [{"id": 3, "file_name": "a.jpg"}, {"id": 4, "file_name": "empty.jpg"}]
    write_json(tmp_path / "annotations.json", {"images": images, "annotations": outlines, "categories": parts})
    (photo,) = read_part_photos(tmp_path)
    assert photo.path.name == "a.jpg"
    assert len(photo.outlines["wheel"]) == 2


class _Oracle:
    """Knows the answer to each file by its number."""

    schema, identity, uses_masks = APOLLOCAR3D_66, "oracle 1", False

    def __init__(self, rows):
        self._rows = rows

    def detect(self, images):
        for image in images:
            rows = self._rows[int(image.path.stem)]
            yield [CarDetection(rows[:, :2], rows[:, 2], np.zeros(4), 0.9, np.ones(66))]


def test_photos_are_solved_as_users_solve_them(tmp_path, monkeypatch):
    monkeypatch.setenv("KRONC_NS_CACHE", str(tmp_path / "cache"))
    capture = make_capture("walk", views=16, seed=2, noise_px=0.5)
    photos = []
    for number in range(16):
        photos.append(tmp_path / f"{number:02d}.png")
        picture = np.full((capture.camera.height, capture.camera.width, 3), number, np.uint8)
        cv2.imwrite(str(photos[-1]), picture)
    camera = capture.camera
    by_keypoints, refined = solve_photos(_Oracle(capture.keypoints), photos, camera.fx, (camera.cx, camera.cy))
    assert np.median(pose_errors(by_keypoints.c2w, capture.c2w)[0]) < 0.6
    assert refined.images is not None
    assert not refined.images.accepted, "there is nothing to see in these photos"
    np.testing.assert_array_equal(refined.c2w, by_keypoints.c2w)


def test_calibration_error_of_what_is_known(tmp_path):
    rng = np.random.default_rng(0)
    pictures, rows = [], []
    for _ in range(40):
        mask = np.zeros((352, 480), np.uint8)
        mask[100:250, 80:400] = 255
        truth = np.column_stack([rng.uniform(80, 400, 66), rng.uniform(100, 250, 66), np.ones(66)])
        right = rng.uniform(size=66) < 0.8
        shown = truth.copy()
        shown[~right, 0] += 60
        shown[:, 2] = 0.8
        pictures.append(Picture(np.zeros((352, 480, 3), np.uint8), mask, truth))
        rows.append(shown)
    said, right = (np.concatenate(part) for part in judged_points(_Oracle(rows), pictures, tmp_path))
    assert len(said) == 40 * 66
    assert calibration_error(said, right) < 0.03
    assert calibration_error(np.ones_like(said), right) == pytest.approx(0.2, abs=0.03)


def test_pictures_without_a_car_are_drawn():
    for kind in ("surroundings", "object"):
        one, again = (without_car(kind, 3) for _ in range(2))
        np.testing.assert_array_equal(one, again)
        assert one.std() > 1


def test_rows_of_what_is_missing_are_left_out(tmp_path):
    weights = builtin_net(tmp_path)
    (tmp_path / "photos").mkdir()
    rows, missing = detector_rows(tmp_path / "photos", weights)
    assert {row.name for row in rows} == {
        "no car: surroundings",
        "no car: object",
        "calibration: drawn cars",
        "time and memory",
    }
    assert len(missing) == 7
