"""Numbers as tools write them become rows of (u, v, confidence); what is no number stays NaN until it is counted."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from kronc_ns.errors import KroncError
from kronc_ns.keypoints.schema import KeypointSchema

_LIKELY = 0.5  # of the best score in an image: below it are a detector's second thoughts, often of the same car


def number(value: Any) -> float:
    """A number that a file holds; NaN for anything else (null, text, true)."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return np.nan
    try:
        return float(value)
    except OverflowError:  # an integer of hundreds of digits
        return np.inf


def flat_numbers(values: Any, where: str) -> Float[np.ndarray, "_"]:
    """The numbers of a list, or of a list of lists."""
    if not isinstance(values, list):
        raise KroncError(f"{where}: keypoints are {str(values)[:40]!r}: expected a list of numbers")
    flat = (v for value in values for v in (value if isinstance(value, list) else [value]))
    return np.array([number(value) for value in flat], dtype=np.float64)


def rows_of(values: Any, schema: KeypointSchema, where: str) -> Float[np.ndarray, "j 3"]:
    """(u, v, confidence) of each point of the schema, from u, v, confidence, u, v, confidence, ..."""
    flat = flat_numbers(values, where)
    if len(flat) != 3 * len(schema):
        raise KroncError(
            f"{where}: {len(flat) / 3:g} keypoints, expected {len(schema)} for schema {schema.name!r} "
            "(--keypoint-names says another)"
        )
    return flat.reshape(-1, 3)


def stacked(instances: Sequence[Float[np.ndarray, "j 3"]], schema: KeypointSchema) -> Float[np.ndarray, "_ j 3"]:
    """The instances of an image in one array, of none too."""
    return np.stack(instances) if instances else np.zeros((0, len(schema), 3))


def from_pixel_indices(rows: Float[np.ndarray, "*m j 3"]) -> Float[np.ndarray, "*m j 3"]:
    """Ours from a convention in which the centre of the top-left pixel is (0, 0)."""
    return rows + np.array([0.5, 0.5, 0.0])


def from_flags(instances: Iterable[Float[np.ndarray, "j 3"]]) -> list[Float[np.ndarray, "j 3"]]:
    """Confidences from COCO's flags (0 not labelled, 1 hidden, 2 seen) where that is what they are: halves of them."""
    instances = list(instances)
    labels = np.concatenate([rows[:, 2] for rows in instances] or [np.zeros(0)])
    labels = labels[np.isfinite(labels)]
    are_flags = np.isin(labels, (0.0, 1.0, 2.0)).all() and (labels == 2.0).any()
    return [rows / [1.0, 1.0, 2.0] for rows in instances] if are_flags else instances


def from_scores(rows: Float[np.ndarray, "*m j 3"]) -> Float[np.ndarray, "*m j 3"]:
    """Confidences from the heights of a network's peaks, which may go beyond 0 and 1."""
    return np.concatenate([rows[..., :2], np.clip(rows[..., 2:], 0.0, 1.0)], axis=-1)


def likely(instances: Sequence[Float[np.ndarray, "j 3"]], scores: Sequence[float]) -> list[Float[np.ndarray, "j 3"]]:
    """Those of an image's instances whose score is at least half of the best one."""
    known = np.nan_to_num(np.asarray(scores, dtype=np.float64))
    return [rows for rows, score in zip(instances, known, strict=True) if score >= _LIKELY * known.max()]


def unusable(rows: Float[np.ndarray, "*m j 3"]) -> Bool[np.ndarray, "*m j"]:
    """Where a point that is not marked as unseen has a place or confidence that is no finite number."""
    return (rows[..., 2] != 0) & ~np.isfinite(rows).all(-1)


def usable(rows: Float[np.ndarray, "*m j 3"]) -> Float[np.ndarray, "*m j 3"]:
    """Zeros where nothing was seen, and for what is `unusable`."""
    return np.where((rows[..., 2:] != 0) & ~unusable(rows)[..., None], rows, 0.0)


def told_unusable(frames: Mapping[str, Float[np.ndarray, "_ j 3"]], schema: KeypointSchema) -> str:
    """How many points are `unusable`, and the first of them; empty where none is."""
    masks = {name: unusable(rows) for name, rows in frames.items()}
    count = sum(int(mask.sum()) for mask in masks.values())
    if not count:
        return ""
    name, mask = next((name, mask) for name, mask in masks.items() if mask.any())
    point = schema.keypoints[int(np.argwhere(mask)[0, -1])]
    first = f"{point!r} in {name}{', ...' if count > 1 else ''}"
    return f"keypoints that are no finite numbers and count as not seen: {count} ({first})"
