"""Photos of several phones, lenses or zoom settings: whose is which."""

from pathlib import Path

import pytest
from PIL import ExifTags, Image

from kronc_ns.capture.frames import Frames
from kronc_ns.capture.intrinsics import find_all_intrinsics
from kronc_ns.capture.masks import check_masks, write_masks
from kronc_ns.capture.matching import match_frames
from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import Detections
from kronc_ns.geometry.camera import Camera
from kronc_ns.keypoints.schema import APOLLOCAR3D_66

WIDE, TALL = (640, 480), (480, 640)
DIAGONAL_PX, FILM_MM = 800.0, 43.27


def photos(folder: Path, kinds: list[tuple[tuple[int, int], int | None]]) -> list[Path]:
    """Photos of (size, focal length in mm of 35 mm film; None: EXIF says nothing)."""
    files = []
    for i, (size, film_mm) in enumerate(kinds):
        exif = Image.Exif()
        if film_mm:
            exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = film_mm
        files.append(folder / f"{i}.jpg")
        Image.new("RGB", size).save(files[-1], exif=exif)
    return files


def focal_px(film_mm: float) -> float:
    return film_mm * DIAGONAL_PX / FILM_MM


def test_two_zoom_settings_are_two_cameras(tmp_path):
    kinds = [(WIDE, 26), (WIDE, 52), (WIDE, 26), (WIDE, 26)]
    found = find_all_intrinsics([size for size, _ in kinds], photos(tmp_path, kinds))
    assert [camera.fx for camera in found.cameras] == pytest.approx([focal_px(mm) for _, mm in kinds])
    assert found.camera == found.cameras[0], "of most"
    assert not found.assumed
    assert "3 images: EXIF: 26 mm in 35 mm film; 1 images: EXIF: 52 mm" in found.source


def test_a_phone_held_both_ways_has_one_focal_length_and_two_centres(tmp_path):
    kinds = [(WIDE, 26), (TALL, 26), (WIDE, 26)]
    found = find_all_intrinsics([size for size, _ in kinds], photos(tmp_path, kinds))
    assert [(camera.width, camera.cx, camera.cy) for camera in found.cameras] == [
        (640, 320.0, 240.0),
        (480, 240.0, 320.0),
        (640, 320.0, 240.0),
    ]
    assert {round(camera.fx, 3) for camera in found.cameras} == {round(focal_px(26), 3)}


def test_a_photo_that_says_nothing_is_by_the_only_camera_of_its_size(tmp_path):
    kinds = [(WIDE, 26), (WIDE, None), (TALL, 40), (WIDE, 26)]
    found = find_all_intrinsics([size for size, _ in kinds], photos(tmp_path, kinds))
    assert found.cameras[1] == found.cameras[0]
    assert not found.assumed


def test_where_two_cameras_have_its_size_the_angle_of_view_is_assumed(tmp_path):
    kinds = [(WIDE, 26), (WIDE, 52), (WIDE, None)]
    found = find_all_intrinsics([size for size, _ in kinds], photos(tmp_path, kinds))
    assert found.assumed
    assert len(set(found.cameras)) == 3


def test_photos_that_agree_are_by_one_camera(tmp_path):
    kinds = [(WIDE, 26)] * 3
    found = find_all_intrinsics([size for size, _ in kinds], photos(tmp_path, kinds))
    assert found.cameras == ()
    assert found.camera.fx == pytest.approx(focal_px(26))


def test_what_transforms_json_says_of_each_image_is_kept(tmp_path):
    one, other = Camera(500.0, 500.0, 320.0, 240.0, *WIDE), Camera(700.0, 700.0, 240.0, 320.0, *TALL)
    files = photos(tmp_path, [(WIDE, 26), (TALL, 26), (WIDE, 26)])
    found = find_all_intrinsics([WIDE, TALL, WIDE], files, [one, other, one])
    assert found.cameras == (one, other, one)


FRAMES = Frames(
    tuple(f"images/frame_{i:05d}.png" for i in (1, 2, 3)), ("a.png", "b.png", "c.png"), (WIDE, TALL, WIDE), (), False
)


def test_every_mask_has_the_size_of_its_image(tmp_path):
    for name, size in zip("abc", FRAMES.sizes, strict=True):
        Image.new("L", size, 255).save(tmp_path / f"{name}.png")
    check_masks(tmp_path, FRAMES, WIDE)
    files = tuple(tmp_path / f"{name}.png" for name in "abc")
    (tmp_path / "out").mkdir()
    names = write_masks(files, FRAMES, tmp_path / "out")
    assert [Image.open(tmp_path / "out" / name).size for name in names] == list(FRAMES.sizes)
    Image.new("L", WIDE, 255).save(tmp_path / "b.png")
    with pytest.raises(KroncError, match=r"b\.png"):
        check_masks(tmp_path, FRAMES, WIDE)


def test_a_size_for_all_keypoints_contradicts_images_of_several(tmp_path):
    found = Detections(tmp_path / "kp.json", APOLLOCAR3D_66, {}, WIDE, None)
    with pytest.raises(KroncError, match="the camera says 2 sizes"):
        match_frames(found, FRAMES.source_names, FRAMES, Camera(500.0, 500.0, 320.0, 240.0, *WIDE))
