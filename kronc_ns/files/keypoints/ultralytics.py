"""Ultralytics YOLO pose labels (8.3): a text file of the image's stem, a line an object, in shares of the image.

A line is ``class x y width height``, then ``u v`` or ``u v visibility`` of each point; predictions (``save_txt``) add
the object's confidence and its track where these are asked for. Its documentation does not say where pixels lie; its
mirror image of u is 1 - u, so the shares are of the whole image, from border to border.
"""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints.detections import Detections
from kronc_ns.files.keypoints.rows import from_flags, from_scores, likely, stacked
from kronc_ns.files.keypoints.schemas import schema_of_names
from kronc_ns.keypoints.schema import APOLLOCAR3D_66, KNOWN_SCHEMAS, KeypointSchema, schema_of_count

_BOX = 5  # numbers before the points
_BEHIND = (0, 1, 2)  # numbers after them


@dataclass(frozen=True)
class _Line:
    image: str
    """Stem of its name."""
    where: str
    numbers: Float[np.ndarray, "_"]

    def fits(self, count: int, dims: int) -> bool:
        return len(self.numbers) - _BOX - count * dims in _BEHIND


def holds_ultralytics(folder: Path) -> bool:
    """Whether there are text files in ``labels/`` (or this is it), or some here that begin like labels."""
    if any((folder / "labels").rglob("*.txt")) or (folder.name == "labels" and any(folder.rglob("*.txt"))):
        return True
    with suppress(KroncError):  # other text, in any encoding
        for file in folder.glob("*.txt"):
            for line in _lines(file):
                return len(line.numbers) > _BOX and bool(np.isfinite(line.numbers[:_BOX]).all())
    return False


def read_ultralytics(folder: Path, names: KeypointSchema | None) -> Detections:
    """All labels in a folder or in its ``labels/``; of several objects, those below half of the best confidence go.

    How many points a line has is said by ``names``, by a dataset's YAML (``kpt_shape``) beside or above the folder, or
    by a length that fits a known schema.
    """
    labels = folder / "labels" if (folder / "labels").is_dir() else folder
    files = sorted(labels.rglob("*.txt") if labels.name == "labels" else labels.glob("*.txt"))
    stems = [file.stem for file in files]
    if len(set(stems)) < len(stems):
        twice = next(stem for stem in stems if stems.count(stem) > 1)
        raise KroncError(f"{labels}: two files are called {twice}.txt: expected labels of one image each")
    lines = [line for file in files for line in _lines(file)]
    schema, dims = _shape(labels, lines, names)
    rows = from_flags(_points(line, len(schema), dims) for line in lines)
    found: dict[str, list[tuple[np.ndarray, float]]] = {stem: [] for stem in stems}
    for line, uvc in zip(lines, rows, strict=True):
        found[line.image].append((from_scores(uvc), _confidence(line, len(schema) * dims)))
    frames = {
        image: stacked(likely(*zip(*objects, strict=True)) if objects else [], schema)
        for image, objects in found.items()
    }
    return Detections(labels, schema, frames, called="stem", relative=True)


def _lines(file: Path) -> Iterable[_Line]:
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise KroncError(f"{file} cannot be read ({error}): expected Ultralytics' pose labels") from None
    for i, line in enumerate(text.splitlines(), start=1):
        if line.strip():
            yield _Line(file.stem, f"{file}, line {i}", np.array([_number(word) for word in line.split()]))


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return np.nan


def _shape(labels: Path, lines: list[_Line], names: KeypointSchema | None) -> tuple[KeypointSchema, int]:
    """The points of every line, and how many numbers each has."""
    said = _dataset(labels)
    if said is not None:
        schema, dims = said
        if names is not None and len(names) != len(schema):
            raise KroncError(
                f"{labels}: the dataset's kpt_shape has {len(schema)} points, --keypoint-names {len(names)}: expected "
                "names for all of them"
            )
        return names or schema, dims
    candidates = [names] if names is not None else [*KNOWN_SCHEMAS.values()]
    if not lines:
        return names or APOLLOCAR3D_66, 3
    for schema in candidates:
        for dims in (3, 2):
            if all(line.fits(len(schema), dims) for line in lines):
                return schema, dims
    expected = f"{_BOX} and 2 or 3 for each of {' or '.join(str(len(schema)) for schema in candidates)} points"
    odd = next(line for line in lines if not any(line.fits(len(s), d) for s in candidates for d in (3, 2)))
    raise KroncError(
        f"{odd.where}: {len(odd.numbers)} numbers, expected {expected}: say which points they are with "
        "--keypoint-names, or put the dataset's YAML with kpt_shape beside the labels"
    )


def _dataset(labels: Path) -> tuple[KeypointSchema, int] | None:
    """What a dataset's YAML says of the points: kpt_shape, and where it has them kpt_names and flip_idx."""
    import yaml  # which reading any other keypoints can do without

    for place in (labels, labels.parent, labels.resolve().parent.parent):
        for file in sorted([*place.glob("*.yaml"), *place.glob("*.yml")]):
            try:
                content = yaml.safe_load(file.read_text(encoding="utf-8"))
            except (OSError, UnicodeDecodeError, yaml.YAMLError):
                continue  # some other YAML
            if isinstance(content, dict) and "kpt_shape" in content:
                return _described(content, file)
    return None


def _described(content: dict[str, Any], file: Path) -> tuple[KeypointSchema, int]:
    shape = content["kpt_shape"]
    if not isinstance(shape, list) or len(shape) != 2 or shape[1] not in (2, 3) or not isinstance(shape[0], int):
        raise KroncError(f"{file}: kpt_shape is {shape}: expected [number of points, 2 or 3]")
    count, dims = shape
    names, flip = content.get("kpt_names"), content.get("flip_idx")
    if isinstance(names, dict | list) and names:
        names = next(iter(names.values())) if isinstance(names, dict) else names[0]
    if isinstance(names, list) and len(names) == count:
        flip = flip if isinstance(flip, list) and len(flip) == count else None
        return schema_of_names(file.stem, [str(name) for name in names], flip), dims
    return schema_of_count(count), dims


def _points(line: _Line, count: int, dims: int) -> Float[np.ndarray, "j 3"]:
    """(share of width, share of height, visibility); a point at (0, 0) is one that is not there."""
    if not line.fits(count, dims):
        raise KroncError(
            f"{line.where}: {len(line.numbers)} numbers, expected {_BOX} and {count} times {dims}, as the other lines "
            "have or kpt_shape says, and perhaps a confidence and a track"
        )
    points = line.numbers[_BOX : _BOX + count * dims].reshape(count, dims)
    places = points[:, :2]
    outside = places[np.isfinite(places) & (np.abs(places - 0.5) > 1)]
    if outside.size:
        raise KroncError(f"{line.where}: a point is at {outside[0]:g}: expected shares of the image, 0 to 1")
    visible = points[:, 2:] if dims == 3 else np.ones((count, 1))
    there = (places != 0).any(1, keepdims=True)
    return np.concatenate([places, np.where(there, visible, 0.0)], axis=1)


def _confidence(line: _Line, points: int) -> float:
    """Of the object, where the line has one: a single number above 1 is a track."""
    behind = line.numbers[_BOX + points :]
    return float(behind[0]) if len(behind) and behind[0] <= 1 else 1.0
