"""Where the focal length comes from: a calibration, the user, the photos' EXIF, or a stated assumption."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image

from kronc_ns.errors import KroncError
from kronc_ns.files.output import read_json
from kronc_ns.files.transforms import camera_and_frames
from kronc_ns.geometry.camera import Camera

FULL_FRAME_DIAGONAL_MM = 43.27
"""Diagonal of 36 mm x 24 mm: what 35 mm equivalent focal lengths refer to (CIPA's convention for all aspect ratios)."""
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}  # EXIF FocalPlaneResolutionUnit
_SAME_FOCAL = 0.01  # photos whose focal lengths differ by more were zoomed
_SAME_ASPECT = 0.01  # EXIF size and image of another aspect ratio: the photo was cropped


@dataclass(frozen=True)
class Intrinsics:
    """The camera of a capture, and why it should be believed."""

    camera: Camera
    source: str
    """Where the focal length came from, in words."""
    assumed: bool = False
    """Nobody said it: it is the assumed field of view."""
    cameras: tuple[Camera, ...] = ()
    """Of each image, where they are by several cameras; `camera` is then that of most."""


def find_intrinsics(
    size: tuple[int, int],
    photos: Sequence[Path] = (),
    given: Camera | None = None,
    focal_length_px: float | None = None,
    fov_deg: float = 65.0,
    given_by: str = "transforms.json",
) -> Intrinsics:
    """Intrinsics for images of ``size`` (width, height): the user's word first, then the file's, then EXIF.

    ``given_by`` says in words where ``given`` is from.
    Where none of them says, the longer side is assumed to span ``fov_deg``. The principal point is the image
    centre unless ``given`` says otherwise.
    """
    if given is not None and (given.width, given.height) != size:
        raise KroncError(
            f"the intrinsics are for {given.width}x{given.height} images, the images are {size[0]}x{size[1]}: "
            "expected intrinsics in the pixels of the images"
        )
    if focal_length_px is not None:
        camera = replace(given, fx=focal_length_px, fy=focal_length_px) if given else _centred(focal_length_px, size)
        return Intrinsics(camera, "--focal-length-px")
    if given is not None:
        return Intrinsics(given, given_by)
    found, why_not = exif_focal_px(photos)
    if found is not None:
        return Intrinsics(_centred(found.px, size), found.source)
    if not 1 <= fov_deg <= 170:
        raise KroncError(f"--fov-deg is {fov_deg:g}: expected degrees across the longer side, from 1 to 170")
    focal = max(size) / 2 / math.tan(math.radians(fov_deg) / 2)
    reason = f" ({why_not})" if why_not else ""
    return Intrinsics(_centred(focal, size), f"assumed field of view of {fov_deg:g} deg{reason}", assumed=True)


def find_all_intrinsics(
    sizes: Sequence[tuple[int, int]],
    photos: Sequence[Path] = (),
    given: Sequence[Camera] | None = None,
    focal_length_px: float | None = None,
    fov_deg: float = 65.0,
    given_by: str = "transforms.json",
) -> Intrinsics:
    """`find_intrinsics` of images of several ``sizes``, by several cameras or at several zoom settings.

    Photos of one size whose EXIF agrees are by one camera; those that say nothing are by the one of their size, where
    there is but one. With a single size for several ``photos`` (none, of a video) there is nothing to tell apart.
    """
    if len(sizes) != len(photos):
        return find_intrinsics(sizes[0], photos, given[0] if given else None, focal_length_px, fov_deg, given_by)
    focal = [None] * len(photos) if given or focal_length_px else [read_exif_focal(photo)[0] for photo in photos]
    groups = _groups(sizes, [None if found is None else found.px for found in focal], given)
    found: list[Intrinsics] = []
    for group in groups:
        first = group[0]
        own = given[first] if given else None
        its_photos = [photos[i] for i in group]
        found.append(find_intrinsics(sizes[first], its_photos, own, focal_length_px, fov_deg, given_by))
    if len(found) == 1:
        return found[0]
    cameras = {i: one.camera for group, one in zip(groups, found, strict=True) for i in group}
    told = [f"{len(group)} images: {one.source}" for group, one in zip(groups, found, strict=True)]
    largest = max(range(len(groups)), key=lambda k: len(groups[k]))
    return Intrinsics(
        found[largest].camera,
        "; ".join(told),
        any(one.assumed for one in found),
        tuple(cameras[i] for i in range(len(photos))),
    )


def _groups(
    sizes: Sequence[tuple[int, int]], focal_px: Sequence[float | None], given: Sequence[Camera] | None
) -> list[list[int]]:
    """Indices of the images of each camera."""
    groups: dict[object, list[int]] = {}
    if given:
        for i, camera in enumerate(given):
            groups.setdefault(camera, []).append(i)
        return [*groups.values()]
    shortest: dict[tuple[int, int], list[float]] = {size: [] for size in sizes}
    for size, px in sorted((size, px) for size, px in zip(sizes, focal_px, strict=True) if px is not None):
        if not shortest[size] or px > shortest[size][-1] * (1 + _SAME_FOCAL):
            shortest[size].append(px)
    for i, (size, px) in enumerate(zip(sizes, focal_px, strict=True)):
        zooms = shortest[size]
        zoom = len(zooms) if px is None else sum(px >= least for least in zooms) - 1
        groups.setdefault((size, 0 if px is None and len(zooms) == 1 else zoom), []).append(i)
    return [*groups.values()]


def read_calibration(file: Path, size: tuple[int, int]) -> Camera:
    """The camera of a JSON file with intrinsics and distortion as in transforms.json, for images of ``size``.

    A calibration of images of the same shape and another size is scaled.
    """
    content = read_json(file)
    if not isinstance(content, dict):
        raise KroncError(f"{file}: expected an object with fl_x, cx, cy, w and h, as in nerfstudio's transforms.json")
    camera, _ = camera_and_frames({**content, "frames": [{"file_path": file.name}]}, file)
    factor = size[0] / camera.width
    scaled = camera if factor == 1 else camera.scaled(factor)
    if (scaled.width, scaled.height) != size:
        raise KroncError(
            f"{file} is for {camera.width}x{camera.height} images, the images are {size[0]}x{size[1]}: "
            "expected a calibration of images of the same shape, upright"
        )
    return scaled


@dataclass(frozen=True)
class ExifFocal:
    """A focal length from EXIF, in pixels of the image as stored."""

    px: float
    source: str


def exif_focal_px(photos: Sequence[Path]) -> tuple[ExifFocal | None, str]:
    """The one focal length of all photos that say it (None: none does, and why).

    Raises `KroncError` where two photos disagree: a scene has one camera.
    """
    found: dict[Path, ExifFocal] = {}
    why_not = ""
    for photo in photos:
        focal, reason = read_exif_focal(photo)
        why_not = why_not or reason
        if focal is not None:
            found[photo] = focal
    if not found:
        return None, why_not
    shortest, longest = (pick(found, key=lambda photo: found[photo].px) for pick in (min, max))
    if found[longest].px > found[shortest].px * (1 + _SAME_FOCAL):
        raise KroncError(
            f"EXIF gives {shortest} a focal length of {found[shortest].px:.0f} px, {longest} {found[longest].px:.0f}: "
            "expected photos of one zoom setting; remove the others, or give --focal-length-px"
        )
    first = next(iter(found.values()))
    share = "" if len(found) == len(photos) else f" of {len(found)} of {len(photos)} photos"
    return replace(first, source=f"EXIF{share}: {first.source}"), ""


def read_exif_focal(photo: Path) -> tuple[ExifFocal | None, str]:
    """Focal length of one photo from its EXIF, or why there is none.

    FocalLength with the sensor's pixel pitch (FocalPlaneXResolution), which needs the recorded image size to be
    scaled to this file; else FocalLengthIn35mmFilm; else FocalLength with the sensor that COLMAP lists for the camera's
    model. A photo cropped after it was taken says nothing.
    """
    with Image.open(photo) as image:
        general = image.getexif()
        exif = general.get_ifd(ExifTags.IFD.Exif)
        size = image.size
    model = str(general.get(ExifTags.Base.Model, "")).strip(" \0")
    recorded = (_number(exif.get(ExifTags.Base.ExifImageWidth)), _number(exif.get(ExifTags.Base.ExifImageHeight)))
    if min(recorded) > 0 and abs(_aspect(size) / _aspect(recorded) - 1) > _SAME_ASPECT:
        whole = f"{recorded[0]:g}x{recorded[1]:g}"
        return None, f"{photo.name} is {size[0]}x{size[1]}, cropped from the {whole} that its EXIF is about"
    focal_mm = _number(exif.get(ExifTags.Base.FocalLength))
    per_unit = _number(exif.get(ExifTags.Base.FocalPlaneXResolution))
    unit_mm = _MM_PER_UNIT.get(int(_number(exif.get(ExifTags.Base.FocalPlaneResolutionUnit, 2))), 0.0)
    if min(focal_mm, per_unit, unit_mm, *recorded) > 0:
        px = focal_mm * per_unit / unit_mm * max(size) / max(recorded)
        sensor_mm = max(recorded) / per_unit * unit_mm
        return ExifFocal(px, f"{focal_mm:g} mm on a {sensor_mm:.1f} mm wide sensor"), ""
    film_mm = _number(exif.get(ExifTags.Base.FocalLengthIn35mmFilm))
    if film_mm > 0:
        return ExifFocal(film_mm * math.hypot(*size) / FULL_FRAME_DIAGONAL_MM, f"{film_mm:g} mm in 35 mm film"), ""
    if focal_mm > 0:
        known = _by_sensor_width(photo, model)
        if known is not None:
            return ExifFocal(known, f"{focal_mm:g} mm on the sensor of a {model}"), ""
        return (
            None,
            f"EXIF says {focal_mm:g} mm, but not on what sensor, and COLMAP's list lacks the {model or 'camera'}",
        )
    return None, "no focal length in the photos' EXIF"


def _by_sensor_width(photo: Path, model: str) -> float | None:
    """Focal length in px by COLMAP's list of cameras and their sensor widths, where it knows this one."""
    import zlib  # noqa: F401  pycolmap aborts where it is loaded first

    import pycolmap

    if not model:
        return None
    try:
        camera = pycolmap.infer_camera_from_image(str(photo))
    except (RuntimeError, ValueError):  # a format that it does not read
        return None
    return float(camera.mean_focal_length()) if camera.has_prior_focal_length else None


def _centred(focal_px: float, size: tuple[int, int]) -> Camera:
    return Camera(focal_px, focal_px, size[0] / 2, size[1] / 2, *size)


def _aspect(size: tuple[int, int] | tuple[float, float]) -> float:
    return max(size) / min(size)


def _number(value: Any) -> float:
    """A finite EXIF number, else 0 (EXIF's own word for unknown)."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if math.isfinite(number) else 0.0
