"""Readers of keypoint files, and the writer of our own.

Three formats are read: our ``keypoints.json``, folders of OpenPifPaf ``*.predictions.json``, and COCO keypoint
JSON. All of them become `Detections` with pixels in our convention (centre of the top-left pixel at (0.5, 0.5)).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from kronc_ns.errors import KroncError
from kronc_ns.files.images import read_grey
from kronc_ns.files.output import read_json, write_json
from kronc_ns.geometry.camera import Camera
from kronc_ns.keypoints.schema import APOLLOCAR3D_66, KNOWN_SCHEMAS, KeypointSchema, schema_of_count
from kronc_ns.keypoints.selection import select_instances

FORMATS = "our keypoints.json, a folder of OpenPifPaf *.predictions.json, or COCO keypoint JSON"


@dataclass(frozen=True)
class Detections:
    """What a keypoint file holds, before anyone has chosen one car per image."""

    source: Path
    schema: KeypointSchema
    frames: Mapping[str, Float[np.ndarray, "_ j 3"]]
    """Image path or name as the file gives it -> its M instances of (u, v, confidence); confidence 0: not seen."""
    size: tuple[int, int] | None = None
    """(width, height) of the images, where the file says."""
    sigma_px: Mapping[str, Float[np.ndarray, "_ j"]] | None = None
    """Standard deviation of each place along one axis, beside `frames`, where the detector knew it; 0: not seen."""


def read_keypoints(path: Path) -> Detections:
    """Read a keypoint file or folder in any of the three formats."""
    found = _read(path)
    for name, instances in found.frames.items():
        if instances.size and (most := instances[..., 2].max()) > 1:
            raise KroncError(f"{found.source}, {name}: a confidence is {most:g}: expected 0 (not seen) to 1")
    return found


def _read(path: Path) -> Detections:
    if path.is_dir():
        own = path / "keypoints.json"
        return _read(own) if own.exists() else _read_openpifpaf(path)
    if not path.exists():
        raise KroncError(f"{path} does not exist: expected {FORMATS}")
    content = read_json(path)
    if isinstance(content, dict) and {"annotations", "images"} <= content.keys():
        return _read_coco(path, content)
    if isinstance(content, dict) and "frames" in content:
        return _read_own(path, content)
    if path.name.endswith(".predictions.json"):
        return _read_openpifpaf(path.parent)
    raise KroncError(f"{path} is no keypoint file that can be read: expected {FORMATS}")


def match_keypoints(
    found: Detections, names: tuple[str, ...], camera: Camera, masks: list[Path] | None = None
) -> tuple[Float[np.ndarray, "n j 3"], str]:
    """Rows for each view from a keypoint file, matched by path or else by file name; and a note on choices made."""
    if found.size is not None and found.size != (camera.width, camera.height):
        raise KroncError(
            f"{found.source} is for {found.size[0]}x{found.size[1]} images, the camera says "
            f"{camera.width}x{camera.height}: expected keypoints in the pixels of the images"
        )
    by_name: dict[str, str] = {}
    for name in names:
        by_name[PurePosixPath(name).name] = "" if PurePosixPath(name).name in by_name else name
    matched: dict[str, np.ndarray] = {}
    unknown = []
    for key, instances in found.frames.items():
        name = key if key in names else by_name.get(PurePosixPath(key).name, "")
        if name:
            matched[name] = instances
        else:
            unknown.append(key)
    if unknown:
        raise KroncError(
            f"{found.source} has keypoints for {len(unknown)} images that do not exist ({unknown[0]}): "
            f"expected names like {names[0]}"
        )
    empty = np.zeros((0, len(found.schema), 3))
    instances = [matched.get(name, empty) for name in names]
    if not any((rows[..., 2] > 0).any() for rows in instances):
        raise KroncError(
            f"{found.source}: no keypoints for any of the {len(names)} images: expected at least 4 in 3 views"
        )
    several = [i for i, rows in enumerate(instances) if len(rows) > 1]
    read = [read_grey(path) if i in several else None for i, path in enumerate(masks)] if masks and several else None
    rows, note = select_instances(instances, (camera.width, camera.height), read)
    return rows, note if several else ""


def sigma_of(
    found: Detections, names: tuple[str, ...], rows: Float[np.ndarray, "n j 3"]
) -> Float[np.ndarray, "n j"] | None:
    """Standard deviations in pixels of the ``rows`` that `match_keypoints` chose for these names; None if unknown."""
    if found.sigma_px is None:
        return None
    by_file = {PurePosixPath(key).name: key for key in found.frames}
    sigma = np.zeros(rows.shape[:2])
    for i, name in enumerate(names):
        key = name if name in found.frames else by_file.get(PurePosixPath(name).name)
        for instance, its_own in zip(found.frames[key], found.sigma_px[key], strict=True) if key else ():
            if np.array_equal(instance, rows[i]):
                sigma[i] = its_own
    return sigma


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


def _rows(values: Any, schema: KeypointSchema, where: str) -> Float[np.ndarray, "j 3"]:
    """(u, v, confidence) rows, checked; unseen rows become zeros."""
    try:
        rows = np.asarray(values, dtype=np.float64).reshape(-1, 3)
    except (TypeError, ValueError):
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


def describe_schema(schema: KeypointSchema) -> Any:
    """A schema as JSON holds it: its name where that is known, else spelt out."""
    if KNOWN_SCHEMAS.get(schema.name) == schema:
        return schema.name
    flip = [[i, f] for i, f in enumerate(schema.flip) if i < f]
    return {"name": schema.name, "keypoints": list(schema.keypoints), "flip": flip}


def read_schema(described: Any, path: Path) -> KeypointSchema:
    """The inverse of `describe_schema`, checked; ``path`` is the file that holds it."""
    if isinstance(described, str) and described in KNOWN_SCHEMAS:
        return KNOWN_SCHEMAS[described]
    if not isinstance(described, dict) or not {"name", "keypoints"} <= described.keys():
        known = ", ".join(map(repr, KNOWN_SCHEMAS))
        raise KroncError(
            f"{path}: schema {described!r} is unknown: expected {known} or "
            '{"name": ..., "keypoints": [...], "flip": [[i, j], ...]}'
        )
    if not isinstance(described["keypoints"], list):
        raise KroncError(f"{path}: schema keypoints {described['keypoints']!r}: expected a list of names")
    flip = list(range(len(described["keypoints"])))
    try:
        for i, j in described.get("flip", []):
            flip[i], flip[j] = j, i
    except (TypeError, ValueError, IndexError):
        raise KroncError(f"{path}: schema flip must be pairs [i, j] of keypoint indices") from None
    return KeypointSchema(str(described["name"]), tuple(map(str, described["keypoints"])), tuple(flip))


def _read_own(path: Path, content: dict[str, Any]) -> Detections:
    schema = read_schema(content.get("schema"), path)
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
    return Detections(path, schema, frames, size, sigmas if sigmas and sigmas.keys() == frames.keys() else None)


def _sigma(values: Any, schema: KeypointSchema, where: str) -> Float[np.ndarray, "j"]:
    try:
        sigma = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        sigma = np.zeros(0)
    if sigma.shape != (len(schema),) or not np.isfinite(sigma).all() or (sigma < 0).any():
        raise KroncError(f"{where}: sigma_px: expected {len(schema)} numbers of pixels, 0 for a point that is not seen")
    return sigma


def _read_openpifpaf(folder: Path) -> Detections:
    """Folder of IMAGENAME.predictions.json, each a list of instances; integers are pixel centres there."""
    suffix = ".predictions.json"
    files = sorted(folder.glob(f"*{suffix}"))
    if not files:
        raise KroncError(f"{folder} holds no keypoint file: expected {FORMATS}")
    contents = {file: read_predictions(file) for file in files}
    counts = (len(instance["keypoints"]) // 3 for instances in contents.values() for instance in instances)
    schema = schema_of_count(next(counts, 66))
    frames = {
        file.name.removesuffix(suffix): openpifpaf_rows(instances, schema, file) for file, instances in contents.items()
    }
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
    """(u, v, confidence) of each instance, in our pixels."""
    return _shift_half_pixel([_rows(instance["keypoints"], schema, str(file)) for instance in instances], len(schema))


def _read_coco(path: Path, content: dict[str, Any]) -> Detections:
    """COCO keypoints; pixel centres are integers there. v: 0 not labelled, 1 hidden, 2 seen, or a detector's score."""
    try:
        schemas = {c["id"]: c for c in content.get("categories", []) if "keypoints" in c}
        if len(schemas) != 1:
            raise KroncError(f"{path}: {len(schemas)} categories have keypoints, expected one")
        (category,) = schemas.values()
        names = tuple(map(str, category["keypoints"]))
        if len(names) == len(APOLLOCAR3D_66):
            schema = APOLLOCAR3D_66
        else:
            schema = KeypointSchema(str(category.get("name", "coco")), names, tuple(range(len(names))))
        images = {image["id"]: image for image in content["images"]}
        instances: dict[str, list[np.ndarray]] = {str(image["file_name"]): [] for image in images.values()}
        rows = [
            (str(images[a["image_id"]]["file_name"]), a["keypoints"])
            for a in content["annotations"]
            if "keypoints" in a
        ]
        sizes = {(int(i["width"]), int(i["height"])) for i in images.values() if {"width", "height"} <= i.keys()}
    except (KeyError, TypeError) as error:
        raise KroncError(f"{path}: COCO field {error} is missing or of the wrong kind") from None
    checked = [_rows(values, schema, f"{path}, {name}") for name, values in rows]
    labels = np.concatenate([uvc[:, 2] for uvc in checked] or [np.zeros(0)])
    full_score = 2.0 if labels.size and np.isin(labels, (0.0, 1.0, 2.0)).all() and (labels == 2.0).any() else 1.0
    for (name, _), uvc in zip(rows, checked, strict=True):
        uvc[:, 2] /= full_score
        instances[name].append(uvc)
    if len(sizes) > 1:
        raise KroncError(f"{path}: images of {len(sizes)} sizes ({_some(sizes)}): expected one camera and one size")
    frames = {name: _shift_half_pixel(found, len(schema)) for name, found in instances.items()}
    return Detections(path, schema, frames, sizes.pop() if sizes else None)


def _shift_half_pixel(instances: list[Float[np.ndarray, "j 3"]], count: int) -> Float[np.ndarray, "m j 3"]:
    stacked = np.stack(instances) if instances else np.zeros((0, count, 3))
    return stacked + np.where(stacked[..., 2:] > 0, [0.5, 0.5, 0.0], 0.0)


def _some(values: Any, limit: int = 3) -> str:
    listed = sorted(map(str, values))
    return ", ".join(listed[:limit]) + (", ..." if len(listed) > limit else "")
