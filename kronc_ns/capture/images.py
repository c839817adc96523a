"""Single image files: read with a helpful error, copied upright, downscaled."""

import math
import shutil
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from PIL import ExifTags, Image, ImageOps

from kronc_ns.errors import KroncError

_READ_ERRORS = (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error, Image.DecompressionBombError)
HEIF_SUFFIXES = (".heic", ".heif")
"""Photos that `read_heif` lets be read, in lower case."""
_SMALLEST_SIDE = 100  # px; below, a downscaled copy shows nothing to train on


def read_heif(path: Path) -> None:
    """Let Pillow read HEIF, upright, in this process; ``path`` is the photo that asks for it."""
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        raise KroncError(f"{path} needs pillow-heif, which is not installed: pip install 'kronc-ns[heic]'") from None
    register_heif_opener(thumbnails=False)


def load_image(path: Path) -> Image.Image:
    """The whole decoded image as it is stored (EXIF orientation not applied), 8 bits a channel."""
    image = _load(path)
    if image.mode.startswith(("I", "F")):
        raise KroncError(f"{path} has {image.mode} pixels: expected 8 bits a channel; convert it")
    return image


def load_small(path: Path, long_side: int) -> Image.Image:
    """The image as it is stored, as cheaply as its format allows, not below ``long_side`` px where it is larger.

    JPEG is decoded at a half, a quarter or an eighth; 16-bit grey becomes 8-bit.
    """
    image = _load(path, long_side)
    if image.mode.startswith("I"):
        # 16-bit files may come as 32-bit pixels
        return Image.fromarray((np.asarray(image, dtype=np.int64).clip(0, 65535) // 257).astype(np.uint8))
    if image.mode.startswith("F"):
        raise KroncError(f"{path} has floating-point pixels: expected 8 or 16 bits a channel; convert it")
    return image


def _load(path: Path, long_side: int | None = None) -> Image.Image:
    try:
        with Image.open(path) as image:
            if long_side is not None and max(image.size) > long_side:
                factor = long_side / max(image.size)
                image.draft(None, (math.ceil(factor * image.width), math.ceil(factor * image.height)))
            image.load()
    except FileNotFoundError:
        raise KroncError(f"{path} does not exist") from None
    except _READ_ERRORS as error:
        reason = "no image format" if "cannot identify" in str(error) else str(error)
        raise KroncError(f"{path} is no image that can be read ({reason}): replace or remove it") from None
    return image


def is_turned(image: Image.Image) -> bool:
    """Whether the EXIF orientation says that the image is to be shown other than it is stored."""
    return image.getexif().get(ExifTags.Base.Orientation, 1) in range(2, 9)


def upright_size(path: Path, orient: bool = True) -> tuple[int, int]:
    """(width, height) as shown, from the header alone; with ``orient`` False as stored."""
    try:
        with Image.open(path) as image:
            width, height = image.size
            swapped = orient and image.getexif().get(ExifTags.Base.Orientation, 1) in range(5, 9)
    except _READ_ERRORS as error:
        reason = "no image format" if "cannot identify" in str(error) else str(error)
        raise KroncError(f"{path} is no image that can be read ({reason}): replace or remove it") from None
    return (height, width) if swapped else (width, height)


def copy_upright(source: Path, target: Path, orient: bool = True) -> Image.Image:
    """Copy a photo with its EXIF orientation applied; byte for byte where there is none. Returns the image.

    HEIF, which few programs read, is coded anew in the format of ``target``.
    """
    image = load_image(source)
    if (orient and is_turned(image)) or source.suffix.lower() in HEIF_SUFFIXES:
        upright = ImageOps.exif_transpose(image)
        if source.suffix.lower() in HEIF_SUFFIXES:
            upright = upright.convert("RGB")  # JPEG has no alpha
        options: dict[str, Any] = (
            {"quality": 95, "subsampling": 0} if target.suffix.lower() in (".jpg", ".jpeg") else {}
        )
        upright.save(target, exif=upright.getexif(), icc_profile=image.info.get("icc_profile"), **options)
        return upright
    shutil.copyfile(source, target)
    return image


def downscale_factors(size: tuple[int, int], num_downscales: int) -> tuple[int, ...]:
    """2, 4, 8, ... as far as the smaller side keeps about 100 px."""
    levels = min(num_downscales, int(math.log2(max(1.0, min(size) / _SMALLEST_SIDE))))
    return tuple(2**level for level in range(1, levels + 1))


def downscale(image: Image.Image, factor: int) -> Image.Image:
    """Means of ``factor`` x ``factor`` pixels, in which alpha weighs the colours.

    Left-over rows and columns are cut off, so that pixels scale by ``factor`` exactly, as nerfstudio assumes of
    the intrinsics.
    """
    if image.mode in ("P", "1"):
        image = image.convert("RGBA" if "transparency" in image.info else "L" if image.mode == "1" else "RGB")
    width, height = (side // factor * factor for side in image.size)
    return image.reduce(factor, box=(0, 0, width, height))


def write_downscales(image: Image.Image, target: Path, factors: tuple[int, ...]) -> None:
    """Write ``images_2/NAME``, ``images_4/NAME``, ... beside ``images/NAME``, which is ``target``."""
    for factor in factors:
        path = level_path(target, factor)
        path.parent.mkdir(exist_ok=True)
        options: dict[str, Any] = {"quality": 95} if path.suffix.lower() in (".jpg", ".jpeg", ".webp") else {}
        downscale(image, factor).save(path, **options)


def level_path(path: Path, factor: int) -> Path:
    """Where nerfstudio looks for an image or mask at 1/``factor`` of its size."""
    return path if factor == 1 else path.parent.with_name(f"{path.parent.name}_{factor}") / path.name
