"""Photos and videos become upright frames of one size, and what cannot is named."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from kronc_ns.capture.frames import Frames, check_source, find_frames, frame_names, prepare_frames
from kronc_ns.capture.images import downscale, downscale_factors
from kronc_ns.capture.intrinsics import read_exif_focal
from kronc_ns.capture.masks import downscale_mask, find_masks, write_masks
from kronc_ns.capture.photos import natural_key
from kronc_ns.capture.sidecars import copy_reference
from kronc_ns.capture.source import find_source
from kronc_ns.errors import KroncError
from kronc_ns.files.images import read_mask


def _picture(width: int = 64, height: int = 48, seed: int = 0) -> Image.Image:
    """Red on the left, blue on the right, so that turning it can be told."""
    pixels = np.random.default_rng(seed).integers(0, 60, (height, width, 3), dtype=np.uint8)
    pixels[:, : width // 2, 0] += 180
    pixels[:, width // 2 :, 2] += 180
    return Image.fromarray(pixels)


def _photo(path: Path, orientation: int | None = None, seed: int = 0, size: tuple[int, int] = (64, 48)) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    if orientation is not None:
        exif[ExifTags.Base.Orientation] = orientation
    _picture(*size, seed=seed).save(path, exif=exif)
    return path


def _prepare(data: Path, out: Path, **options) -> Frames:
    out.mkdir(exist_ok=True)
    source = find_source(data)
    check_source(source)
    steps = options.pop("progress", None)
    return find_frames(source, out, **options) or prepare_frames(source, out, **options, progress=steps)


def _is_red(image: Image.Image, where: tuple[float, float]) -> bool:
    red, _, blue = image.convert("RGB").getpixel((int(where[0] * image.width), int(where[1] * image.height)))
    return red > blue + 60


def test_natural_order():
    names = ["IMG_10.jpg", "IMG_9.jpg", "img_2.jpg", "9.jpg"]
    assert sorted(names, key=natural_key) == ["9.jpg", "img_2.jpg", "IMG_9.jpg", "IMG_10.jpg"]


def test_photos_are_copied_byte_for_byte_in_natural_order(tmp_path: Path):
    sources = [_photo(tmp_path / "photos" / f"IMG_{i}.JPG", seed=i) for i in (9, 10, 11)]
    (tmp_path / "photos" / "._IMG_9.JPG").write_bytes(b"resource fork")
    frames = _prepare(tmp_path / "photos", tmp_path / "out")
    assert frames.names == ("images/frame_00001.jpg", "images/frame_00002.jpg", "images/frame_00003.jpg")
    assert frames.source_names == ("IMG_9.JPG", "IMG_10.JPG", "IMG_11.JPG")
    for name, source in zip(frames.names, sources, strict=True):
        assert (tmp_path / "out" / name).read_bytes() == source.read_bytes()


def test_names_that_fit_are_kept():
    images = [Path("a/frame_00004.png"), Path("a/frame_00007.png")]
    assert frame_names(images) == ("images/frame_00004.png", "images/frame_00007.png")
    assert frame_names([*images, Path("a/x.png")])[0] == "images/frame_00001.png"


@pytest.mark.parametrize("suffix", ["jpg", "png"])
@pytest.mark.parametrize(
    ("orientation", "size", "red"), [(3, (64, 48), (0.9, 0.5)), (6, (48, 64), (0.5, 0.1)), (8, (48, 64), (0.5, 0.9))]
)
def test_exif_orientation_is_applied_once(tmp_path: Path, orientation: int, size, red, suffix: str):
    for i in range(3):
        _photo(tmp_path / "photos" / f"{i}.{suffix}", orientation, seed=i)
    frames = _prepare(tmp_path / "photos", tmp_path / "out")
    assert frames.size == size
    for name in frames.names:
        with Image.open(tmp_path / "out" / name) as image:
            assert image.size == size
            assert image.getexif().get(ExifTags.Base.Orientation, 1) == 1
            assert _is_red(image, red)
            assert not _is_red(image, (1 - red[0], 1 - red[1]))


def test_heif_photos_become_jpeg_with_their_exif(tmp_path: Path):
    heif = pytest.importorskip("pillow_heif")
    photos = tmp_path / "photos"
    photos.mkdir()
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 26
    for i, name in enumerate(("IMG_9.HEIC", "IMG_10.HEIC", "Küche 3.heic")):
        heif.from_pillow(_picture(640, 480, seed=i)).save(photos / name, quality=95, exif=exif)
    source = find_source(photos)
    assert set(check_source(source)) == {(640, 480)}
    assert source.names == ("IMG_9.HEIC", "IMG_10.HEIC", "Küche 3.heic")
    focal, _ = read_exif_focal(source.images[0])
    assert focal is not None
    assert focal.px == pytest.approx(26 / 43.27 * 800)
    frames = _prepare(photos, tmp_path / "out")
    assert frames.names == ("images/frame_00001.jpg", "images/frame_00002.jpg", "images/frame_00003.jpg")
    for i, name in enumerate(frames.names):
        with Image.open(tmp_path / "out" / name) as copy:
            assert copy.format == "JPEG"
            assert copy.getexif().get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] == 26
            difference = np.asarray(copy, float) - np.asarray(_picture(640, 480, seed=i), float)
        assert abs(difference.mean()) < 2
        assert np.abs(difference).mean() < 16  # the picture is noise, which codes poorly
    assert (tmp_path / "out/images_2/frame_00001.jpg").is_file()


def test_without_its_reader_heif_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    (tmp_path / "a.HEIC").touch()
    with pytest.raises(KroncError, match=r"a\.HEIC needs pillow-heif.*pip install 'kronc-ns\[heic\]'"):
        find_source(tmp_path)


def test_a_scene_folder_keeps_stored_pixels(tmp_path: Path):
    names = [f"images/frame_{i:05d}.jpg" for i in (1, 2, 3)]
    for name in names:
        _photo(tmp_path / "scene" / name, orientation=6)
    content = {"fl_x": 60, "cx": 32, "cy": 24, "w": 64, "h": 48, "frames": [{"file_path": name} for name in names]}
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(content))
    frames = _prepare(tmp_path / "scene", tmp_path / "out")
    assert frames.size == (64, 48)
    assert (tmp_path / "out" / names[0]).read_bytes() == (tmp_path / "scene" / names[0]).read_bytes()
    content["w"] = 128
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(KroncError, match=r"frame_00001.jpg is 64x48, .*transforms.json says 128x48"):
        check_source(find_source(tmp_path / "scene"))


def test_images_of_different_sizes_keep_theirs(tmp_path: Path):
    for i, orientation in enumerate((1, 1, 6)):
        _photo(tmp_path / f"{i}.jpg", orientation)
    source, sizes = find_source(tmp_path), ((64, 48), (64, 48), (48, 64))
    assert check_source(source) == sizes
    (tmp_path / "out").mkdir()
    frames = prepare_frames(source, tmp_path / "out")
    assert frames.sizes == sizes
    assert frames.size == (64, 48), "of most"
    for name, size in zip(frames.names, sizes, strict=True):
        assert Image.open(tmp_path / "out" / name).size == size


def test_unreadable_images_are_named(tmp_path: Path):
    for i in range(3):
        _photo(tmp_path / "photos" / f"{i}.jpg", size=(320, 240))
    whole = (tmp_path / "photos" / "1.jpg").read_bytes()
    (tmp_path / "photos" / "1.jpg").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(KroncError, match=r"1\.jpg is no image that can be read .*truncated"):
        _prepare(tmp_path / "photos", tmp_path / "out")
    (tmp_path / "photos" / "1.jpg").write_bytes(b"not an image")
    with pytest.raises(KroncError, match=r"1\.jpg is no image that can be read \(no image format\)"):
        check_source(find_source(tmp_path / "photos"))


def test_what_is_no_capture_is_named(tmp_path: Path):
    with pytest.raises(KroncError, match="does not exist"):
        find_source(tmp_path / "nothing")
    (tmp_path / "a.raw").touch()
    with pytest.raises(KroncError, match=r"1 \.raw.*expected \.png"):
        find_source(tmp_path)
    _photo(tmp_path / "a.png")
    with pytest.raises(KroncError, match="holds 1 images: expected at least 3"):
        check_source(find_source(tmp_path))
    with pytest.raises(KroncError, match="single image"):
        find_source(tmp_path / "a.png")


def test_downscaled_copies_are_means_of_whole_blocks(tmp_path: Path):
    for i in range(3):
        _photo(tmp_path / "photos" / f"{i}.png", size=(643, 405), seed=i)
    frames = _prepare(tmp_path / "photos", tmp_path / "out")
    assert frames.factors == (2, 4)  # 405 // 8 is below 100
    full = np.asarray(Image.open(tmp_path / "out/images/frame_00001.png"), dtype=float)
    for factor in frames.factors:
        small = np.asarray(Image.open(tmp_path / f"out/images_{factor}/frame_00001.png"), dtype=float)
        height, width = 405 // factor, 643 // factor
        blocks = full[: height * factor, : width * factor].reshape(height, factor, width, factor, 3).mean((1, 3))
        assert small.shape == blocks.shape
        assert np.abs(small - blocks).max() <= 0.5 + 1e-9
    assert not (tmp_path / "out/images_8").exists()
    assert downscale_factors((4000, 3000), 3) == (2, 4, 8)
    assert downscale_factors((4000, 3000), 0) == ()


def test_alpha_weighs_colours_of_downscaled_copies():
    pixels = np.zeros((2, 2, 4), dtype=np.uint8)
    pixels[:, 0] = (200, 100, 50, 255)
    small = downscale(Image.fromarray(pixels), 2)
    assert small.mode == "RGBA"
    red, green, blue, alpha = small.getpixel((0, 0))
    assert abs(alpha - 128) <= 1
    assert np.abs(np.array([red, green, blue]) - (200, 100, 50)).max() <= 1


def test_a_second_run_reuses_frames_until_the_source_changes(tmp_path: Path):
    for i in range(4):
        _photo(tmp_path / "photos" / f"{i}.png", seed=i)
    out = tmp_path / "out"
    first = _prepare(tmp_path / "photos", out)
    assert not first.reused
    (out / "images" / "frame_00001.png.predictions.json").write_text("[]")
    (out / "images" / "mine.png").write_bytes(b"x")
    again = _prepare(tmp_path / "photos", out)
    assert again.reused
    assert again.names == first.names
    (tmp_path / "photos" / "3.png").unlink()
    fewer = _prepare(tmp_path / "photos", out)
    assert not fewer.reused
    left = sorted(file.name for file in (out / "images").iterdir())
    assert left == [
        "frame_00001.png",
        "frame_00001.png.predictions.json",
        "frame_00002.png",
        "frame_00003.png",
        "mine.png",
    ]
    (out / "images" / "frame_00002.png").unlink()
    assert not _prepare(tmp_path / "photos", out).reused


def test_masks_are_thresholded_matched_and_downscaled(tmp_path: Path):
    for i in range(3):
        _photo(tmp_path / "photos" / f"IMG_{i}.jpg", size=(400, 203), seed=i)
        grey = np.full((203, 400), (0, 127, 128)[i], dtype=np.uint8)
        grey[:, 200:] = 255
        (tmp_path / "masks").mkdir(exist_ok=True)
        Image.fromarray(grey).save(tmp_path / "masks" / f"IMG_{i}.png")
    frames = _prepare(tmp_path / "photos", tmp_path / "out")
    names = write_masks(find_masks(tmp_path / "masks", frames), frames, tmp_path / "out")
    assert names == ("masks/frame_00001.png", "masks/frame_00002.png", "masks/frame_00003.png")
    for name, left in zip(names, (0, 0, 255), strict=True):
        for folder, size in (("masks", (400, 203)), ("masks_2", (200, 101))):
            with Image.open(tmp_path / "out" / name.replace("masks", folder)) as mask:
                assert mask.mode == "L"
                assert mask.size == size
                pixels = np.asarray(mask)
            assert (pixels[:, : size[0] // 2] == left).all()
            assert (pixels[:, size[0] // 2 :] == 255).all()
    (tmp_path / "masks" / "IMG_1.png").unlink()
    with pytest.raises(KroncError, match=r"lacks a mask for IMG_1 \(1 of 3"):
        find_masks(tmp_path / "masks", frames)


def test_masks_that_cannot_be_meant_are_named(tmp_path: Path):
    file = tmp_path / "mask.png"
    Image.new("L", (8, 6), 1).save(file)
    with pytest.raises(KroncError, match="no value above 1: expected 0 outside the car and 255"):
        read_mask(file, (8, 6))
    with pytest.raises(KroncError, match="is 8x6, its image 6x8"):
        read_mask(file, (6, 8))
    file.write_bytes(b"text")
    with pytest.raises(KroncError, match="no image that can be read"):
        read_mask(file, (8, 6))
    assert downscale_mask(np.eye(5, dtype=np.uint8), 2).tolist() == [[1, 0], [0, 1]]


def test_the_reference_gets_the_new_names(tmp_path: Path):
    for i in range(3):
        _photo(tmp_path / "scene" / "images" / f"IMG_{i}.png", seed=i)
    matrix = np.eye(4).tolist()
    frames = [{"file_path": f"images/IMG_{i}.png", "mask_path": "m", "transform_matrix": matrix} for i in range(2)]
    (tmp_path / "scene" / "reference.json").write_text(json.dumps({"w": 64, "frames": frames}))
    prepared = _prepare(tmp_path / "scene", tmp_path / "out")
    copy_reference(find_source(tmp_path / "scene"), prepared, tmp_path / "out")
    copied = json.loads((tmp_path / "out" / "reference.json").read_text())
    expected = [{"file_path": f"images/frame_0000{i}.png", "transform_matrix": matrix} for i in (1, 2)]
    assert copied == {"w": 64, "frames": expected}


def test_the_reference_of_other_frames_goes_with_them(tmp_path: Path):
    """Another capture into the same folder, without poses to compare with; somebody's own file stays."""
    out = tmp_path / "out"
    for scene in ("first", "second"):
        for i in range(3):
            _photo(tmp_path / scene / "images" / f"IMG_{i}.png", seed=10 * len(scene) + i)
    out.mkdir()
    (out / "reference.json").write_text("mine")
    _prepare(tmp_path / "first", out)
    assert (out / "reference.json").exists()
    _prepare(tmp_path / "second", out)
    assert not (out / "reference.json").exists()


def test_a_mask_is_never_of_two_images(tmp_path: Path):
    """Equal stems in two folders: masks by the old names are ambiguous, by the new ones they are not."""
    for i in range(4):
        _photo(tmp_path / "scene" / "ab"[i % 2] / f"frame_0000{i // 2}.png", seed=i)
    names = [f"{'ab'[i % 2]}/frame_0000{i // 2}.png" for i in range(4)]
    intrinsics = {"fl_x": 50.0, "fl_y": 50.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    content = {**intrinsics, "frames": [{"file_path": name} for name in names]}
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(content))
    prepared = _prepare(tmp_path / "scene", tmp_path / "out")
    assert [Path(name).stem for name in prepared.names] == [f"frame_0000{i}" for i in (1, 2, 3, 4)]
    masks = tmp_path / "masks"
    masks.mkdir()
    for i in range(2):
        Image.new("L", (64, 48), 255).save(masks / f"frame_0000{i}.png")
    with pytest.raises(KroncError, match="lacks a mask for frame_00002"):
        find_masks(masks, prepared)


def test_photos_of_equal_stem_are_counted():
    images = [Path("frame_00001.jpg"), Path("frame_00001.png"), Path("frame_00002.png")]
    assert [Path(name).stem for name in frame_names(images)] == ["frame_00001", "frame_00002", "frame_00003"]
