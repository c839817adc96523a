"""Photos of every kind of pixels become frames with the same colours in 8 bits, as nerfstudio reads them."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from kronc_ns.capture.frames import check_source, prepare_frames
from kronc_ns.capture.images import load_image, load_small, upright_size
from kronc_ns.capture.source import find_source
from kronc_ns.errors import KroncError

WIDTH, HEIGHT = 320, 240


def picture(shift: int = 0) -> np.ndarray:
    """Areas of six colours, moved to the right."""
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pixels[:, : WIDTH // 2] = (200, 40, 30)
    pixels[:, WIDTH // 2 :] = (20, 60, 190)
    pixels[:40] = (240, 240, 240)
    pixels[-40:, 100:] = (90, 160, 60)
    pixels[100:140, 30:90] = (250, 200, 20)
    pixels[150:180, 200:300] = (8, 8, 8)
    return np.roll(pixels, shift, axis=1)


def grey(rgb: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)


def deep(pixels: np.ndarray) -> np.ndarray:
    """8 bits as 16."""
    return pixels.astype(np.uint16) * 257


def by_cv2(path: Path, rgb: np.ndarray, *options: int) -> None:
    bgr = rgb if rgb.ndim == 2 else cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR if rgb.shape[2] == 3 else cv2.COLOR_RGBA2BGRA)
    assert cv2.imwrite(str(path), bgr, options)


def with_alpha(rgb: np.ndarray) -> np.ndarray:
    return np.dstack([rgb, np.full(rgb.shape[:2], 255, np.uint8)])


COLOURED = {
    "16-bit PNG": (".png", lambda path, rgb: by_cv2(path, deep(rgb))),
    "16-bit PNG with alpha": (".png", lambda path, rgb: by_cv2(path, deep(with_alpha(rgb)))),
    "16-bit TIFF": (".tif", lambda path, rgb: by_cv2(path, deep(rgb))),
    "16-bit TIFF, not compressed": (
        ".tiff",
        lambda path, rgb: by_cv2(path, deep(rgb), cv2.IMWRITE_TIFF_COMPRESSION, 1),
    ),
    "CMYK JPEG": (".jpg", lambda path, rgb: Image.fromarray(rgb).convert("CMYK").save(path, quality=97, subsampling=0)),
    "CMYK TIFF": (".tif", lambda path, rgb: Image.fromarray(rgb).convert("CMYK").save(path)),
    "palette PNG": (".png", lambda path, rgb: Image.fromarray(rgb).quantize().save(path)),
    "palette BMP": (".bmp", lambda path, rgb: Image.fromarray(rgb).quantize().save(path)),
    "palette PNG, first colour transparent": (
        ".png",
        lambda path, rgb: Image.fromarray(rgb).quantize().save(path, transparency=0),
    ),
}
GREY = {
    "16-bit PNG": (".png", lambda path, rgb: by_cv2(path, deep(grey(rgb)))),
    "16-bit TIFF": (".tif", lambda path, rgb: by_cv2(path, deep(grey(rgb)))),
    "with alpha": (".png", lambda path, rgb: Image.fromarray(grey(rgb)).convert("LA").save(path)),
    "8-bit JPEG": (".jpg", lambda path, rgb: Image.fromarray(grey(rgb)).save(path, quality=97)),
}


def frames_of(folder: Path, suffix: str, write) -> list[np.ndarray]:
    """What nerfstudio reads of the frames of three such photos, the half-size copies after the full ones."""
    photos = folder / "photos"
    photos.mkdir()
    for i in range(3):
        write(photos / f"IMG_{i}{suffix}", picture(13 * i))
    (folder / "out").mkdir()
    source = find_source(photos)
    assert set(check_source(source)) == {(WIDTH, HEIGHT)}
    frames = prepare_frames(source, folder / "out")
    assert frames.factors == (2,)
    read = []
    for directory in ("images", "images_2"):
        for name in frames.names:
            with Image.open(folder / "out" / directory / Path(name).name) as image:
                assert image.mode in ("L", "RGB", "RGBA")
                read.append(np.array(image, dtype="uint8"))  # as nerfstudio does
    return read


@pytest.mark.parametrize("kind", COLOURED)
def test_colours_stay_as_they_are(tmp_path: Path, kind: str):
    read = frames_of(tmp_path, *COLOURED[kind])
    for i, pixels in enumerate(read[:3]):
        seen = pixels[..., :3] if "transparent" not in kind else pixels[..., :3][pixels[..., 3] > 0]
        wanted = picture(13 * i) if "transparent" not in kind else picture(13 * i)[pixels[..., 3] > 0]
        difference = np.abs(seen.astype(int) - wanted)
        assert np.percentile(difference, 98 if "JPEG" in kind else 100) <= (6 if "JPEG" in kind else 1)
        half = cv2.resize(picture(13 * i), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        if "transparent" not in kind:
            assert np.abs(read[3 + i][..., :3].astype(int) - half).mean() < (3 if "JPEG" in kind else 1)


def test_a_transparent_colour_of_a_palette_is_alpha(tmp_path: Path):
    read = frames_of(tmp_path, *COLOURED["palette PNG, first colour transparent"])
    share = (read[0][..., 3] == 0).mean()
    assert 0.01 < share < 0.6
    assert {*np.unique(read[0][..., 3])} == {0, 255}


@pytest.mark.parametrize("kind", GREY)
def test_greys_stay_as_they_are(tmp_path: Path, kind: str):
    for i, pixels in enumerate(frames_of(tmp_path, *GREY[kind])[:3]):
        assert pixels.ndim == 2 or pixels.shape[2] == 4
        shown = pixels if pixels.ndim == 2 else pixels[..., 0]
        assert np.abs(shown.astype(int) - grey(picture(13 * i))).max() <= (8 if "JPEG" in kind else 1)


def test_two_tones_are_black_and_white(tmp_path: Path):
    read = frames_of(tmp_path, ".png", lambda path, rgb: Image.fromarray(grey(rgb) > 127).save(path))
    np.testing.assert_array_equal(read[0], np.where(grey(picture()) > 127, 255, 0))


def test_what_can_be_read_as_it_is_stays_byte_for_byte(tmp_path: Path):
    frames_of(tmp_path, *GREY["8-bit JPEG"])
    for i in range(3):
        copy = tmp_path / f"out/images/frame_0000{i + 1}.jpg"
        assert copy.read_bytes() == (tmp_path / f"photos/IMG_{i}.jpg").read_bytes()


def test_focal_lengths_survive_a_new_coding(tmp_path: Path):
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 26
    exif[ExifTags.Base.Orientation] = 6
    upright = frames_and_exif(tmp_path, exif)
    assert upright.size == (HEIGHT, WIDTH)
    assert upright.getexif().get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] == 26
    assert upright.getexif().get(ExifTags.Base.Orientation, 1) == 1
    assert upright.getpixel((HEIGHT - 20, 40)) == pytest.approx((240, 240, 240), abs=4)  # the top is to the right


def frames_and_exif(folder: Path, exif: Image.Exif) -> Image.Image:
    for i in range(3):
        Image.fromarray(picture(i)).convert("CMYK").save(folder / f"{i}.jpg", quality=97, exif=exif)
    (folder / "out").mkdir()
    frames = prepare_frames(find_source(folder), folder / "out")
    return Image.open(folder / "out" / frames.names[0])


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
@pytest.mark.parametrize("bits", [8, 16])
def test_turned_tiff_is_upright_and_its_size_known(tmp_path: Path, orientation: int, bits: int):
    """Pillow itself turns it while reading."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    (tmp_path / "photos").mkdir()
    for i in range(3):
        pixels = Image.fromarray(picture(i)) if bits == 8 else Image.fromarray(deep(grey(picture(i))))
        pixels.save(tmp_path / "photos" / f"{i}.tif", exif=exif, compression="tiff_lzw")
    size = (WIDTH, HEIGHT) if orientation in (1, 3) else (HEIGHT, WIDTH)
    source = find_source(tmp_path / "photos")
    assert set(check_source(source)) == {size}
    (tmp_path / "out").mkdir()
    frames = prepare_frames(source, tmp_path / "out")
    assert frames.size == size
    expected = {1: picture(), 3: np.rot90(picture(), 2), 6: np.rot90(picture(), -1), 8: np.rot90(picture())}[
        orientation
    ]
    with Image.open(tmp_path / "out" / frames.names[0]) as image:
        assert upright_size(tmp_path / "out" / frames.names[0], orient=False) == size
        shown = np.array(image, dtype="uint8")
    np.testing.assert_allclose(shown, expected if bits == 8 else grey(np.ascontiguousarray(expected)), atol=1)


def cmyk_profile() -> bytes:
    """ICC profile (version 2) of four inks: white paper, cyan of Lab (55, -37, -50), black, all else dark grey."""
    lab = {(0, 0, 0, 0): (100, 0, 0), (1, 0, 0, 0): (55, -37, -50)}
    nodes = [(c, m, y, k) for c in (0, 1) for m in (0, 1) for y in (0, 1) for k in (0, 1)]
    corners = bytes(
        value
        for node in nodes
        for lightness, a, b in [lab.get(node, (0, 0, 0) if node[3] else (20, 0, 0))]
        for value in (round(2.55 * lightness), a + 128, b + 128)
    )
    ramp = bytes(range(256))
    matrix = struct.pack(">9i", *(65536 * (i % 4 == 0) for i in range(9)))
    table = b"mft1" + bytes(4) + bytes([4, 3, 2, 0]) + matrix + 4 * ramp + corners + 3 * ramp
    table += bytes(-len(table) % 4)
    start = 128 + 4 + 12
    header = struct.pack(">I4sI4s4s4s", start + len(table), bytes(4), 0x02100000, b"prtr", b"CMYK", b"Lab ")
    header += bytes(12) + b"acsp" + bytes(28) + struct.pack(">3i", 63190, 65536, 54061) + bytes(48)
    return header + struct.pack(">I4sII", 1, b"A2B0", start, len(table)) + table


def test_inks_are_shown_by_their_profile(tmp_path: Path):
    inks = np.zeros((8, 8, 4), np.uint8)
    inks[:, :4, 0] = 255
    image = Image.fromarray(inks, "CMYK")
    image.save(tmp_path / "profile.tif", icc_profile=cmyk_profile())
    image.save(tmp_path / "broken.tif", icc_profile=b"not a profile")
    shown = load_image(tmp_path / "profile.tif")
    assert shown.mode == "RGB"
    assert "icc_profile" not in shown.info  # it spoke of inks
    cyan, paper = np.array(shown)[4, 1], np.array(shown)[4, 6]
    np.testing.assert_allclose(cyan, (0, 149, 218), atol=12)
    assert paper.min() > 245
    np.testing.assert_array_equal(np.array(load_image(tmp_path / "broken.tif"))[4, 1], (0, 255, 255))


def test_pixels_that_cannot_be_shown_are_named(tmp_path: Path):
    Image.fromarray(np.zeros((8, 8), np.float32)).save(tmp_path / "depth.tif")
    for load in (load_image, lambda path: load_small(path, 4)):
        with pytest.raises(KroncError, match=r"depth\.tif has floating-point pixels: expected grey, RGB, CMYK"):
            load(tmp_path / "depth.tif")
