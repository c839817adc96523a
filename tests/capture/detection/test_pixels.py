"""Dots stay where they are through scaling, padding and cropping, to a fraction of a pixel."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from kronc_ns.capture.detection import pixels
from kronc_ns.capture.detection.pixels import Placement, box_of_mask, crop, letterbox, lies_on, read_rgb, shrink
from kronc_ns.errors import KroncError
from tests.capture.detection.dots import POINTS, draw, save

SIZE = (320, 200)
UV = np.array([[60.0, 40.0], [250.3, 61.8], [111.7, 150.2], [180.5, 99.5], [290.1, 160.9]])


def centre(rgb: np.ndarray, channel: int) -> np.ndarray:
    """Centre of mass of what differs from grey, in our pixels."""
    mass = np.abs(rgb[..., channel].astype(float) - 128) ** 2 * (np.abs(rgb[..., channel].astype(float) - 128) > 8)
    row, column = np.indices(mass.shape)
    return np.array([(mass * (column + 0.5)).sum(), (mass * (row + 0.5)).sum()]) / mass.sum()


def one_dot(uv: tuple[float, float], radius: float) -> np.ndarray:
    return draw(np.concatenate([[uv], np.full((POINTS - 1, 2), np.nan)]), SIZE, radius)


@pytest.mark.parametrize(
    "place",
    [
        lambda rgb: shrink(rgb, 200),
        lambda rgb: shrink(rgb, 117),
        lambda rgb: shrink(rgb, 5000),
        lambda rgb: letterbox(rgb, (256, 256), fill=128),
        lambda rgb: letterbox(rgb, (640, 320), fill=128),
        lambda rgb: crop(rgb, np.array([50.0, 20.0, 300.0, 180.0]), (96, 128), 1.25),
        lambda rgb: crop(rgb, np.array([90.0, 30.0, 190.0, 160.0]), (256, 192), 1.0),
    ],
)
def test_a_dot_is_where_the_placement_says(place):
    for uv in ((140.3, 90.7), (161.0, 110.5)):
        drawn, placement = place(one_dot(uv, 12.0))
        found = placement.to_image(_inside_padding(drawn, placement))
        np.testing.assert_allclose(found, uv, atol=0.1)


def _inside_padding(drawn: np.ndarray, placement: Placement) -> np.ndarray:
    """Centre of the dot in a picture whose surroundings may be black."""
    image = drawn.copy()
    corners = np.array(placement.offset), np.array(SIZE) * placement.scale + placement.offset
    low, high = (np.round(c).astype(int) for c in corners)
    outside = np.ones(image.shape[:2], dtype=bool)
    outside[max(low[1] + 1, 0) : max(high[1] - 1, 0), max(low[0] + 1, 0) : max(high[0] - 1, 0)] = False
    image[outside] = 128
    return centre(image, 0)


def test_a_crop_shows_the_box_with_padding():
    box = np.array([100.0, 50.0, 180.0, 90.0])
    drawn, placement = crop(draw(UV, SIZE), box, (96, 128), 1.25)
    assert drawn.shape == (128, 96, 3)
    corners = np.array([[0.0, 0.0], [96.0, 128.0]])
    low, high = placement.to_image(corners)
    np.testing.assert_allclose((low + high) / 2, [140, 70])
    np.testing.assert_allclose(high[0] - low[0], 80 * 1.25)
    np.testing.assert_allclose((high - low)[1] / (high - low)[0], 128 / 96)


def test_transparent_pixels_are_white_and_palettes_are_colours(tmp_path: Path):
    rgba = np.zeros((4, 4, 4), dtype=np.uint8)
    rgba[:2] = (255, 0, 0, 255)
    assert read_rgb(save(tmp_path / "a.png", rgba))[[0, 3], 0].tolist() == [[255, 0, 0], [255, 255, 255]]
    palette = Image.fromarray(rgba[..., :3]).quantize(2)
    palette.save(tmp_path / "p.png")
    assert read_rgb(tmp_path / "p.png")[[0, 3], 0].tolist() == [[255, 0, 0], [0, 0, 0]]


def test_the_box_of_a_mask(tmp_path: Path):
    mask = np.zeros((20, 30), dtype=np.uint8)
    file = save(tmp_path / "m.png", mask)
    assert box_of_mask(file, (30, 20)) is None
    mask[5:9, 10:25] = 255
    box = box_of_mask(save(file, mask), (30, 20))
    assert box is not None
    assert box.tolist() == [10, 5, 25, 9]
    with pytest.raises(KroncError, match="is 30x20, its image 20x30"):
        box_of_mask(file, (20, 30))


def test_masks_hold_for_whole_pixels():
    mask = np.zeros((4, 6), dtype=bool)
    mask[1, 2] = True
    uv = np.array([[2.0, 1.0], [2.99, 1.99], [3.0, 1.0], [-1.0, 1.0], [2.5, 7.0]])
    assert lies_on(mask, uv).tolist() == [True, True, False, False, False]


def test_frames_are_not_enlarged():
    rgb = np.zeros((30, 40, 3), dtype=np.uint8)
    assert shrink(rgb, pixels.MAX_LONG_SIDE)[0].shape == (30, 40, 3)
    assert shrink(np.zeros((2160, 3840, 3), dtype=np.uint8), pixels.MAX_LONG_SIDE)[0].shape == (1080, 1920, 3)
