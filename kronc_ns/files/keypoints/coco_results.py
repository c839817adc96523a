"""COCO *results*: one list of detections in all images (MMPose, Detectron2, AlphaPose, Ultralytics' validation).

Pixels are counted from 0 at their centres, as in COCO's annotations: Detectron2 subtracts half a pixel to get there.
"""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints.detections import Called, Detections
from kronc_ns.files.keypoints.rows import (
    flat_numbers,
    from_flags,
    from_pixel_indices,
    from_scores,
    likely,
    number,
    rows_of,
    stacked,
)
from kronc_ns.files.output import read_json
from kronc_ns.keypoints.schema import KeypointSchema, schema_of_count


def read_coco_results(path: Path, content: list[Any], names: KeypointSchema | None) -> Detections:
    """``[{"image_id": number or name, "keypoints": [u, v, score, ...], "score": ...}, ...]``.

    Numbers are looked up in COCO annotations beside the file, else they are those at the end of the images' names.
    Of several detections in an image, those with less than half of the best score are left out.
    """
    for entry in content:
        if not isinstance(entry, dict) or not {"image_id", "keypoints"} <= entry.keys():
            raise KroncError(f'{path}: {str(entry)[:60]}: expected "image_id" and "keypoints" in every result')
    called, images = _images(path, [entry["image_id"] for entry in content])
    first = len(flat_numbers(content[0]["keypoints"], str(path))) // 3 if content else 66
    if first < 4:
        raise KroncError(f"{path}, {images[0]}: {first} keypoints: expected at least 4 points of one object")
    schema = names or schema_of_count(first)
    where = [f"{path}, {image}" for image in images]
    rows = from_flags(rows_of(entry["keypoints"], schema, at) for entry, at in zip(content, where, strict=True))
    found: dict[str, list[tuple[np.ndarray, float]]] = {}
    for image, entry, uvc in zip(images, content, rows, strict=True):
        found.setdefault(image, []).append((from_pixel_indices(from_scores(uvc)), number(entry.get("score", 1.0))))
    frames = {image: stacked(likely(*zip(*detections, strict=True)), schema) for image, detections in found.items()}
    return Detections(path, schema, frames, called=called)


def _images(path: Path, ids: list[Any]) -> tuple[Called, list[str]]:
    """What the images of these ids are called, and how."""
    texts = [str(i) for i in ids]
    if all(text.isdigit() for text in texts):
        files = _files_beside(path, set(texts))
        return ("file", [files[text] for text in texts]) if files else ("number", [str(int(text)) for text in texts])
    bare = not any(Path(text).suffix for text in texts)
    return ("stem" if bare else "file"), texts


def _files_beside(path: Path, ids: set[str]) -> dict[str, str]:
    """File name of each id, from the COCO annotations in the same folder that have all of them."""
    for file in sorted(path.parent.glob("*.json")):
        with suppress(KroncError, KeyError, TypeError):  # other JSON, which is not asked for
            content = read_json(file)
            files = {str(image["id"]): str(image["file_name"]) for image in content["images"]}
            if ids <= files.keys():
                return files
    return {}
