"""`--keypoint-names`, and what files say of their points themselves."""

import json

import pytest

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import read_keypoints
from kronc_ns.files.keypoints.schemas import schema_named
from kronc_ns.keypoints.schema import APOLLOCAR3D_24, APOLLOCAR3D_66

NAMES = ("nose", "left", "right", "tail", "roof")


def results(tmp_path, count: int):
    file = tmp_path / "results.json"
    keypoints = [float(i) for i in range(2, 2 + 3 * count)]
    file.write_text(json.dumps([{"image_id": "a.png", "keypoints": keypoints, "score": 1.0}]))
    return file


@pytest.mark.parametrize(
    ("given", "schema"),
    [
        ("apollocar3d-66", APOLLOCAR3D_66),
        ("apollocar3d-24", APOLLOCAR3D_24),
        ("openpifpaf-66", APOLLOCAR3D_66),
        ("openpifpaf-24", APOLLOCAR3D_24),
    ],
)
def test_schemas_known_by_name(given, schema):
    assert schema_named(given) is schema


def test_files_of_names(tmp_path):
    text, listed, ours = tmp_path / "toy.txt", tmp_path / "toy.json", tmp_path / "ours.json"
    text.write_text("\n".join(NAMES) + "\n\n")
    listed.write_text(json.dumps(NAMES))
    ours.write_text(json.dumps({"name": "toy", "keypoints": NAMES, "flip": [[1, 2]]}))
    assert schema_named(str(text)) == schema_named(str(listed))
    assert schema_named(str(text)).keypoints == schema_named(str(ours)).keypoints == NAMES
    assert schema_named(str(ours)).flip == (0, 2, 1, 3, 4)


def test_names_that_are_the_car_s_are_the_car(tmp_path):
    file = tmp_path / "car.txt"
    file.write_text("\n".join(APOLLOCAR3D_24.keypoints))
    assert schema_named(str(file)) is APOLLOCAR3D_24


def test_a_file_without_names_has_them_by_count_or_as_told(tmp_path):
    names = tmp_path / "toy.txt"
    names.write_text("\n".join(NAMES))
    assert read_keypoints(results(tmp_path, 66)).schema is APOLLOCAR3D_66
    assert read_keypoints(results(tmp_path, 24)).schema is APOLLOCAR3D_24
    assert read_keypoints(results(tmp_path, 5)).schema.keypoints == tuple(f"point_{j}" for j in range(5))
    assert read_keypoints(results(tmp_path, 5), str(names)).schema.keypoints == NAMES


@pytest.mark.parametrize("count", [4, 23, 25, 66])
def test_a_wrong_count_is_told(tmp_path, count):
    with pytest.raises(KroncError, match=rf"a\.png: {count} keypoints, expected 24 .*--keypoint-names") as caught:
        read_keypoints(results(tmp_path, count), "openpifpaf-24")
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a\nb\nc\n", "3 names: expected at least 4"),
        ("a\nb\nc\na\n", "all different"),
        (None, "expected apollocar3d-66"),
    ],
)
def test_names_that_cannot_be(tmp_path, text, message):
    file = tmp_path / "names.txt"
    if text is not None:
        file.write_text(text)
    with pytest.raises(KroncError, match=message) as caught:
        schema_named(str(file))
    assert f"--keypoint-names {file}" in str(caught.value)
