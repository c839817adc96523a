"""Label Studio 1.x: tasks exported as JSON or JSON-MIN, with `KeyPointLabels` in percent of the image's sides."""

import mimetypes
import re
from collections.abc import Iterable
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import parse_qs, unquote, urlparse

import numpy as np
from jaxtyping import Float

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints.detections import Detections
from kronc_ns.files.keypoints.rows import likely, number, stacked
from kronc_ns.files.keypoints.schemas import places_of, schema_of_labels
from kronc_ns.keypoints.schema import KeypointSchema

_UPLOADED = re.compile(r"^[0-9a-f]{8}-")  # put before the name of an uploaded file


def is_label_studio(content: Any) -> bool:
    """Whether this is a list of tasks with labelled keypoints, or none yet."""
    return isinstance(content, list) and any(
        isinstance(task, dict) and ({"data", "annotations"} <= task.keys() or any(_points(task.values())))
        for task in content
    )


def read_label_studio(path: Path, content: list[Any], names: KeypointSchema | None) -> Detections:
    """Points by the names of their labels; every annotation of a task is a car, unless its points have parent regions.

    Tasks without annotations have their predictions, of which those below half of the best score are left out.
    """
    tasks: dict[str, list[tuple[list[dict], float]]] = {}
    for i, task in enumerate(content):
        if not isinstance(task, dict):
            raise KroncError(f"{path}: task {i} is {str(task)[:40]!r}: expected an object as Label Studio exports it")
        image = _image(task, f"{path}, task {task.get('id', i)}")
        tasks.setdefault(image, []).extend(_cars(task))
    points = [point for cars in tasks.values() for car, _ in cars for point in car]
    labels = list(dict.fromkeys(str(label) for point in points for label in point["keypointlabels"]))
    if not labels:
        raise KroncError(f"{path}: no keypoint has a label: expected annotations with KeyPointLabels")
    schema = names or schema_of_labels(labels, str(path))
    places = places_of(labels, schema, str(path))
    frames = {}
    for image, cars in tasks.items():
        rows = [_rows(car, places, len(schema), f"{path}, {image}") for car, _ in cars]
        frames[image] = stacked(likely(rows, [score for _, score in cars]) if rows else [], schema)
    return Detections(path, schema, frames, relative=True)


def _cars(task: dict[str, Any]) -> Iterable[tuple[list[dict], float]]:
    """The points of each car in a task, and its score."""
    if "annotations" not in task:  # JSON-MIN
        yield from ((car, 1.0) for car in _by_parent(_points(task.values())))
        return
    done = [a for a in task["annotations"] or [] if isinstance(a, dict) and not a.get("was_cancelled")]
    for annotation in done or [p for p in task.get("predictions") or [] if isinstance(p, dict)]:
        score = 1.0 if done else number(annotation.get("score", 1.0))
        yield from ((car, score) for car in _by_parent(_points([annotation.get("result")])))


def _points(values: Iterable[Any]) -> Iterable[dict]:
    """The labelled keypoints in lists of regions, with the fields of their values."""
    for regions in values:
        for region in regions if isinstance(regions, list) else []:
            if isinstance(region, dict):
                value = region.get("value")
                point = {**region, **value} if isinstance(value, dict) else region
                if isinstance(point.get("keypointlabels"), list):
                    yield point


def _by_parent(points: Iterable[dict]) -> list[list[dict]]:
    cars: dict[Any, list[dict]] = {}
    for point in points:
        cars.setdefault(point.get("parentID"), []).append(point)
    return list(cars.values())


def _rows(car: list[dict], places: dict[str, int], count: int, where: str) -> Float[np.ndarray, "j 3"]:
    """(share of width, share of height, 1) of each point, percentages as they are exported."""
    rows = np.zeros((count, 3))
    for point in car:
        if number(point.get("image_rotation", 0)) != 0:
            raise KroncError(
                f"{where}: labelled on an image turned by {point['image_rotation']} degrees: expected labels on the "
                "image as it is"
            )
        for label in point["keypointlabels"]:
            place = places[str(label)]
            if rows[place, 2]:
                raise KroncError(
                    f"{where}: two points are called {label!r}: expected one car per image, or each car's points "
                    "inside a region of its own"
                )
            rows[place] = number(point.get("x")) / 100, number(point.get("y")) / 100, 1.0
    return rows


def _image(task: dict[str, Any], where: str) -> str:
    """Name of a task's image: uploads have eight letters before it, local files a path behind ``?d=``."""
    data = task["data"] if isinstance(task.get("data"), dict) else task
    for value in [data.get("image"), *data.values()]:
        if not isinstance(value, str):
            continue
        url = urlparse(value)
        path = PurePosixPath(parse_qs(url.query).get("d", [unquote(url.path)])[0])
        if (mimetypes.guess_type(path.name)[0] or "").startswith("image/"):
            return _UPLOADED.sub("", path.name) if "upload" in path.parts else path.name
    raise KroncError(f"{where}: no image: expected one in its data, by path or URL")
