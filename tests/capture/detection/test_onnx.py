"""Detectors in ONNX files: dots in pictures come back at their places, whatever happens to the picture on the way."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from kronc_ns.capture.detection.composite import CompositeFieldDetector
from kronc_ns.capture.detection.detector import CarDetection, CarImage, Detector
from kronc_ns.capture.detection.model import file_sha256
from kronc_ns.capture.detection.simcc import SimccDetector
from kronc_ns.capture.detection.yolo_pose import YoloPoseDetector
from kronc_ns.errors import KroncError
from tests.capture.detection.dots import POINTS, composite_net, draw, save, simcc_net, yolo_net

SIZE = (317, 241)
UV = np.array([[60.4, 50.0], [250.3, 61.8], [111.7, 180.2], [180.5, 99.5], [270.1, 190.9]])
EMPTY = np.full((POINTS, 2), np.nan)
SCHEMA = {"name": "dots", "keypoints": ["a", "b", "c", "d", "e"], "flip": [[0, 1]]}


def composite(folder: Path, **card) -> CompositeFieldDetector:
    file = composite_net(folder / "net.onnx")
    content = {"schema": SCHEMA, "stride": 8, "threshold": 0.1, "sha256": file_sha256(file), **card}
    (folder / "net.json").write_text(json.dumps(content))
    return CompositeFieldDetector(file)


def simcc(folder: Path) -> SimccDetector:
    return SimccDetector(simcc_net(folder / "net.onnx"))


def yolo(folder: Path) -> YoloPoseDetector:
    return YoloPoseDetector(yolo_net(folder / "net.onnx"))


def picture(folder: Path, uv: np.ndarray, size: tuple[int, int] = SIZE, radius: float = 6.0) -> Path:
    return save(folder / "picture.png", draw(uv, size, radius))


def only(detector: Detector, image: CarImage) -> CarDetection:
    ((car,),) = detector.detect([image])
    return car


def mask_of(folder: Path, box: tuple[int, int, int, int], size: tuple[int, int] = SIZE) -> Path:
    mask = np.zeros(size[::-1], dtype=np.uint8)
    mask[box[1] : box[3], box[0] : box[2]] = 255
    return save(folder / "mask.png", mask)


def test_intensity_fields(tmp_path: Path):
    detector = composite(tmp_path)
    car = only(detector, CarImage(picture(tmp_path, UV)))
    np.testing.assert_allclose(car.uv, UV, atol=0.1)
    assert (car.confidence > 0.3).all()
    np.testing.assert_allclose(car.bbox, [60.4, 50.0, 270.1, 190.9], atol=0.1)
    assert 0.3 < car.score <= 1
    assert detector.schema.keypoints == ("a", "b", "c", "d", "e")
    assert detector.schema.flip == (1, 0, 2, 3, 4)


def test_intensity_fields_of_a_large_frame(tmp_path: Path):
    scale = 12.0
    size = (3840, 2160)
    car = only(composite(tmp_path), CarImage(picture(tmp_path, UV * scale * 0.7 + 100, size, radius=14.0)))
    np.testing.assert_allclose(car.uv, UV * scale * 0.7 + 100, atol=0.2)


def test_a_mask_separates_cars_in_intensity_fields(tmp_path: Path):
    size = (640, 241)
    right = UV + np.array([320, 0])
    both = np.stack([UV, right])
    image = picture(tmp_path, both, size)
    detector = composite(tmp_path)
    for car, left in ((UV, 40), (right, 360)):
        found = only(detector, CarImage(image, mask_of(tmp_path, (left, 30, left + 250, 210), size)))
        np.testing.assert_allclose(found.uv, car, atol=0.1)
    # points on the outline are kept, though their votes fall on both sides of it
    outline = mask_of(tmp_path, (60, 50, 271, 191), size)
    assert (only(detector, CarImage(image, outline)).confidence > 0.3).all()
    assert list(detector.detect([CarImage(image, mask_of(tmp_path, (0, 0, 10, 10), size))])) == [[]]


def test_points_that_are_not_there_have_no_confidence(tmp_path: Path):
    uv = UV.copy()
    uv[1] = np.nan
    for detector in (composite(tmp_path), simcc(tmp_path)):
        car = only(detector, CarImage(picture(tmp_path, uv)))
        assert (car.confidence > 0).tolist() == [True, False, True, True, True]


@pytest.mark.parametrize("make", [composite, simcc])
def test_a_picture_without_a_car(tmp_path: Path, make: Callable[[Path], Detector]):
    assert list(make(tmp_path).detect([CarImage(picture(tmp_path, EMPTY))])) == [[]]


def test_simcc_on_the_whole_image_and_in_the_box_of_a_mask(tmp_path: Path):
    detector = SimccDetector(simcc_net(tmp_path / "net.onnx", size=(192, 256)))
    image = picture(tmp_path, UV, radius=12.0)
    np.testing.assert_allclose(only(detector, CarImage(image)).uv, UV, atol=0.1 * SIZE[0] / 192)  # 0.1 px for the net
    close = np.array([[150.2, 90.1], [190.8, 92.6], [155.5, 130.0], [171.3, 110.4], [188.8, 131.7]])
    far = close - [140, 80]  # a smaller picture of the same colours elsewhere: outside the box
    image = picture(tmp_path, np.stack([close, far]), radius=5.5)
    car = only(detector, CarImage(image, mask_of(tmp_path, (140, 80, 200, 140))))
    np.testing.assert_allclose(car.uv, close, atol=0.1)
    np.testing.assert_allclose(car.bbox, [140, 80, 200, 140])
    np.testing.assert_allclose(car.confidence, 0.9, atol=0.02)
    assert list(detector.detect([CarImage(image, mask_of(tmp_path, (0, 0, 0, 0)))])) == [[]]


@pytest.mark.parametrize("finished", [False, True])
@pytest.mark.parametrize("size", [(400, 300), (640, 301), (203, 400)])
def test_yolo_finds_each_car_once(tmp_path: Path, finished: bool, size: tuple[int, int]):
    half = np.array([size[0] / 2, 10.0])
    one = UV / SIZE * [0.8 * half[0], 0.4 * size[1]] + [0.1 * half[0], 0.3 * size[1]]
    cars = np.stack([one, one + half])
    image = picture(tmp_path, cars, size, radius=max(size) / 60)
    detector = YoloPoseDetector(yolo_net(tmp_path / "net.onnx", size=(320, 256), finished=finished))
    ((first, second),) = detector.detect([CarImage(image)])
    by_place = sorted((first, second), key=lambda car: car.uv[0, 0])
    for car, uv in zip(by_place, cars, strict=True):
        np.testing.assert_allclose(car.uv, uv, atol=0.2)
        np.testing.assert_allclose(car.bbox, [*uv.min(0), *uv.max(0)], atol=0.2)
    assert [car.score for car in by_place] == pytest.approx([0.9, 0.95])
    if not finished:
        assert first.score > second.score


def test_yolo_models_without_point_confidences_and_of_any_size(tmp_path: Path):
    cars = np.stack([UV * 0.5, UV * 0.5 + [159, 0]])
    image = picture(tmp_path, cars, radius=4.0)
    for fixed in (True, False):
        file = yolo_net(tmp_path / "net.onnx", size=(320, 256), values=2, fixed=fixed)
        ((first, _),) = YoloPoseDetector(file).detect([CarImage(image)])
        np.testing.assert_allclose(first.uv, cars[1], atol=0.2)
        np.testing.assert_allclose(first.confidence, 0.95)


def test_yolo_points_that_are_not_there_have_no_confidence(tmp_path: Path):
    uv = np.stack([UV * 0.5, UV * 0.5 + [159, 0]])
    uv[1, 2] = np.nan
    (cars,) = yolo(tmp_path).detect([CarImage(picture(tmp_path, uv))])
    assert (cars[0].confidence > 0).tolist() == [True, True, False, True, True]


def test_images_are_taken_one_by_one(tmp_path: Path):
    answers = composite(tmp_path).detect([CarImage(picture(tmp_path, UV)), CarImage(tmp_path / "later.png")])
    assert len(next(answers)) == 1
    with pytest.raises(KroncError, match=r"later\.png does not exist"):
        next(answers)


def test_the_identity_follows_model_and_thresholds(tmp_path: Path):
    detectors = {
        CompositeFieldDetector: lambda: composite(tmp_path),
        SimccDetector: lambda: simcc(tmp_path),
        YoloPoseDetector: lambda: yolo(tmp_path),
    }
    for kind, make in detectors.items():
        (tmp_path / "net.json").unlink(missing_ok=True)
        first = make().identity
        assert make().identity == first
        card = json.loads((tmp_path / "net.json").read_text()) if (tmp_path / "net.json").exists() else {}
        (tmp_path / "net.json").write_text(json.dumps({**card, "threshold": 0.4}))
        assert kind(tmp_path / "net.onnx").identity != first
    assert (
        YoloPoseDetector(yolo_net(tmp_path / "net.onnx", values=2)).identity != detectors[YoloPoseDetector]().identity
    )


def test_a_sidecar_names_the_points(tmp_path: Path):
    assert simcc(tmp_path).schema.name == "points-5"
    (tmp_path / "net.json").write_text(json.dumps({"schema": SCHEMA}))
    assert simcc(tmp_path).schema.name == "dots"
    (tmp_path / "net.json").write_text(json.dumps({"schema": "apollocar3d-66"}))
    with pytest.raises(KroncError, match=r"finds 5 points, but the schema in .*net\.json names 66"):
        simcc(tmp_path)


def test_files_that_are_no_detector_are_named(tmp_path: Path):
    file = tmp_path / "net.onnx"
    with pytest.raises(KroncError, match=r"net\.onnx does not exist"):
        YoloPoseDetector(file)
    file.write_bytes(b"text")
    with pytest.raises(KroncError, match=r"no ONNX file that onnxruntime can run"):
        YoloPoseDetector(file)
    simcc_net(file)
    with pytest.raises(KroncError, match=r"has no keypoints \(kpt_shape None\)"):
        YoloPoseDetector(file)
    composite_net(file)
    with pytest.raises(KroncError, match="expected images of one size, and two outputs"):
        SimccDetector(file)
    with pytest.raises(KroncError, match=r"net\.json does not exist: `kronc convert-detector` writes it"):
        CompositeFieldDetector(file)
    with pytest.raises(KroncError, match="belongs to another file"):
        composite(tmp_path, sha256="0" * 64)
    with pytest.raises(KroncError, match="stride is 'eight': expected a number above 0"):
        composite(tmp_path, stride="eight")
    (tmp_path / "net.json").write_text("[]")
    with pytest.raises(KroncError, match="no JSON object"):
        CompositeFieldDetector(file)


def test_without_onnxruntime_it_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = yolo_net(tmp_path / "net.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(KroncError, match=r"needs onnxruntime, .*pip install onnxruntime"):
        YoloPoseDetector(file)
