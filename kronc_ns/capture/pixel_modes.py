"""Decoded images of any kind of pixels as what trainers and networks read: 8-bit grey, RGB or RGBA."""

from contextlib import suppress
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image, ImageCms

from kronc_ns.errors import KroncError

_PLAIN = ("L", "RGB", "RGBA")


def is_plain(header: Image.Image) -> bool:
    """Whether a file, opened but not yet decoded, holds such pixels itself.

    nerfstudio reads a palette's numbers as grey, CMYK as RGBA and two tones as 0 and 1, and ends at grey with alpha.
    """
    # Pillow decodes 16-bit colours as 8 bits at once: only the raw mode in the list of tiles tells
    return header.mode in _PLAIN and ";16" not in str(getattr(header, "tile", ""))


def plain(image: Image.Image, path: Path) -> Image.Image:
    """The decoded image of ``path`` as 8-bit grey, RGB or RGBA, with its metadata as far as they still hold."""
    mode = image.mode
    if mode in _PLAIN:
        return image
    if mode.startswith("I"):  # 16 bits, which some versions of Pillow give 32
        grey = (np.asarray(image).astype(np.int32).clip(0, 65535) + 128) // 257
        return _with_info(Image.fromarray(grey.astype(np.uint8)), image)
    if mode == "CMYK":
        return _with_info(_printed(image), image, "icc_profile")
    if mode in ("P", "PA"):
        return _with_info(image.convert("RGBA" if mode == "PA" or "transparency" in image.info else "RGB"), image)
    if mode in ("1", "LA", "La"):  # their profiles are for grey
        return _with_info(image.convert("L" if mode == "1" else "RGBA"), image, "icc_profile")
    if mode in ("RGBa", "RGBX", "YCbCr", "HSV"):
        return _with_info(image.convert("RGBA" if mode == "RGBa" else "RGB"), image)
    what = "floating-point" if mode.startswith("F") else mode
    raise KroncError(
        f"{path} has {what} pixels: expected grey, RGB, CMYK or a palette with 8 or 16 bits a channel; convert it"
    )


def _printed(image: Image.Image) -> Image.Image:
    """CMYK as sRGB: by the file's own profile, else taken for pure inks."""
    profile = image.info.get("icc_profile")
    if profile:
        with suppress(ImageCms.PyCMSError, OSError):  # a profile that is broken or not of CMYK
            inks = ImageCms.ImageCmsProfile(BytesIO(profile))
            converted = ImageCms.profileToProfile(image, inks, ImageCms.createProfile("sRGB"), outputMode="RGB")
            if converted is not None:
                return converted
    return image.convert("RGB")


def _with_info(converted: Image.Image, original: Image.Image, *but: str) -> Image.Image:
    # in the alpha channel now; and Pillow has turned TIFF already, though its EXIF still says how
    gone = ("transparency", *but, *(["exif"] if original.format == "TIFF" else []))
    converted.info = {key: value for key, value in original.info.items() if key not in gone}
    return converted
