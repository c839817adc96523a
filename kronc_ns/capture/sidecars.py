"""What lies beside the images of a scene folder and goes with them: depth maps, and poses to compare with."""

import shutil
from pathlib import Path, PurePosixPath
from typing import Any

from kronc_ns.capture.frames import Frames
from kronc_ns.capture.source import Source
from kronc_ns.errors import KroncError
from kronc_ns.files.images import read_depth
from kronc_ns.files.output import read_json, write_json


def check_sidecars(source: Source) -> None:
    """Raise `KroncError` for depth maps and a ``reference.json`` that cannot be read."""
    if source.reference is not None:
        _read_reference(source.reference)
    for depth in source.depths or ():
        read_depth(depth)


def copy_depths(source: Source, frames: Frames, out: Path) -> tuple[str, ...] | None:
    """Copy the depth maps of a scene folder; their new paths."""
    if source.depths is None:
        return None
    (out / "depths").mkdir(exist_ok=True)
    stems = (PurePosixPath(name).stem for name in frames.names)
    names = tuple(f"depths/{stem}{depth.suffix}" for stem, depth in zip(stems, source.depths, strict=True))
    for depth, name in zip(source.depths, names, strict=True):
        shutil.copyfile(depth, out / name)
    return names


def copy_reference(source: Source, frames: Frames, out: Path) -> None:
    """Copy ``reference.json`` with the new names of the frames, for `kronc eval`."""
    if source.reference is None:
        return
    content = _read_reference(source.reference)
    renamed = dict(zip(frames.source_names, frames.names, strict=True))
    renamed |= {PurePosixPath(old).name: new for old, new in renamed.items()}
    known = []
    for frame in content["frames"]:
        old = str(frame["file_path"])
        name = renamed.get(old) or renamed.get(PurePosixPath(old).name)
        if name is not None:
            poses_only = {key: value for key, value in frame.items() if not key.endswith("_path")}
            known.append({"file_path": name, **poses_only})
    without_files = {key: value for key, value in content.items() if not key.endswith("_path")}
    write_json(out / "reference.json", {**without_files, "frames": known})


def _read_reference(file: Path) -> dict[str, Any]:
    content = read_json(file)
    listed = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(listed, list) or not all(isinstance(f, dict) and "file_path" in f for f in listed):
        raise KroncError(f'{file}: expected "frames", a list of objects with "file_path"; mend or remove it')
    return content
