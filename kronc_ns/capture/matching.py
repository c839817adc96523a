"""Which keypoints of a file belong to which frames, whatever the file calls them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float

from kronc_ns.capture.frames import Frames
from kronc_ns.files.keypoints import Detections, match_keypoints, sigma_of, under_file_names
from kronc_ns.geometry.camera import Camera
from kronc_ns.keypoints.schema import KeypointSchema


@dataclass(frozen=True, eq=False)
class Matched:
    """Keypoints of one car for each frame."""

    source: Path
    """Where they were read from."""
    schema: KeypointSchema
    rows: Float[np.ndarray, "n j 3"]
    sigma_px: Float[np.ndarray, "n j"] | None
    note: str
    """Choices made among several cars."""


def match_frames(
    found: Detections, every_name: Sequence[str], frames: Frames, camera: Camera, masks: list[Path] | None = None
) -> Matched:
    """The keypoints of ``frames``, under their new names or those of the source, which are ``every_name``.

    Those of photos that were left out are not needed; any other name is a `KroncError`.
    """
    for calling in (every_name, frames.names):
        found = under_file_names(found, calling)
    names = frames.names if _covers(frames.names, found) else frames.source_names
    if _covers(every_name, found):
        names = frames.source_names
        left_out = {*every_name} - {*names}
        left_out |= {_file(name) for name in left_out} - {_file(name) for name in names}
        found = replace(found, frames={key: rows for key, rows in found.frames.items() if key not in left_out})
    rows, note = match_keypoints(found, tuple(names), camera, masks, frames.sizes)
    return Matched(found.source, found.schema, rows, sigma_of(found, tuple(names), rows), note)


def _covers(names: Sequence[str], found: Detections) -> bool:
    """Whether every image that ``found`` knows has one of these paths or file names."""
    files = {_file(name) for name in names}
    return all(_file(key) in files for key in found.frames)


def _file(name: str) -> str:
    return PurePosixPath(name).name
