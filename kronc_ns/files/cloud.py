"""features.npz beside a solution: the points of image features and where they were seen."""

import zlib
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from kronc_ns.errors import KroncError
from kronc_ns.files.output import atomic_path
from kronc_ns.solution import Cloud

FILE = "features.npz"
_KINDS = {"points": "f", "colours": "u", "on_vehicle": "b", "first": "iu", "view": "iu", "pixel": "f"}


def write_cloud(folder: Path, cloud: Cloud | None) -> None:
    """Write a cloud; without one, that of an earlier solution is deleted."""
    if cloud is None:
        (folder / FILE).unlink(missing_ok=True)
        return
    content = {
        "points": cloud.points,
        "colours": cloud.colours,
        "on_vehicle": cloud.on_vehicle,
        "first": cloud.first.astype(np.int32),
        "view": cloud.view.astype(np.int32),
        "pixel": cloud.pixel.astype(np.float32),
    }
    with atomic_path(folder / FILE) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **content)


def read_cloud(folder: Path, views: int) -> Cloud | None:
    """The cloud of a solved folder of so many views; None where there is none."""
    file = folder / FILE
    if not file.exists():
        return None
    try:
        with np.load(file, allow_pickle=False) as content:
            found = {name: content[name] for name in _KINDS}
    except (
        OSError,
        ValueError,
        KeyError,
        EOFError,
        AttributeError,
        NotImplementedError,
        BadZipFile,
        zlib.error,
    ) as error:
        raise KroncError(f"{file} cannot be read ({error!r:.100}): refine again, or delete it") from None
    points, sightings = len(found["points"]), len(found["view"])
    shapes = {
        "points": (points, 3),
        "colours": (points, 3),
        "on_vehicle": (points,),
        "first": (points + 1,),
        "view": (sightings,),
        "pixel": (sightings, 2),
    }
    first, view = found["first"], found["view"]
    sound = all(found[name].shape == shape and found[name].dtype.kind in _KINDS[name] for name, shape in shapes.items())
    if (
        not sound
        or first[0] != 0
        or first[-1] != sightings
        or (np.diff(first) < 0).any()
        or (sightings and not 0 <= view.min() <= view.max() < views)
        or not np.isfinite(found["points"]).all()
        or not np.isfinite(found["pixel"]).all()
    ):
        raise KroncError(f"{file} does not fit its solution: refine again, or delete it")
    return Cloud(
        found["points"].astype(np.float64),
        found["colours"].astype(np.uint8),
        found["on_vehicle"],
        first.astype(np.int64),
        view.astype(np.int64),
        found["pixel"].astype(np.float64),
    )
