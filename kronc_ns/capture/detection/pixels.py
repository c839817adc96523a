"""From image files to what a network takes: RGB, scaled, padded, cropped, with the way back for its pixels.

All places here are in our pixels (corner of the image at (0, 0), centre of its first pixel at (0.5, 0.5)).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from kronc_ns.capture.images import load_image
from kronc_ns.files.images import read_mask

IMAGENET_MEAN = np.array([0.485, 0.456, 0.406], dtype=np.float32)
IMAGENET_STD = np.array([0.229, 0.224, 0.225], dtype=np.float32)
MAX_LONG_SIDE = 1920
"""Larger images are scaled down for detection: networks have not learnt larger cars, and memory is bounded."""


@dataclass(frozen=True)
class Placement:
    """Where an image lies in the network's input: input = scale * image + offset, both (x, y)."""

    scale: tuple[float, float]
    offset: tuple[float, float] = (0.0, 0.0)

    def to_image(self, uv: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Places in the network's input as places in the image."""
        return (uv - np.array(self.offset)) / np.array(self.scale)

    def to_input(self, uv: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """The inverse of `to_image`."""
        return uv * np.array(self.scale) + np.array(self.offset)


def read_rgb(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """The image as it is stored; where it is transparent, white shines through."""
    return np.array(on_white(load_image(path)))


def on_white(image: Image.Image) -> Image.Image:
    """The image as RGB; where it is transparent, white shines through."""
    if _is_transparent(image):
        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, "white"), image)
    return image.convert("RGB")


def is_transparent(path: Path) -> bool:
    """Whether the file has transparent pixels, whose colours mean nothing; from the header alone."""
    with Image.open(path) as image:
        return _is_transparent(image)


def _is_transparent(image: Image.Image) -> bool:
    return image.mode in ("LA", "RGBA", "PA") or "transparency" in image.info


def box_of_mask(mask: Path, size: tuple[int, int]) -> Float[np.ndarray, "4"] | None:
    """Left, top, right, bottom of what is above 127; None where nothing is."""
    rows, columns = np.nonzero(read_mask(mask, size))
    if not len(rows):
        return None
    return np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], dtype=np.float64)


def lies_on(mask: Bool[np.ndarray, "h w"], uv: Float[np.ndarray, "*n 2"]) -> Bool[np.ndarray, "*n"]:
    """Whether the mask holds at each place; outside the image it does not."""
    column, row = np.moveaxis(np.floor(uv).astype(np.int64), -1, 0)
    inside = (column >= 0) & (row >= 0) & (column < mask.shape[1]) & (row < mask.shape[0])
    return inside & mask[row.clip(0, mask.shape[0] - 1), column.clip(0, mask.shape[1] - 1)]


def shrink(rgb: UInt8[np.ndarray, "h w 3"], long_side: int) -> tuple[UInt8[np.ndarray, "h2 w2 3"], Placement]:
    """The image with its longer side at most ``long_side``; never enlarged."""
    height, width = rgb.shape[:2]
    factor = min(1.0, long_side / max(width, height))
    return _resize(rgb, (max(1, round(width * factor)), max(1, round(height * factor))))


def letterbox(
    rgb: UInt8[np.ndarray, "h w 3"], size: tuple[int, int], fill: int = 114
) -> tuple[UInt8[np.ndarray, "h2 w2 3"], Placement]:
    """The image scaled to fit into ``size`` (width, height), in the middle of a grey canvas of that size."""
    factor = min(size[0] / rgb.shape[1], size[1] / rgb.shape[0])
    inner = tuple(max(1, min(whole, round(side * factor))) for whole, side in zip(size, rgb.shape[1::-1], strict=True))
    resized, placement = _resize(rgb, (inner[0], inner[1]))
    left, top = (size[0] - inner[0]) // 2, (size[1] - inner[1]) // 2
    canvas = np.full((size[1], size[0], 3), fill, dtype=np.uint8)
    canvas[top : top + inner[1], left : left + inner[0]] = resized
    return canvas, Placement(placement.scale, (float(left), float(top)))


def crop(
    rgb: UInt8[np.ndarray, "h w 3"],
    box: Float[np.ndarray, "4"],
    size: tuple[int, int],
    padding: float,
    fill: int = 0,
) -> tuple[UInt8[np.ndarray, "h2 w2 3"], Placement]:
    """The box (left, top, right, bottom), widened to the shape of ``size`` and by ``padding``, drawn in that size.

    What lies outside the image is black, or grey of value ``fill``.
    """
    import cv2

    centre, sides = (box[:2] + box[2:]) / 2, np.maximum(box[2:] - box[:2], 1.0)
    factor = float((np.array(size) / sides).min() / padding)
    offset = np.array(size) / 2 - factor * centre
    if factor < 0.5:  # sampling alone would alias: shrink first
        inner, placement = _resize(rgb, (max(1, round(rgb.shape[1] * factor)), max(1, round(rgb.shape[0] * factor))))
    else:
        inner, placement = rgb, Placement((1.0, 1.0))
    # cv2 counts from pixel centres: shift by half a pixel on both sides
    scale = factor / np.array(placement.scale)
    shift = offset + 0.5 * scale - 0.5
    matrix = np.array([[scale[0], 0.0, shift[0]], [0.0, scale[1], shift[1]]])
    drawn = cv2.warpAffine(inner, matrix, size, flags=cv2.INTER_LINEAR, borderValue=(fill, fill, fill))
    return drawn.astype(np.uint8), Placement((factor, factor), (float(offset[0]), float(offset[1])))


def normalise(rgb: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "1 3 h w"]:
    """Planes with ImageNet's mean and standard deviation taken out, as a batch of one."""
    return ((rgb.astype(np.float32) / 255 - IMAGENET_MEAN) / IMAGENET_STD).transpose(2, 0, 1)[None]


def _resize(rgb: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> tuple[UInt8[np.ndarray, "h2 w2 3"], Placement]:
    import cv2

    height, width = rgb.shape[:2]
    scale = (size[0] / width, size[1] / height)
    if size == (width, height):
        return rgb, Placement(scale)
    interpolation = cv2.INTER_AREA if max(scale) < 1 else cv2.INTER_LINEAR
    return cv2.resize(rgb, size, interpolation=interpolation).astype(np.uint8), Placement(scale)
