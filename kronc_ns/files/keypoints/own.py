"""Our ``keypoints.json``, read and written: the contract of the scene folder."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints.detections import Detections
from kronc_ns.files.keypoints.schemas import describe_schema, read_schema
from kronc_ns.files.output import write_json
from kronc_ns.keypoints.schema import KeypointSchema


def write_keypoints(
    path: Path,
    schema: KeypointSchema,
    size: tuple[int, int] | None,
    frames: Mapping[str, Float[np.ndarray, "j 3"]],
    sigma_px: Float[np.ndarray, "n j"] | None = None,
) -> None:
    """Write our ``keypoints.json`` (the contract of the scene folder); ``size`` where all images have the same."""
    rows: list[dict[str, Any]] = [
        {
            "file_path": name,
            "keypoints": [[round(float(u), 3), round(float(v), 3), round(float(c), 4)] for u, v, c in uvc],
        }
        for name, uvc in frames.items()
    ]
    for row, sigma in zip(rows, sigma_px if sigma_px is not None else (), strict=sigma_px is not None):
        row["sigma_px"] = [round(float(s), 3) for s in sigma]
    sides = {} if size is None else {"width": size[0], "height": size[1]}
    write_json(path, {"schema": describe_schema(schema), **sides, "frames": rows})


def read_own(path: Path, content: dict[str, Any], names: KeypointSchema | None) -> Detections:
    """Our own format, in which every number must be one; ``names`` calls the points otherwise than the file does."""
    schema = read_schema(content.get("schema"), path) if names is None else names
    try:
        size = (int(content["width"]), int(content["height"])) if {"width", "height"} <= content.keys() else None
    except (TypeError, ValueError, OverflowError):
        size_given = f"{content['width']!r} x {content['height']!r}"
        raise KroncError(f"{path}: width and height are {size_given}: expected pixels") from None
    if not isinstance(content["frames"], list):
        raise KroncError(f'{path}: expected "frames", a list of objects with "file_path" and "keypoints"')
    frames: dict[str, np.ndarray] = {}
    sigmas: dict[str, np.ndarray] = {}
    for number, frame in enumerate(content["frames"]):
        if not isinstance(frame, dict) or not {"file_path", "keypoints"} <= frame.keys():
            raise KroncError(f'{path}: frame {number} lacks "file_path" or "keypoints"')
        name = str(frame["file_path"])
        if name in frames:
            raise KroncError(f"{path}: two frames are called {name}: expected one entry per image")
        frames[name] = _rows(frame["keypoints"], schema, f"{path}, {name}")[None]
        if "sigma_px" in frame:
            sigmas[name] = _sigma(frame["sigma_px"], schema, f"{path}, {name}")[None]
    found = Detections(path, schema, frames, size)
    return replace(found, sigma_px=sigmas) if sigmas and sigmas.keys() == frames.keys() else found


def _rows(values: Any, schema: KeypointSchema, where: str) -> Float[np.ndarray, "j 3"]:
    """(u, v, confidence) rows, checked; unseen rows become zeros."""
    try:
        rows = np.asarray(values, dtype=np.float64).reshape(-1, 3)
    except (TypeError, ValueError, OverflowError):
        raise KroncError(f"{where}: keypoints are not numbers [u, v, confidence]") from None
    if len(rows) != len(schema):
        raise KroncError(f"{where}: {len(rows)} keypoints, expected {len(schema)} for schema {schema.name!r}")
    seen = ~(rows[:, 2] == 0)
    if not np.isfinite(rows[seen]).all():
        bad = schema.keypoints[int(np.flatnonzero(seen & ~np.isfinite(rows).all(1))[0])]
        raise KroncError(f"{where}: keypoint {bad!r} is not finite: use confidence 0 for a point that is not seen")
    if (rows[seen, 2] < 0).any():
        raise KroncError(f"{where}: a confidence is negative: expected 0 (not seen) to 1")
    return np.where(seen[:, None], rows, 0.0)


def _sigma(values: Any, schema: KeypointSchema, where: str) -> Float[np.ndarray, "j"]:
    try:
        sigma = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        sigma = np.zeros(0)
    if sigma.shape != (len(schema),) or not np.isfinite(sigma).all() or (sigma < 0).any():
        raise KroncError(f"{where}: sigma_px: expected {len(schema)} numbers of pixels, 0 for a point that is not seen")
    return sigma
