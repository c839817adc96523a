"""What a keypoint file holds, and which of it belongs to which view."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from jaxtyping import Float
from typing_extensions import assert_never

from kronc_ns.errors import KroncError
from kronc_ns.files.images import read_grey
from kronc_ns.geometry.camera import Camera
from kronc_ns.keypoints.schema import KeypointSchema
from kronc_ns.keypoints.selection import select_instances

Called = Literal["file", "stem", "number"]
"""What a tool calls an image: its path or file name; the name without suffix; the number at the end of that."""


@dataclass(frozen=True)
class Detections:
    """What a keypoint file holds, before anyone has chosen one car per image."""

    source: Path
    schema: KeypointSchema
    frames: Mapping[str, Float[np.ndarray, "_ j 3"]]
    """Image as the file calls it -> its M instances of (u, v, confidence); confidence 0: not seen."""
    size: tuple[int, int] | None = None
    """(width, height) of the images, where the file says one for all."""
    sigma_px: Mapping[str, Float[np.ndarray, "_ j"]] | None = None
    """Standard deviation of each place along one axis, beside `frames`, where the detector knew it; 0: not seen."""
    called: Called = "file"
    """How `frames` names the images."""
    relative: bool = False
    """(u, v) are shares of the image's width and height instead of pixels."""
    notes: tuple[str, ...] = ()
    """What reading left out."""
    sizes: Mapping[str, tuple[int, int]] | None = None
    """(width, height) of each image, beside `frames`, where the file says it of each."""


def match_keypoints(
    found: Detections,
    names: tuple[str, ...],
    camera: Camera,
    masks: list[Path] | None = None,
    sizes: Sequence[tuple[int, int]] | None = None,
) -> tuple[Float[np.ndarray, "n j 3"], str]:
    """Rows for each view from a keypoint file, matched by path or else by file name; and a note on choices made.

    ``sizes`` are the (width, height) of the images where they are not all the camera's.
    """
    each = sizes or [(camera.width, camera.height)] * len(names)
    keys = _keys(found, names)
    _check_sizes(found, keys, dict(zip(names, each, strict=True)))
    empty = np.zeros((0, len(found.schema), 3))
    instances = [found.frames[keys[name]] if name in keys else empty for name in names]
    if found.relative:
        instances = [rows * np.array([*size, 1.0]) for rows, size in zip(instances, each, strict=True)]
    if not any((rows[..., 2] > 0).any() for rows in instances):
        raise KroncError(
            f"{found.source}: no keypoints for any of the {len(names)} images: expected at least 4 in 3 views"
        )
    several = [i for i, rows in enumerate(instances) if len(rows) > 1]
    read = [read_grey(path) if i in several else None for i, path in enumerate(masks)] if masks and several else None
    rows, note = select_instances(instances, each, read)
    return rows, "; ".join([*found.notes, *([note] if several else [])])


def _check_sizes(found: Detections, keys: Mapping[str, str], sizes: Mapping[str, tuple[int, int]]) -> None:
    """Raise `KroncError` where the file's images are not of the images' (width, height)."""
    here = sorted(set(sizes.values()))
    if found.size is not None and here != [found.size]:
        what = "x".join(map(str, here[0])) if len(here) == 1 else f"{len(here)} sizes"
        raise KroncError(
            f"{found.source} is for {found.size[0]}x{found.size[1]} images, the camera says {what}: expected "
            "keypoints in the pixels of the images" + ", and no width and height for all" * (len(here) > 1)
        )
    for name, key in keys.items():
        size = (found.sizes or {}).get(key, sizes[name])
        if size != sizes[name]:
            raise KroncError(
                f"{found.source}: {key} is {size[0]}x{size[1]}, {name} {sizes[name][0]}x{sizes[name][1]}: "
                "expected keypoints in the pixels of the images"
            )


def _keys(found: Detections, names: tuple[str, ...]) -> dict[str, str]:
    """What the file calls each of these images; a `KroncError` where it has others, too."""
    own = _names_by(found.called, names)
    keys: dict[str, str] = {}
    unknown = []
    for key in found.frames:
        plain = PurePosixPath(key).name if found.called == "file" else key
        if name := key if key in names else own.get(plain, ""):
            keys[name] = key
        else:
            unknown.append(key)
    if unknown:
        raise KroncError(
            f"{found.source} has keypoints for {len(unknown)} images that do not exist ({unknown[0]}): expected "
            + _expected(found.called, names[0])
        )
    return keys


def _expected(called: Called, name: str) -> str:
    match called:
        case "file":
            return f"names like {name}"
        case "stem":
            return f"names like {_called(called, name)}, of {name}"
        case "number":
            return (
                f"the number at the end of an image's name ({name}), or beside the file the COCO annotations "
                "whose images have these ids"
            )
        case _:
            assert_never(called)


def under_file_names(found: Detections, names: Sequence[str]) -> Detections:
    """The same under the images' own names, if the file calls all of them by the stems or numbers of ``names``."""
    if found.called == "file":
        return found
    own = _names_by(found.called, names)
    if not all(own.get(key) for key in found.frames):
        return found
    return replace(found, frames={own[key]: rows for key, rows in found.frames.items()}, called="file")


def _names_by(called: Called, names: Sequence[str]) -> dict[str, str]:
    """What a tool calls each image -> its name; "" where it would call several so."""
    by: dict[str, str] = {}
    for name in names:
        key = _called(called, name)
        by[key] = "" if key in by else name
    return by


def _called(called: Called, name: str) -> str:
    path = PurePosixPath(name)
    match called:
        case "file":
            return path.name
        case "stem":
            return path.stem
        case "number":
            digits = path.stem[len(path.stem.rstrip("0123456789")) :]
            return str(int(digits)) if digits else ""
        case _:
            assert_never(called)


def sigma_of(
    found: Detections, names: tuple[str, ...], rows: Float[np.ndarray, "n j 3"]
) -> Float[np.ndarray, "n j"] | None:
    """Standard deviations in pixels of the ``rows`` that `match_keypoints` chose for these names; None if unknown."""
    if found.sigma_px is None:
        return None
    by_file = {PurePosixPath(key).name: key for key in found.frames}
    sigma = np.zeros(rows.shape[:2])
    for i, name in enumerate(names):
        key = name if name in found.frames else by_file.get(PurePosixPath(name).name)
        for instance, its_own in zip(found.frames[key], found.sigma_px[key], strict=True) if key else ():
            if np.array_equal(instance, rows[i]):
                sigma[i] = its_own
    return sigma
