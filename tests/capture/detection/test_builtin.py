"""The builtin detector: cars whose points are known exactly come back, however the picture shows them."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from kronc_ns.capture.detection.builtin.detector import BuiltinDetector
from kronc_ns.capture.detection.builtin.peaks import find_places, mass_near
from kronc_ns.capture.detection.builtin.pictures import read_upright
from kronc_ns.capture.detection.builtin.weights import read_card
from kronc_ns.capture.detection.detector import CarDetection, CarImage
from kronc_ns.capture.detection.finding import find_keypoints
from kronc_ns.errors import KroncError
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from tests.capture.detection.builtin_net import POINTS, builtin_net, car, draw_cars
from tests.capture.detection.dots import save, simcc_net

FLIP = np.array(APOLLOCAR3D_66.flip)
BOX = (100.3, 80.2, 520.7, 300.1)
SIZE = (640, 360)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_net(tmp_path_factory.mktemp("weights"))


@pytest.fixture(scope="module")
def detector(weights: Path) -> BuiltinDetector:
    return BuiltinDetector(weights)


def found(detector: BuiltinDetector, path: Path, mask: Path | None = None) -> list[CarDetection]:
    (cars,) = detector.detect([CarImage(path, mask)])
    return cars


def check(detection: CarDetection, uv: np.ndarray, width: float, points: np.ndarray | tuple[int, ...] = POINTS) -> None:
    """All points there within 0.2 % of the car's width and within what is said of their precision, and no others."""
    points = np.asarray(points)
    assert np.flatnonzero(detection.confidence).tolist() == sorted(points)
    error = np.linalg.norm(detection.uv[points] - uv, axis=1)
    assert error.max() < 0.002 * width
    assert detection.sigma_px is not None
    assert (error < detection.sigma_px[points]).all()


# ---- places


def test_places_lie_between_cells():
    column, row = np.meshgrid(np.arange(80) + 0.5, np.arange(56) + 0.5)
    centres = np.array([[30.2, 20.9], [4.0, 50.3], [76.6, 2.45]])
    squared = [(column - x) ** 2 + (row - y) ** 2 for x, y in centres]
    heat = np.exp(-np.array(squared) / (2 * 0.7**2))
    heat /= heat.sum((1, 2), keepdims=True)
    places = find_places(heat)
    np.testing.assert_allclose(places.cells, centres, atol=0.01)
    np.testing.assert_allclose(places.spread, 0.7, atol=0.03)
    within = 1 - np.exp(-(2.0**2) / (2 * 0.7**2))  # of a Gaussian, in a disc of 2 cells
    np.testing.assert_allclose(mass_near(heat, centres, 2.0), within, atol=0.02)


def test_a_place_without_mass_about_it_is_in_the_picture():
    places = find_places(np.full((2, 5, 6), 1 / 30))
    assert (places.cells > 0).all()
    assert np.isfinite(places.spread).all()


# ---- cars


@pytest.mark.parametrize(
    ("size", "box"),
    [
        (SIZE, BOX),
        ((1920, 1080), (300.3, 180.2, 1520.7, 900.1)),
        ((1920, 1080), (1000.3, 480.2, 1200.7, 590.1)),  # a tenth of the width
        ((540, 960), (50.0, 240.2, 500.0, 500.0)),
        ((3840, 2160), (1500.0, 900.0, 3300.0, 1900.0)),
        ((160, 120), (20.0, 30.0, 140.0, 95.0)),
    ],
)
def test_a_car_is_found(detector: BuiltinDetector, tmp_path: Path, size: tuple[int, int], box: tuple):
    small = box[2] - box[0] < 0.2 * size[0]  # the dots must not vanish in the first look
    (only,) = found(detector, save(tmp_path / "a.png", draw_cars(size, box, radius=0.03 if small else 0.02)))
    check(only, car(box), box[2] - box[0])
    np.testing.assert_allclose(only.bbox, box, atol=0.03 * (box[2] - box[0]))
    assert 0.5 < only.score <= 1


def test_the_mirror_image_is_the_same_car_with_its_sides_exchanged(detector: BuiltinDetector, tmp_path: Path):
    mirrored = draw_cars(SIZE, BOX)[:, ::-1]
    (only,) = found(detector, save(tmp_path / "a.png", mirrored))
    check(only, [SIZE[0], 0] + [-1, 1] * car(BOX), BOX[2] - BOX[0], FLIP[list(POINTS)])


def test_several_cars_the_strongest_first(detector: BuiltinDetector, tmp_path: Path):
    near, far = (1000.3, 280.2, 1820.7, 740.1), (100.0, 480.2, 700.0, 800.0)
    cars = found(detector, save(tmp_path / "a.png", draw_cars((1920, 1080), far, near)))
    assert len(cars) == 2
    for box in (near, far):
        match = min(cars, key=lambda one: abs(one.bbox - box).max())
        check(match, car(box), box[2] - box[0])


def test_a_post_before_a_car_does_not_halve_it(detector: BuiltinDetector, tmp_path: Path):
    picture = draw_cars(SIZE, BOX)
    picture[:, 325:337] = draw_cars((12, SIZE[1]))
    (only,) = found(detector, save(tmp_path / "a.png", picture))
    check(only, car(BOX), BOX[2] - BOX[0])


def test_a_mask_says_which_car(detector: BuiltinDetector, tmp_path: Path):
    near, far = (1000.3, 280.2, 1820.7, 740.1), (100.0, 480.2, 700.0, 800.0)
    image = save(tmp_path / "a.png", draw_cars((1920, 1080), far, near))
    mask = np.zeros((1080, 1920), dtype=np.uint8)
    empty = save(tmp_path / "empty.png", mask)
    mask[470:810, 90:710] = 255
    (only,) = found(detector, image, save(tmp_path / "mask.png", mask))
    check(only, car(far), 600)
    assert found(detector, image, empty) == []


def test_points_are_looked_for_where_geometry_expects_them(detector: BuiltinDetector, tmp_path: Path):
    box = (100.0, 80.0, 420.0, 230.0)
    file = save(tmp_path / "car.png", draw_cars((640, 400), box))
    expected = np.full((66, 2), np.nan)
    expected[list(POINTS)] = car(box) + np.array([3.0, -2.0])
    elsewhere = np.arange(len(POINTS)) % 2 == 0
    expected[np.array(POINTS)[elsewhere]] += (60.0, 30.0)
    (found,) = detector.look_again([CarImage(file)], expected[None])
    given = found.confidence[list(POINTS)] > 0
    assert not given[elsewhere].any(), "what the image does not show there is not given"
    assert given[~elsewhere].all()
    places = found.uv[list(POINTS)][~elsewhere]
    assert np.abs(places - car(box)[~elsewhere]).max() < 1.0, "the image says where, not what was expected"


def test_no_car_is_no_car(detector: BuiltinDetector, tmp_path: Path):
    assert found(detector, save(tmp_path / "a.png", draw_cars(SIZE))) == []
    patch = draw_cars(SIZE)
    patch[100:200, 200:400] = 160  # a body without points
    assert found(detector, save(tmp_path / "b.png", patch)) == []


def test_a_car_cut_by_the_border_keeps_what_is_seen_of_it(detector: BuiltinDetector, tmp_path: Path):
    box = (100.0, 80.0, 720.0, 330.0)
    (only,) = found(detector, save(tmp_path / "a.png", draw_cars(SIZE, box)))
    seen = car(box)[:, 0] < SIZE[0]
    check(only, car(box)[seen], 620, np.array(POINTS)[seen])


# ---- pictures of every kind


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_is_obeyed_and_places_are_in_stored_pixels(detector: BuiltinDetector, tmp_path: Path, orientation: int):
    undo = {
        2: Image.Transpose.FLIP_LEFT_RIGHT,
        3: Image.Transpose.ROTATE_180,
        4: Image.Transpose.FLIP_TOP_BOTTOM,
        5: Image.Transpose.TRANSPOSE,
        6: Image.Transpose.ROTATE_90,
        7: Image.Transpose.TRANSVERSE,
        8: Image.Transpose.ROTATE_270,
    }
    upright = Image.fromarray(draw_cars(SIZE, BOX))
    stored = upright if orientation == 1 else upright.transpose(undo[orientation])
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    stored.save(tmp_path / "a.png", exif=exif)
    picture = read_upright(tmp_path / "a.png")
    np.testing.assert_array_equal(picture.rgb, np.array(upright))
    np.testing.assert_allclose(picture.from_stored(picture.to_stored(car(BOX))), car(BOX))
    (only,) = found(detector, tmp_path / "a.png")
    check(only, picture.to_stored(car(BOX)), BOX[2] - BOX[0])
    place = picture.to_stored(car(BOX))[0]  # a dot is there in the file itself
    pixel = np.array(stored)[int(place[1]), int(place[0])]
    np.testing.assert_array_equal(pixel, np.array(upright)[int(car(BOX)[0, 1]), int(car(BOX)[0, 0])])


def test_what_is_turned_without_saying_so_is_told(detector: BuiltinDetector, tmp_path: Path):
    (tmp_path / "images").mkdir()
    for quarters, remedy in ((1, "90 degrees clockwise"), (2, "180 degrees"), (3, "90 degrees counter-clockwise")):
        turned = np.ascontiguousarray(np.rot90(draw_cars(SIZE, BOX), quarters))
        (only,) = found(detector, save(tmp_path / "images/a.png", turned))
        assert not only.confidence.any()
        assert only.turned_deg == 360 - 90 * quarters
        with pytest.raises(KroncError, match=f"in 1 of 1 images of .* the car .*: turn the photos by {remedy}"):
            find_keypoints(detector, tmp_path, ["images/a.png"], [turned.shape[1::-1]])


@pytest.mark.parametrize("kind", ["transparent", "palette", "jpeg"])
def test_kinds_of_files(detector: BuiltinDetector, tmp_path: Path, kind: str):
    image, file = Image.fromarray(draw_cars((1600, 900), (200.0, 200.0, 1400.0, 800.0))), tmp_path / "a.png"
    if kind == "transparent":
        image.putalpha(255)
    elif kind == "palette":
        image = image.quantize(256)
    else:
        file = tmp_path / "a.jpg"
    image.save(file, **({"quality": 98} if kind == "jpeg" else {}))
    (only,) = found(detector, file)
    assert np.abs(only.uv[list(POINTS)] - car((200.0, 200.0, 1400.0, 800.0))).max() < 6


def test_grey_and_deep_files_are_read_alike(tmp_path: Path):
    grey = draw_cars(SIZE, BOX)[..., 0]
    Image.fromarray(grey).save(tmp_path / "grey.png")
    Image.fromarray(grey.astype(np.uint16) * 257).save(tmp_path / "deep.png")
    for name in ("grey.png", "deep.png"):
        np.testing.assert_array_equal(read_upright(tmp_path / name).rgb, np.repeat(grey[..., None], 3, axis=2))
    Image.fromarray(grey.astype(np.float32)).save(tmp_path / "float.tif")
    with pytest.raises(KroncError, match=r"float\.tif has floating-point pixels"):
        read_upright(tmp_path / "float.tif")


def test_large_jpegs_are_decoded_small(tmp_path: Path):
    Image.new("RGB", (8000, 4000), "red").save(tmp_path / "a.jpg")
    picture = read_upright(tmp_path / "a.jpg")
    assert picture.rgb.shape == (960, 1920, 3)
    np.testing.assert_allclose(picture.to_stored(np.array([1920.0, 960.0])), [8000, 4000])


# ---- weights


def test_weights_that_were_changed_are_refused(weights: Path, tmp_path: Path):
    for suffix in (".onnx", ".json"):
        (tmp_path / "net").with_suffix(suffix).write_bytes(weights.with_suffix(suffix).read_bytes())
    pinned = json.loads((tmp_path / "net.json").read_text())["sha256"]
    content = bytearray((tmp_path / "net.onnx").read_bytes())
    content[-20] ^= 1
    (tmp_path / "net.onnx").write_bytes(content)
    with pytest.raises(KroncError, match=rf"net\.onnx was changed: its sha256 is [0-9a-f]{{64}}, expected {pinned}"):
        BuiltinDetector(tmp_path / "net.onnx")
    (tmp_path / "net.json").unlink()
    with pytest.raises(KroncError, match=r"net\.json does not exist: reinstall kronc-ns"):
        BuiltinDetector(tmp_path / "net.onnx")


def test_another_network_is_refused(tmp_path: Path, weights: Path):
    from kronc_ns.capture.detection.model import file_sha256

    card = json.loads(weights.with_suffix(".json").read_text())
    other = simcc_net(tmp_path / "net.onnx")
    other.with_suffix(".json").write_text(json.dumps({**card, "sha256": file_sha256(other)}))
    with pytest.raises(KroncError, match=r"expected uint8 \[1, 224, 320, 3\] and heat, visible, mask"):
        BuiltinDetector(other)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"car_points": "many"}, "expected numbers"),
        ({"calibration": [[0, 0.5], [1, 0.4]]}, r"calibration .* does not rise from 0 to 1"),
        ({"calibration": []}, "does not rise"),
        ({"calibration": [1, 2]}, "expected numbers"),
    ],
)
def test_a_card_that_is_wrong_is_named(weights: Path, tmp_path: Path, change: dict, message: str):
    card = json.loads(weights.with_suffix(".json").read_text())
    (tmp_path / "card.json").write_text(json.dumps({**card, **change}))
    with pytest.raises(KroncError, match=message):
        read_card(tmp_path / "card.json")
    del card["version"]
    (tmp_path / "card.json").write_text(json.dumps(card))
    with pytest.raises(KroncError, match=r"expected an object with version, sha256"):
        read_card(tmp_path / "card.json")


def test_confidence_is_calibrated_and_the_identity_knows(weights: Path, tmp_path: Path, detector: BuiltinDetector):
    image = save(tmp_path / "a.png", draw_cars(SIZE, BOX))
    (plain,) = found(detector, image)
    other = BuiltinDetector(builtin_net(tmp_path, calibration=[[0.0, 0.0], [0.5, 0.9], [1.0, 1.0]]))
    (raised,) = found(other, image)
    assert other.identity != detector.identity
    points = list(POINTS)
    assert (raised.confidence[points] > plain.confidence[points]).all()
    strict = BuiltinDetector(builtin_net(tmp_path, point_confidence=0.99))
    assert found(strict, image) == []
