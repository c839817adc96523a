"""COCO results and CVAT's annotations, in small files after the tools' documentation (COCO's format page, CVAT 2.9)."""

import json

import numpy as np
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import match_keypoints, read_keypoints
from kronc_ns.geometry.camera import Camera

CAMERA = Camera(50.0, 50.0, 20.0, 15.0, 40, 30)
SQUARE = [1.0, 2.0, 0.9, 3.0, 2.0, 0.8, 3.0, 4.0, 0.7, 1.0, 4.0, 0.6]


def result(image, keypoints=SQUARE, score=0.9) -> dict:
    return {"image_id": image, "category_id": 1, "keypoints": keypoints, "score": score}


def read(tmp_path, content, name="results.json"):
    (tmp_path / name).write_text(json.dumps(content))
    return read_keypoints(tmp_path / name)


def square(keypoints: list[float]) -> np.ndarray:
    return np.reshape(keypoints, (4, 3)) + np.array([0.5, 0.5, 0])


def test_numbers_are_those_at_the_end_of_names(tmp_path):
    found = read(tmp_path, [result(12), result(397133, [2 * c for c in SQUARE[:1]] + SQUARE[1:])])
    rows, note = match_keypoints(found, ("images/000000397133.jpg", "images/IMG_0012.jpg"), CAMERA)
    np.testing.assert_allclose(rows[1], square(SQUARE))
    assert rows[0, 0, 0] == 2.5
    assert note == ""


def test_numbers_that_images_share_or_lack_are_told(tmp_path):
    found = read(tmp_path, [result(7)])
    for names in (("a_7.jpg", "b_7.jpg"), ("a_8.jpg",), ("a.jpg",)):
        with pytest.raises(
            KroncError, match=r"1 images that do not exist \(7\): expected the number at the end .* ids"
        ):
            match_keypoints(found, names, CAMERA)


def test_annotations_beside_tell_what_numbers_mean(tmp_path):
    (tmp_path / "broken.json").write_text("{")
    images = [{"id": 7, "file_name": "a_8.jpg"}, {"id": 8, "file_name": "b_7.jpg"}]
    (tmp_path / "val.json").write_text(json.dumps({"images": images, "annotations": []}))
    rows, _ = match_keypoints(read(tmp_path, [result(7)]), ("images/a_8.jpg", "images/b_7.jpg"), CAMERA)
    assert (rows[0, :, 2] > 0).all()
    assert (rows[1] == 0).all()


def test_a_detector_s_second_thoughts_are_left_out(tmp_path):
    big = [10 * c if i % 3 < 2 else c for i, c in enumerate(SQUARE)]
    found = read(tmp_path, [result("a.png"), result("a.png", big, score=0.44), result("b.png", big, score=0.2)])
    assert {name: len(rows) for name, rows in found.frames.items()} == {"a.png": 1, "b.png": 1}
    found = read(tmp_path, [result("a.png"), result("a.png", big, score=0.5)])
    rows, note = match_keypoints(found, ("a.png",), CAMERA)
    np.testing.assert_allclose(rows[0], square(big))  # of two likely ones the larger
    assert note.startswith("1 images show several cars")


def test_peaks_beyond_0_and_1_are_cut(tmp_path):
    peaks = [1.0, 2.0, 1.03, 3.0, 2.0, -0.01, 3.0, 4.0, 0.7, 1.0, 4.0, 5.5]
    assert read(tmp_path, [result("a.png", peaks)]).frames["a.png"][0, :, 2].tolist() == [1.0, 0.0, 0.7, 1.0]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([result("a.png"), {"image_id": 1}], 'expected "image_id" and "keypoints" in every result'),
        ([result("a.png"), result("b.png", [*SQUARE, 1.0, 1.0, 1.0])], r"b\.png: 5 keypoints, expected 4"),
        ([result("a.png", SQUARE[:9])], r"a\.png: 3 keypoints: expected at least 4"),
        ([result("a.png", "none")], "expected a list of numbers"),
    ],
)
def test_results_that_are_none(tmp_path, content, message):
    with pytest.raises(KroncError, match=message) as caught:
        read(tmp_path, content)
    assert str(tmp_path / "results.json") in str(caught.value)


# ---- CVAT


def cvat(categories, annotations) -> dict:
    """COCO Keypoints 1.0, as CVAT exports it."""
    return {
        "licenses": [{"name": "", "id": 0, "url": ""}],
        "info": {"contributor": "", "date_created": "", "description": "", "url": "", "version": "", "year": ""},
        "categories": [
            {"id": i, "name": name, "supercategory": "", "keypoints": [], "skeleton": []}
            for i, name in enumerate(categories, start=1)
        ],
        "images": [{"id": 1, "width": 40, "height": 30, "file_name": "a.png"}],
        "annotations": [
            {
                "id": i,
                "image_id": 1,
                "category_id": category,
                "keypoints": keypoints,
                "iscrowd": 0,
                "bbox": [0, 0, 0, 0],
            }
            for i, (category, keypoints) in enumerate(annotations, start=1)
        ],
    }


POINTS = [(2, [3.0, 4.0, 2]), (1, [1.0, 2.0, 2]), (4, [9.0, 9.0, 1]), (3, [5.0, 6.0, 2])]


def test_a_category_for_each_point(tmp_path):
    found = read(tmp_path, cvat(["nose", "tail", "roof", "door", "never used"], POINTS))
    assert found.schema.keypoints == ("nose", "tail", "roof", "door")
    np.testing.assert_allclose(found.frames["a.png"], [[[1.5, 2.5, 1], [3.5, 4.5, 1], [5.5, 6.5, 1], [9.5, 9.5, 0.5]]])
    assert found.sizes == {"a.png": (40, 30)}


def test_labels_that_no_annotation_uses_do_not_matter(tmp_path):
    found = read(tmp_path, cvat(["car", "person"], [(1, [1.0, 2.0, 2] * 5)]))
    assert found.frames["a.png"].shape == (1, 5, 3)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (cvat(["nose", "tail", "roof", "door"], [*POINTS, POINTS[0]]), r"a\.png: two points are called 'tail'"),
        (cvat(["nose", "tail", "roof", "door"], [*POINTS, (9, [1.0, 1.0, 2])]), "category 9 is none of the file's"),
        (cvat(["1", "2", "3", "4"], POINTS), "--keypoint-names to say what the numbers are"),
        (cvat(["nose", "tail"], POINTS[:2]), "expected the names of at least 4"),
        (
            cvat(["car", "person"], [(1, [1, 2, 2] * 4), (2, [1, 2, 2] * 5)]),
            "2 categories have keypoints, expected one",
        ),
        (cvat(["car"], [(1, [1, 2, 2])]), "1 keypoints: expected at least 4 points of one object"),
        (cvat(["car"], []), "0 categories have keypoints"),
    ],
)
def test_annotations_that_are_unclear(tmp_path, content, message):
    with pytest.raises(KroncError, match=message) as caught:
        read(tmp_path, content)
    assert str(tmp_path / "results.json") in str(caught.value)


def test_numbered_points_with_names_for_them(tmp_path):
    names = tmp_path / "names.txt"
    names.write_text("a\nb\nc\nd\n")
    (tmp_path / "cvat.json").write_text(json.dumps(cvat(["1", "2", "3", "4"], POINTS)))
    found = read_keypoints(tmp_path / "cvat.json", str(names))
    assert found.schema.keypoints == ("a", "b", "c", "d")
    assert found.frames["a.png"][0, 1].tolist() == [3.5, 4.5, 1.0]
    (tmp_path / "cvat.json").write_text(json.dumps(cvat(["nose", "b", "c", "d"], POINTS)))
    with pytest.raises(KroncError, match="the point 'nose' is none of the 4 of 'names'"):
        read_keypoints(tmp_path / "cvat.json", str(names))


def test_images_of_several_sizes(tmp_path):
    content = cvat(["car"], [(1, [1.0, 2.0, 2] * 5)])
    content["images"].append({"id": 2, "file_name": "b.png", "width": 80, "height": 60})
    content["annotations"].append(content["annotations"][0] | {"id": 9, "image_id": 2})
    found = read(tmp_path, content)
    rows, _ = match_keypoints(found, ("images/b.png", "images/a.png"), CAMERA, sizes=[(80, 60), (40, 30)])
    np.testing.assert_allclose(rows[:, :, :2], np.broadcast_to([1.5, 2.5], (2, 5, 2)))
    partly = read(tmp_path, cvat(["car"], [(1, [1.0, 2.0, 2] * 5)]))
    match_keypoints(partly, ("b.png", "a.png"), CAMERA, sizes=[(80, 60), (40, 30)])  # of the other it says nothing
    with pytest.raises(KroncError, match=r"b\.png is 80x60, images/b\.png 40x30"):
        match_keypoints(found, ("images/b.png", "images/a.png"), CAMERA, sizes=[(40, 30), (40, 30)])
