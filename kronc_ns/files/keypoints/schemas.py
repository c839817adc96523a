"""Which points a file means: schemas as JSON, by name, by count, and by the labels that annotators gave."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kronc_ns.errors import KroncError
from kronc_ns.files.output import read_json
from kronc_ns.keypoints.schema import APOLLOCAR3D_24, APOLLOCAR3D_66, KNOWN_SCHEMAS, KeypointSchema, schema_of_count

_NAMED = {**KNOWN_SCHEMAS, "openpifpaf-66": APOLLOCAR3D_66, "openpifpaf-24": APOLLOCAR3D_24}


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


def schema_named(given: str) -> KeypointSchema:
    """What ``--keypoint-names`` says: a known schema, or a file with a name a line, a JSON list, or our JSON schema."""
    if given in _NAMED:
        return _NAMED[given]
    file = Path(given)
    if not file.is_file():
        raise KroncError(
            f"--keypoint-names {given}: expected {', '.join(_NAMED)}, or a file with a keypoint's name on each line"
        )
    if file.suffix.lower() == ".json":
        described = read_json(file)
        if not isinstance(described, list):
            return read_schema(described, file)
        names = [str(name) for name in described]
    else:
        try:
            lines = file.read_text(encoding="utf-8-sig").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise KroncError(f"--keypoint-names {file} cannot be read ({error}): expected a text file") from None
        names = [line.strip() for line in lines if line.strip()]
    if len(set(names)) < max(len(names), 4):
        raise KroncError(f"--keypoint-names {file} has {len(names)} names: expected at least 4, all different")
    return schema_of_names(file.stem, names)


def schema_of_names(name: str, names: Sequence[str], flip: Sequence[int] | None = None) -> KeypointSchema:
    """The schema of points that a file names in order; without names, or with mere numbers for them, it is by count."""
    if not names or all(label.isdigit() for label in names):
        return schema_of_count(len(names))
    for known in KNOWN_SCHEMAS.values():
        if tuple(names) == known.keypoints:
            return known
    if len(names) == len(APOLLOCAR3D_66):  # spelt differently by every tool, in one order by all
        return APOLLOCAR3D_66
    return KeypointSchema(name, tuple(names), tuple(range(len(names)) if flip is None else flip))


def schema_of_labels(labels: Sequence[str], where: str) -> KeypointSchema:
    """The schema of points that are labelled one by one, some perhaps nowhere."""
    if set(labels) <= set(APOLLOCAR3D_66.keypoints):
        return APOLLOCAR3D_66
    known = any(len(schema) == len(labels) for schema in KNOWN_SCHEMAS.values())
    if len(labels) < 4 or (not known and all(label.isdigit() for label in labels)):
        raise KroncError(
            f"{where}: the points are called {', '.join(labels[:3])}{', ...' if len(labels) > 3 else ''}: expected "
            "the names of at least 4, or --keypoint-names to say what the numbers are"
        )
    return schema_of_names("labels", labels)


def places_of(labels: Sequence[str], schema: KeypointSchema, where: str) -> dict[str, int]:
    """Index in the schema of each label: its name there, or its number, counted from 0 if that is used, else from 1."""
    if all(label.isdigit() for label in labels):
        first = 0 if any(int(label) == 0 for label in labels) else 1
        places = {label: int(label) - first for label in labels}
    else:
        places = {label: schema.keypoints.index(label) for label in labels if label in schema.keypoints}
    wrong = [label for label in labels if not 0 <= places.get(label, -1) < len(schema)]
    if wrong:
        raise KroncError(
            f"{where}: the point {wrong[0]!r} is none of the {len(schema)} of {schema.name!r}: expected names like "
            f"{schema.keypoints[0]!r}, or --keypoint-names with a file that lists those used"
        )
    return places
