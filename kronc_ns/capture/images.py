"""Single image files: read with a helpful error, copied upright, downscaled."""

import math
import shutil
import struct
import zlib
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image, ImageOps
from PIL.TiffImagePlugin import TiffImageFile

from kronc_ns.capture.pixel_modes import is_plain, plain
from kronc_ns.errors import KroncError

_READ_ERRORS = (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error, Image.DecompressionBombError)
HEIF_SUFFIXES = (".heic", ".heif")
"""Photos that `read_heif` lets be read, in lower case."""
_JPEG = {"quality": 95, "subsampling": 0}
_CODING = {".jpg": _JPEG, ".jpeg": _JPEG, ".webp": {"quality": 95}, ".png": {"compress_level": 3}}
_SMALLEST_SIDE = 100  # px; below, a downscaled copy shows nothing to train on


def read_heif(path: Path) -> None:
    """Let Pillow read HEIF, upright, in this process; ``path`` is the photo that asks for it."""
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        raise KroncError(f"{path} needs pillow-heif, which is not installed: pip install 'kronc-ns[heic]'") from None
    register_heif_opener(thumbnails=False)


def load_image(path: Path) -> Image.Image:
    """The whole decoded image as it is stored (EXIF orientation not applied) as 8-bit grey, RGB or RGBA."""
    return _load(path)[0]


def load_small(path: Path, long_side: int) -> Image.Image:
    """`load_image`, as cheaply as the format allows, not below ``long_side`` px where it is larger.

    JPEG is decoded at a half, a quarter or an eighth.
    """
    return _load(path, long_side)[0]


def _load(path: Path, long_side: int | None = None) -> tuple[Image.Image, bool]:
    """The image, and whether the file holds such pixels itself."""
    try:
        with Image.open(path) as image:
            as_stored = is_plain(image)
            if long_side is not None and max(image.size) > long_side:
                factor = long_side / max(image.size)
                image.draft(None, (math.ceil(factor * image.width), math.ceil(factor * image.height)))
            image.load()
    except FileNotFoundError:
        raise KroncError(f"{path} does not exist") from None
    except _READ_ERRORS as error:
        raise _unreadable(path, error) from None
    return plain(image, path), as_stored


def _unreadable(path: Path, error: Exception) -> KroncError:
    reason = "no image format" if "cannot identify" in str(error) else str(error)
    return KroncError(f"{path} is no image that can be read ({reason}): replace or remove it")


def is_turned(image: Image.Image) -> bool:
    """Whether the EXIF orientation says that the image is to be shown other than it is stored."""
    return image.getexif().get(ExifTags.Base.Orientation, 1) in range(2, 9)


def upright_size(path: Path, orient: bool = True) -> tuple[int, int]:
    """(width, height) as shown, from the header alone; with ``orient`` False as stored.

    TIFF is always upright: Pillow turns it while reading, and trainers read with Pillow.
    """
    try:
        with Image.open(path) as image:
            width, height = image.size
            turned = image.getexif().get(ExifTags.Base.Orientation, 1) in range(5, 9)
            if isinstance(image, TiffImageFile):  # some versions of Pillow give the size upright, some as stored
                width, height = (image.tag_v2[tag] for tag in (ExifTags.Base.ImageWidth, ExifTags.Base.ImageLength))
                orient = True
    except _READ_ERRORS as error:
        raise _unreadable(path, error) from None
    return (height, width) if turned and orient else (width, height)


def copy_upright(source: Path, target: Path, orient: bool = True) -> Image.Image:
    """Copy a photo with its EXIF orientation applied; byte for byte where trainers read its pixels. Returns the image.

    HEIF, and pixels other than 8-bit grey, RGB and RGBA, are coded anew in the format of ``target``.
    """
    image, as_stored = _load(source)
    heif = source.suffix.lower() in HEIF_SUFFIXES
    if as_stored and not heif and not (orient and is_turned(image)):
        shutil.copyfile(source, target)
        return image
    upright = ImageOps.exif_transpose(image) if orient or heif else image
    if target.suffix.lower() in (".jpg", ".jpeg") and upright.mode == "RGBA":
        upright = upright.convert("RGB")  # JPEG has no alpha
    options: dict[str, Any] = _CODING.get(target.suffix.lower(), {})
    # of a TIFF's tags some say how its own pixels lie
    exif = {} if target.suffix.lower() in (".tif", ".tiff") else {"exif": upright.getexif()}
    upright.save(target, icc_profile=upright.info.get("icc_profile"), **exif, **options)
    return upright


def downscale_factors(size: tuple[int, int], num_downscales: int) -> tuple[int, ...]:
    """2, 4, 8, ... as far as the smaller side keeps about 100 px."""
    levels = min(num_downscales, int(math.log2(max(1.0, min(size) / _SMALLEST_SIDE))))
    return tuple(2**level for level in range(1, levels + 1))


def downscale(image: Image.Image, factor: int) -> Image.Image:
    """Means of ``factor`` x ``factor`` pixels, in which alpha weighs the colours.

    Left-over rows and columns are cut off, so that pixels scale by ``factor`` exactly, as nerfstudio assumes of
    the intrinsics.
    """
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
