"""COCO keypoint annotations, and what CVAT makes of them: points without names, or a category for each point.

The format's pixels are counted from 0 at their centres (cocodataset.org, format of the data).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints.detections import Detections
from kronc_ns.files.keypoints.rows import flat_numbers, from_flags, from_pixel_indices, rows_of, stacked
from kronc_ns.files.keypoints.schemas import places_of, schema_of_labels, schema_of_names
from kronc_ns.keypoints.schema import KeypointSchema, schema_of_count


@dataclass(frozen=True)
class _Annotation:
    image: str
    category: Any
    """Its id."""
    keypoints: list[Any]


def read_coco(path: Path, content: dict[str, Any], names: KeypointSchema | None) -> Detections:
    """COCO keypoints: u, v, and 0 not labelled, 1 hidden, 2 seen, or a detector's score."""
    try:
        categories = {c["id"]: c for c in content.get("categories", [])}
        images = {image["id"]: str(image["file_name"]) for image in content["images"]}
        sizes = {
            str(image["file_name"]): (int(image["width"]), int(image["height"]))
            for image in content["images"]
            if {"width", "height"} <= image.keys()
        }
        annotations = [
            _Annotation(images[a["image_id"]], a.get("category_id"), a["keypoints"])
            for a in content["annotations"]
            if a.get("keypoints")
        ]
        used = _used(categories, annotations)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise KroncError(f"{path}: COCO field {error} is missing or of the wrong kind") from None
    if len(used) > 1 and all(len(flat_numbers(a.keypoints, f"{path}, {a.image}")) == 3 for a in annotations):
        schema, instances = _points_of_categories(path, used, annotations, names)
    else:
        schema = names or _schema(path, used, annotations)
        instances = [(a.image, rows_of(a.keypoints, schema, f"{path}, {a.image}")) for a in annotations]
    frames: dict[str, list[np.ndarray]] = {name: [] for name in images.values()}
    confident = from_flags(rows for _, rows in instances)
    for (image, _), rows in zip(instances, confident, strict=True):
        frames[image].append(from_pixel_indices(rows))
    return Detections(path, schema, {name: stacked(rows, schema) for name, rows in frames.items()}, sizes=sizes or None)


def _used(categories: Mapping[Any, dict], annotations: Sequence[_Annotation]) -> list[dict]:
    """The categories whose points are annotated, in the file's order; where that is not said, those that have points.

    Exporters list all their categories, and with some every one has (empty) keypoints.
    """
    ids = {annotation.category for annotation in annotations}
    used = [category for key, category in categories.items() if key in ids]
    return used or [category for category in categories.values() if category.get("keypoints")]


def _schema(path: Path, used: Sequence[dict], annotations: Sequence[_Annotation]) -> KeypointSchema:
    """That of the one category; where it names no points, or by numbers only, by their count."""
    if len(used) != 1:
        raise KroncError(
            f"{path}: {len(used)} categories have keypoints, expected one for the object, or one for each of its points"
        )
    (category,) = used
    labels = category.get("keypoints") or []
    if not isinstance(labels, list):
        raise KroncError(f"{path}: the keypoints of a category are {labels!r}: expected a list of names")
    count = len(labels) or (len(annotations[0].keypoints) // 3 if annotations else 0)
    if count < 4:
        raise KroncError(
            f"{path}: {count} keypoints: expected at least 4 points of one object in each annotation, or a category "
            "for each point"
        )
    name = str(category.get("name", "coco"))
    return schema_of_names(name, [str(label) for label in labels]) if labels else schema_of_count(count)


def _points_of_categories(
    path: Path, used: Sequence[dict], annotations: Sequence[_Annotation], names: KeypointSchema | None
) -> tuple[KeypointSchema, list[tuple[str, Float[np.ndarray, "j 3"]]]]:
    """One car per image, from annotations of a single point each, whose category is the point's name."""
    labels = {category["id"]: str(category.get("name", "")) for category in used}
    schema = names or schema_of_labels(list(labels.values()), str(path))
    places = places_of(list(labels.values()), schema, str(path))
    rows: dict[str, np.ndarray] = {}
    taken: set[tuple[str, str]] = set()
    for annotation in annotations:
        where = f"{path}, {annotation.image}"
        if annotation.category not in labels:
            raise KroncError(f"{where}: category {annotation.category!r} is none of the file's: expected their ids")
        label = labels[annotation.category]
        if (annotation.image, label) in taken:
            raise KroncError(
                f"{where}: two points are called {label!r}: expected one car per image, or a skeleton each"
            )
        taken.add((annotation.image, label))
        row = rows.setdefault(annotation.image, np.zeros((len(schema), 3)))
        row[places[label]] = flat_numbers(annotation.keypoints, where)
    return schema, list(rows.items())
