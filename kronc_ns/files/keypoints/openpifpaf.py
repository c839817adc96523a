"""OpenPifPaf 0.13: a folder of IMAGENAME.predictions.json, each a list of instances."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints.detections import Detections
from kronc_ns.files.keypoints.rows import from_pixel_indices, rows_of, stacked, usable
from kronc_ns.files.output import read_json
from kronc_ns.keypoints.schema import KeypointSchema, schema_of_count

SUFFIX = ".predictions.json"


def read_openpifpaf(folder: Path, names: KeypointSchema | None) -> Detections:
    """All prediction files of a folder; the points are known by their number unless ``names`` are given."""
    contents = {file: read_predictions(file) for file in sorted(folder.glob(f"*{SUFFIX}"))}
    counts = (len(instance["keypoints"]) // 3 for instances in contents.values() for instance in instances)
    schema = names or schema_of_count(next(counts, 66))
    frames = {file.name.removesuffix(SUFFIX): _rows(found, schema, file) for file, found in contents.items()}
    return Detections(folder, schema, frames)


def read_predictions(file: Path) -> list[dict[str, Any]]:
    """The instances in one of OpenPifPaf's prediction files: each has "keypoints", three numbers a point."""
    content = read_json(file)
    if not isinstance(content, list) or not all(
        isinstance(c, dict) and isinstance(c.get("keypoints"), list) for c in content
    ):
        raise KroncError(f'{file}: expected a list of instances, each with "keypoints"')
    return content


def openpifpaf_rows(instances: list[dict[str, Any]], schema: KeypointSchema, file: Path) -> Float[np.ndarray, "m j 3"]:
    """(u, v, confidence) of each instance, in our pixels; zeros for a point that was not found."""
    return usable(_rows(instances, schema, file))


def _rows(instances: list[dict[str, Any]], schema: KeypointSchema, file: Path) -> Float[np.ndarray, "m j 3"]:
    rows = [rows_of(instance["keypoints"], schema, str(file)) for instance in instances]
    return from_pixel_indices(stacked(rows, schema))
