"""What is detected once is not detected again, whatever interrupts the work."""

from collections.abc import Generator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kronc_ns.capture.detection.detector import CarDetection, CarImage
from kronc_ns.capture.detection.finding import find_keypoints
from kronc_ns.capture.detection.store import detect_all
from kronc_ns.errors import KroncError
from kronc_ns.keypoints.schema import schema_of_count
from tests.capture.detection.dots import save

SIZE = (40, 30)


class Counting:
    """Finds a car whose points are the image's first pixel; fails from the given image on."""

    schema = schema_of_count(4)

    def __init__(self, fail_at: int | None = None, identity: str = "counting", uses_masks: bool = False) -> None:
        self.asked: list[Path] = []
        self.fail_at, self.identity, self.uses_masks = fail_at, identity, uses_masks
        self.closed = False

    def detect(self, images: Sequence[CarImage]) -> Generator[list[CarDetection], None, None]:
        try:
            for number, image in enumerate(images):
                if number == self.fail_at:
                    raise KeyboardInterrupt
                self.asked.append(image.path)
                value = float(int(image.path.read_bytes()[-1]))
                uv = np.array([[value, 1.0], [2.0, 3.0], [-5.0, 4.0], [39.0, 30.5]])
                confidence = np.array([0.9, 0.0, 0.8, 0.7])
                yield [CarDetection(uv, confidence, np.array([0.0, 1.0, 2.0, 3.0]), 0.5)] if value else []
        finally:
            self.closed = True


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KRONC_NS_CACHE", str(tmp_path / "cache"))


def images_of(folder: Path, values: Sequence[int]) -> list[CarImage]:
    (folder / "images").mkdir(exist_ok=True)
    paths = [folder / "images" / f"{number}.png" for number in range(len(values))]
    for path, value in zip(paths, values, strict=True):
        path.write_bytes(b"x" + bytes([value]))
    return [CarImage(path) for path in paths]


def test_finished_images_are_not_repeated_after_an_interruption(tmp_path: Path):
    images = images_of(tmp_path, [1, 2, 0, 4, 5])
    broken = Counting(fail_at=3)
    with pytest.raises(KeyboardInterrupt):
        detect_all(broken, images)
    assert len(broken.asked) == 3
    assert broken.closed
    steps: list[tuple[int, int]] = []
    again = Counting()
    cars = detect_all(again, images, lambda done, steps_, _: steps.append((done, steps_)))
    assert again.asked == [image.path for image in images[3:]]
    assert steps == [(3, 5), (4, 5), (5, 5)]
    assert [len(found) for found in cars] == [1, 1, 0, 1, 1]
    assert [found[0].uv[0, 0] for found in cars if found] == [1, 2, 4, 5]
    np.testing.assert_array_equal(cars[0][0].confidence, [0.9, 0.0, 0.8, 0.7])
    np.testing.assert_array_equal(cars[0][0].bbox, [0, 1, 2, 3])
    assert cars[0][0].score == 0.5
    third = Counting()
    detect_all(third, images)
    assert third.asked == []


def test_content_counts_and_not_names(tmp_path: Path):
    detect_all(Counting(), images_of(tmp_path, [1, 2, 3]))
    moved = Counting()
    (tmp_path / "other").mkdir()
    cars = detect_all(moved, images_of(tmp_path / "other", [3, 7, 7, 1]))
    assert len(moved.asked) == 1  # of two files of the same content
    assert [found[0].uv[0, 0] for found in cars] == [3, 7, 7, 1]


def test_another_model_starts_anew(tmp_path: Path):
    images = images_of(tmp_path, [1, 2])
    detect_all(Counting(), images)
    other = Counting(identity="other")
    detect_all(other, images)
    assert len(other.asked) == 2


def test_masks_count_where_they_matter(tmp_path: Path):
    images = images_of(tmp_path, [1])
    mask = save(tmp_path / "mask.png", np.zeros((2, 2), dtype=np.uint8))
    masked = [CarImage(images[0].path, mask)]
    for uses_masks, repeated in ((False, 0), (True, 1)):
        identity = f"uses masks: {uses_masks}"
        detect_all(Counting(identity=identity, uses_masks=uses_masks), images)
        second = Counting(identity=identity, uses_masks=uses_masks)
        detect_all(second, masked)
        assert len(second.asked) == repeated


def test_all_that_a_detector_says_is_kept(tmp_path: Path):
    class Sure(Counting):
        def detect(self, images: Sequence[CarImage]) -> Generator[list[CarDetection], None, None]:
            for number, (car,) in enumerate(super().detect(images)):
                yield [replace(car, sigma_px=np.array([1.5, np.nan, 2.0, 3.0]), turned_deg=90 * number)]

    images = images_of(tmp_path, [1, 2])
    detect_all(Sure(), images)
    again = Sure()
    (first,), (second,) = detect_all(again, images)
    assert again.asked == []
    assert first.sigma_px is not None
    assert first.sigma_px.tolist() == [1.5, 0.0, 2.0, 3.0]
    assert (first.turned_deg, second.turned_deg) == (0, 90)
    frames = find_keypoints(Sure(), tmp_path, ["images/0.png", "images/1.png"], [SIZE] * 2)
    assert frames.sigma_px is not None
    assert frames.sigma_px["images/0.png"].tolist() == [[1.5, 0.0, 0.0, 0.0]]
    assert frames.frames["images/1.png"].shape == (0, 4, 3)


def test_damaged_entries_are_made_anew(tmp_path: Path):
    images = images_of(tmp_path, [1])
    detect_all(Counting(), images)
    (entry,) = (tmp_path / "cache").rglob("*.json")
    for damage in ("", "{", "[1]", '[{"uv": [[1, 2]], "confidence": [1], "bbox": [], "score": 1}]'):
        entry.write_text(damage)
        again = Counting()
        assert len(detect_all(again, images)[0]) == 1
        assert len(again.asked) == 1


def test_points_outside_the_image_are_left_out(tmp_path: Path):
    images_of(tmp_path, [1, 0])
    found = find_keypoints(Counting(), tmp_path, ["images/0.png", "images/1.png"], [SIZE] * 2)
    rows = found.frames["images/0.png"]
    np.testing.assert_array_equal(rows, [[[1, 1, 0.9], [0, 0, 0], [0, 0, 0], [0, 0, 0]]])
    assert found.frames["images/1.png"].shape == (0, 4, 3)
    assert found.size == SIZE


def test_no_car_anywhere_is_an_error(tmp_path: Path):
    images_of(tmp_path, [0, 0])
    with pytest.raises(KroncError, match="no car was found in any of the 2 images"):
        find_keypoints(Counting(), tmp_path, ["images/0.png", "images/1.png"], [SIZE] * 2)
