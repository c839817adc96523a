"""The focal length is never guessed silently: its origin is told, and an assumption is marked."""

import json
import math
from pathlib import Path

import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from kronc_ns.capture.intrinsics import FULL_FRAME_DIAGONAL_MM, find_intrinsics, read_calibration
from kronc_ns.errors import KroncError
from kronc_ns.geometry.camera import Camera

Tag = ExifTags.Base
SIZE = (600, 400)  # 3:2 like full frame, whose width is 36 mm


def _photo(path: Path, size: tuple[int, int] = SIZE, **tags) -> Path:
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif).update({Tag[name]: value for name, value in tags.items()})
    Image.new("RGB", size).save(path, exif=exif)
    return path


def test_a_calibration_is_taken_as_it_is():
    camera = Camera(500.0, 501.0, 290.0, 210.0, *SIZE, k1=0.1)
    found = find_intrinsics(SIZE, given=camera)
    assert (found.camera, found.source, found.assumed) == (camera, "transforms.json", False)
    with pytest.raises(KroncError, match="for 600x400 images, the images are 300x200"):
        find_intrinsics((300, 200), given=camera)


def test_the_users_focal_length_comes_first(tmp_path: Path):
    photo = _photo(tmp_path / "a.jpg", FocalLengthIn35mmFilm=50)
    found = find_intrinsics(SIZE, [photo], focal_length_px=700.0)
    assert found.camera == Camera(700.0, 700.0, 300.0, 200.0, *SIZE)
    given = Camera(500.0, 500.0, 290.0, 210.0, *SIZE)
    assert find_intrinsics(SIZE, given=given, focal_length_px=700.0).camera == Camera(700.0, 700.0, 290.0, 210.0, *SIZE)
    with pytest.raises(KroncError, match="not positive"):
        find_intrinsics(SIZE, focal_length_px=0.0)


def test_35mm_focal_length_refers_to_the_diagonal(tmp_path: Path):
    photo = _photo(tmp_path / "a.jpg", FocalLengthIn35mmFilm=36)
    found = find_intrinsics(SIZE, [photo])
    assert found.camera.fx == pytest.approx(36 * math.hypot(*SIZE) / FULL_FRAME_DIAGONAL_MM)
    assert found.camera.fx == pytest.approx(SIZE[0], rel=1e-3)  # 36 mm on a 36 mm wide film
    assert (found.camera.cx, found.camera.cy) == (300.0, 200.0)
    assert "EXIF" in found.source
    assert "36 mm in 35 mm film" in found.source
    assert not found.assumed


@pytest.mark.parametrize(("unit", "mm"), [(2, 25.4), (3, 10.0), (4, 1.0), (5, 1e-3)])
def test_sensor_pitch_gives_the_focal_length(tmp_path: Path, unit: int, mm: float):
    pitch = IFDRational(round(1e6 * 6000 / 36 * mm), 10**6)  # a 36 mm wide sensor of 6000 px, here resized to 600
    photo = _photo(
        tmp_path / "a.jpg",
        FocalLength=IFDRational(50, 1),
        FocalPlaneXResolution=pitch,
        FocalPlaneResolutionUnit=unit,
        ExifImageWidth=6000,
        ExifImageHeight=4000,
        FocalLengthIn35mmFilm=80,
    )
    found = find_intrinsics(SIZE, [photo])
    assert found.camera.fx == pytest.approx(50 / 36 * SIZE[0], rel=1e-4)
    assert "50 mm on a 36.0 mm wide sensor" in found.source


def test_sensor_pitch_needs_the_recorded_size(tmp_path: Path):
    photo = _photo(
        tmp_path / "a.jpg",
        FocalLength=IFDRational(50, 1),
        FocalPlaneXResolution=IFDRational(1000, 1),
        FocalPlaneResolutionUnit=4,
    )
    assert find_intrinsics(SIZE, [photo]).assumed


def test_colmaps_list_of_sensors_is_the_last_word(tmp_path: Path):
    def photo(name: str, make: str, model: str) -> Path:
        exif = Image.Exif()
        exif[Tag.Make], exif[Tag.Model] = make, model
        exif.get_ifd(ExifTags.IFD.Exif)[Tag.FocalLength] = IFDRational(35, 1)
        Image.new("RGB", SIZE).save(tmp_path / name, exif=exif)
        return tmp_path / name

    found = find_intrinsics(SIZE, [photo("a.jpg", "Canon", "Canon EOS 5D Mark II")])
    assert found.camera.fx == pytest.approx(35 / 36 * SIZE[0], rel=0.01)
    assert found.source == "EXIF: 35 mm on the sensor of a Canon EOS 5D Mark II"
    unknown = find_intrinsics(SIZE, [photo("b.jpg", "Nobody", "Pinhole 1")])
    assert unknown.assumed
    assert "EXIF says 35 mm, but not on what sensor, and COLMAP's list lacks the Pinhole 1" in unknown.source


def test_a_calibration_of_the_same_shape_is_scaled(tmp_path: Path):
    file = tmp_path / "camera.json"
    content = {"fl_x": 1000.0, "fl_y": 1010.0, "cx": 590.0, "cy": 410.0, "w": 1200, "h": 800, "k1": 0.1, "k2": -0.02}
    file.write_text(json.dumps(content))
    assert read_calibration(file, SIZE) == Camera(500.0, 505.0, 295.0, 205.0, *SIZE, k1=0.1, k2=-0.02)
    found = find_intrinsics(SIZE, given=read_calibration(file, SIZE), given_by=str(file))
    assert (found.source, found.assumed, found.camera.k2) == (str(file), False, -0.02)
    with pytest.raises(KroncError, match=r"camera\.json is for 1200x800 images, the images are 400x600"):
        read_calibration(file, (400, 600))
    file.write_text(json.dumps({"fl_x": 1000.0}))
    with pytest.raises(KroncError, match=r"camera\.json: cx, cy, w, h missing"):
        read_calibration(file, SIZE)
    file.write_text("[]")
    with pytest.raises(KroncError, match="expected an object with fl_x"):
        read_calibration(file, SIZE)


def test_a_cropped_photo_says_nothing(tmp_path: Path):
    photo = _photo(tmp_path / "a.jpg", FocalLengthIn35mmFilm=28, ExifImageWidth=4000, ExifImageHeight=3000)
    found = find_intrinsics(SIZE, [photo])
    assert found.assumed
    assert "a.jpg is 600x400, cropped from the 4000x3000" in found.source
    portrait = _photo(tmp_path / "b.jpg", FocalLengthIn35mmFilm=28, ExifImageWidth=4000, ExifImageHeight=6000)
    assert not find_intrinsics(SIZE, [portrait]).assumed


def test_zoomed_photos_are_named(tmp_path: Path):
    photos = [_photo(tmp_path / f"{mm}.jpg", FocalLengthIn35mmFilm=mm) for mm in (28, 50)]
    with pytest.raises(KroncError, match=r"28\.jpg a focal length of .*50\.jpg"):
        find_intrinsics(SIZE, photos)
    assert not find_intrinsics(SIZE, photos, focal_length_px=500.0).assumed


def test_some_photos_without_exif_are_counted(tmp_path: Path):
    photos = [_photo(tmp_path / "a.jpg"), _photo(tmp_path / "b.jpg", FocalLengthIn35mmFilm=28)]
    assert "1 of 2 photos" in find_intrinsics(SIZE, photos).source


@pytest.mark.parametrize("tags", [{}, {"FocalLengthIn35mmFilm": 0}, {"FocalLength": IFDRational(0, 0)}])
@pytest.mark.parametrize("size", [(600, 400), (400, 600)])
def test_without_any_word_a_field_of_view_is_assumed(tmp_path: Path, size, tags):
    found = find_intrinsics(size, [_photo(tmp_path / "a.jpg", size, **tags)], fov_deg=65.0)
    assert found.assumed
    assert "assumed field of view of 65 deg" in found.source
    assert math.degrees(2 * math.atan(300 / found.camera.fx)) == pytest.approx(65.0)
    with pytest.raises(KroncError, match="--fov-deg is 180"):
        find_intrinsics(size, fov_deg=180.0)
