"""MMPose 1.x: the folder ``predictions/`` of its inferencer, with IMAGESTEM.json, each a list of instances.

Pixels are counted from 0 at their centres: its mirror image of u is width - 1 - u.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints.detections import Detections
from kronc_ns.files.keypoints.rows import flat_numbers, from_pixel_indices, from_scores, likely, number, stacked
from kronc_ns.files.output import read_json
from kronc_ns.keypoints.schema import KeypointSchema, schema_of_count


def is_mmpose(content: Any) -> bool:
    """Whether this is an image's list of instances, perhaps an empty one."""
    return isinstance(content, list) and all(isinstance(c, dict) and "keypoint_scores" in c for c in content)


def is_mmpose_video(content: Any) -> bool:
    """Whether these are all frames of a video."""
    return isinstance(content, list) and any(
        isinstance(c, dict) and {"frame_id", "instances"} <= c.keys() for c in content
    )


def read_mmpose(folder: Path, names: KeypointSchema | None) -> Detections:
    """All images of a folder; of several instances, those with less than half of the best box's score are left out."""
    contents = {file: content for file in sorted(folder.glob("*.json")) if is_mmpose(content := read_json(file))}
    counts = (len(c["keypoints"]) for content in contents.values() for c in content if isinstance(c["keypoints"], list))
    schema = names or schema_of_count(next(counts, 66))
    frames = {}
    for file, content in contents.items():
        rows = [_rows(instance, schema, str(file)) for instance in content]
        scores = [number(instance.get("bbox_score", 1.0)) for instance in content]
        frames[file.stem] = from_pixel_indices(stacked(likely(rows, scores) if rows else [], schema))
    return Detections(folder, schema, frames, called="stem")


def _rows(instance: dict[str, Any], schema: KeypointSchema, where: str) -> Float[np.ndarray, "j 3"]:
    places = flat_numbers(instance.get("keypoints"), where)
    scores = flat_numbers(instance["keypoint_scores"], where)
    if len(places) != 2 * len(schema) or len(scores) != len(schema):
        raise KroncError(
            f"{where}: {len(places) / 2:g} keypoints with {len(scores)} scores, expected {len(schema)} [u, v] for "
            f"schema {schema.name!r} (--keypoint-names says another)"
        )
    return from_scores(np.concatenate([places.reshape(-1, 2), scores[:, None]], axis=1))
