"""Label Studio's JSON, in small files after its documentation (KeyPointLabels and export, 1.x)."""

import json

import numpy as np
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import match_keypoints, read_keypoints
from kronc_ns.geometry.camera import Camera

CAMERA = Camera(50.0, 50.0, 20.0, 15.0, 40, 30)
PLACES = {"nose": (25.0, 50.0), "tail": (75.0, 50.0), "roof": (50.0, 10.0), "door": (50.0, 90.0)}


def region(label: str, x: float, y: float, **more) -> dict:
    return {
        "original_width": 40,
        "original_height": 30,
        "image_rotation": 0,
        "value": {"x": x, "y": y, "width": 0.5, "keypointlabels": [label]},
        "id": f"{label}-{x}",
        "from_name": "kp-1",
        "to_name": "img-1",
        "type": "keypointlabels",
        "origin": "manual",
        **more,
    }


def task(result, image="/data/upload/3/0a1b2c3d-a%20car.png", **more) -> dict:
    annotations = [{"id": 1, "result": result, "was_cancelled": False, "ground_truth": False}]
    return {"id": 5, "data": {"image": image}, "annotations": annotations, "predictions": [], **more}


CAR = [region(label, *place) for label, place in PLACES.items()]


def read(tmp_path, content, names: str | None = None):
    (tmp_path / "export.json").write_text(json.dumps(content))
    return read_keypoints(tmp_path / "export.json", names)


def test_percentages_become_pixels(tmp_path):
    box = {"type": "rectanglelabels", "value": {"x": 1, "y": 1, "width": 5, "height": 5, "rectanglelabels": ["car"]}}
    found = read(tmp_path, [task([box, *CAR])])
    assert found.schema.keypoints == tuple(PLACES)
    rows, _ = match_keypoints(found, ("images/a car.png",), CAMERA)
    np.testing.assert_allclose(rows[0], [[10, 15, 1], [30, 15, 1], [20, 3, 1], [20, 27, 1]])


@pytest.mark.parametrize(
    "image",
    [
        "/data/local-files/?d=walk/a%20car.png",
        "s3://bucket/walk/a car.png",
        "https://example.com/walk/a%20car.png?token=1",
        "a car.png",
    ],
)
def test_images_wherever_they_are_stored(tmp_path, image):
    assert list(read(tmp_path, [task(CAR, image)]).frames) == ["a car.png"]


def test_a_name_that_looks_like_an_upload_is_kept(tmp_path):
    assert list(read(tmp_path, [task(CAR, "s3://bucket/0a1b2c3d-a.png")]).frames) == ["0a1b2c3d-a.png"]


def test_cars_inside_their_regions_and_skipped_tasks(tmp_path):
    near = [region(label, *place, parentID="box-1") for label, place in PLACES.items()]
    far = [region(label, x / 5, y / 5, parentID="box-2") for label, (x, y) in PLACES.items()]
    skipped = task(CAR[:1], "b.png")
    skipped["annotations"][0]["was_cancelled"] = True
    frames = read(tmp_path, [task(near + far), skipped]).frames
    assert {name: len(cars) for name, cars in frames.items()} == {"a car.png": 2, "b.png": 0}


def test_predictions_where_nobody_has_annotated(tmp_path):
    guessed = [{"result": CAR, "score": 0.9}, {"result": CAR, "score": 0.2}]
    frames = read(
        tmp_path, [task([], annotations=[], predictions=guessed), task(CAR, "b.png", predictions=guessed)]
    ).frames
    assert {name: len(cars) for name, cars in frames.items()} == {"a car.png": 1, "b.png": 1}


def test_names_order_the_points(tmp_path):
    names = tmp_path / "names.txt"
    names.write_text("hood\ndoor\nroof\ntail\nnose\n")
    found = read(tmp_path, [task(CAR)], str(names))
    assert found.frames["a car.png"][0, :, 0].tolist() == [0, 0.5, 0.5, 0.75, 0.25]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([task([*CAR, CAR[0]])], "two points are called 'nose': expected one car per image"),
        ([task(CAR[:2])], "the points are called nose, tail: expected the names of at least 4"),
        ([task([])], "no keypoint has a label"),
        ([task(CAR, "walk.mp4")], "task 5: no image"),
        ([task([region("nose", 1, 1, image_rotation=90), *CAR[1:]])], "turned by 90 degrees"),
        ([task(CAR), 3], "task 1 is '3'"),
    ],
)
def test_exports_that_are_unclear(tmp_path, content, message):
    with pytest.raises(KroncError, match=message) as caught:
        read(tmp_path, content)
    assert str(tmp_path / "export.json") in str(caught.value)


def test_a_label_that_is_not_among_the_names(tmp_path):
    with pytest.raises(KroncError, match="the point 'nose' is none of the 66 of 'apollocar3d-66'"):
        read(tmp_path, [task(CAR)], "apollocar3d-66")
