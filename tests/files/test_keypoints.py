"""Keypoint files of three formats become rows of the views they belong to."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import Detections, match_keypoints, read_keypoints, sigma_of, write_keypoints
from kronc_ns.geometry.camera import Camera
from kronc_ns.keypoints.schema import APOLLOCAR3D_24, APOLLOCAR3D_66, KeypointSchema


def rows(seed: int, n: int = 66) -> np.ndarray:
    rng = np.random.default_rng(seed)
    uvc = np.concatenate([rng.uniform(0, 400, (n, 2)).round(2), rng.uniform(0.1, 1, (n, 1)).round(3)], axis=1)
    uvc[rng.uniform(size=n) < 0.4] = 0
    return uvc


def test_own_format_round_trip(tmp_path):
    frames = {"images/a.png": rows(0), "images/b.png": rows(1)}
    write_keypoints(tmp_path / "keypoints.json", APOLLOCAR3D_66, (480, 270), frames)
    read = read_keypoints(tmp_path / "keypoints.json")
    assert read.schema is APOLLOCAR3D_66
    assert read.size == (480, 270)
    for name, expected in frames.items():
        np.testing.assert_allclose(read.frames[name][0], expected)


def test_standard_deviations_round_trip(tmp_path, edit):
    rng, file = np.random.default_rng(1), tmp_path / "keypoints.json"
    rows = np.concatenate([rng.uniform(1, 200, (2, 66, 2)), rng.uniform(0.1, 1, (2, 66, 1))], axis=2)
    sigma = rng.uniform(0, 5, (2, 66))
    names = ("images/a.png", "images/b.png")
    write_keypoints(file, APOLLOCAR3D_66, None, dict(zip(names, rows, strict=True)), sigma)
    found = read_keypoints(tmp_path)
    assert found.size is None
    matched, _ = match_keypoints(found, ("new/b.png", "new/a.png"), Camera(400.0, 400.0, 240.0, 135.0, 480, 270))
    again = sigma_of(found, ("new/b.png", "new/a.png"), matched)
    assert again is not None
    assert np.abs(again - sigma[::-1]).max() <= 0.0005001
    edit(file, lambda content: content["frames"][0].pop("sigma_px"))
    assert read_keypoints(file).sigma_px is None  # known of all or none
    for wrong in ([1.0], [-1.0] * 66, ["a"] * 66, [float("nan")] * 66):
        edit(file, lambda content, wrong=wrong: content["frames"][1].update(sigma_px=wrong))
        with pytest.raises(KroncError, match=r"images/b\.png: sigma_px: expected 66 numbers"):
            read_keypoints(file)


def test_standard_deviations_follow_the_car_that_was_chosen():
    cars = np.zeros((2, 66, 3))
    cars[0, :5] = [[10, 10, 0.9], [12, 10, 0.9], [12, 12, 0.9], [10, 12, 0.9], [11, 11, 0.9]]
    cars[1, :5] = [[100, 50, 0.9], [300, 50, 0.9], [300, 200, 0.9], [100, 200, 0.9], [200, 100, 0.9]]
    sigma = np.stack([np.full(66, 1.0), np.full(66, 2.0)])
    found = Detections(Path("x"), APOLLOCAR3D_66, {"a": cars, "b": cars[:0]}, None, {"a": sigma, "b": sigma[:0]})
    rows, _ = match_keypoints(found, ("a", "b"), Camera(400.0, 400.0, 240.0, 135.0, 480, 270))
    assert sigma_of(found, ("a", "b"), rows).tolist() == [[2.0] * 66, [0.0] * 66]


def test_own_schema_round_trip(tmp_path):
    schema = KeypointSchema("chair", ("a", "b", "c", "d", "e"), (1, 0, 2, 4, 3))
    write_keypoints(tmp_path / "k.json", schema, (10, 10), {"x.png": rows(2, 5)})
    assert read_keypoints(tmp_path / "k.json").schema == schema


def test_openpifpaf_folder(tmp_path):
    uvc = rows(3)
    instance = {"keypoints": uvc.flatten().tolist(), "bbox": [0, 0, 1, 1], "score": 0.9, "category_id": 1}
    (tmp_path / "frame_00001.png.predictions.json").write_text(json.dumps([instance, instance]))
    (tmp_path / "frame_00002.png.predictions.json").write_text("[]")
    read = read_keypoints(tmp_path)
    assert set(read.frames) == {"frame_00001.png", "frame_00002.png"}
    assert read.frames["frame_00001.png"].shape == (2, 66, 3)
    assert read.frames["frame_00002.png"].shape == (0, 66, 3)
    seen = uvc[:, 2] > 0
    np.testing.assert_allclose(read.frames["frame_00001.png"][0][seen, :2], uvc[seen, :2] + 0.5)  # pixel centres
    assert (read.frames["frame_00001.png"][0][~seen] == 0).all()


def test_openpifpaf_files_of_the_24_point_model(tmp_path):
    uvc = rows(4, 24)
    (tmp_path / "a.png.predictions.json").write_text("[]")
    (tmp_path / "b.png.predictions.json").write_text(json.dumps([{"keypoints": uvc.flatten().tolist()}]))
    read = read_keypoints(tmp_path)
    assert read.schema is APOLLOCAR3D_24
    assert {name: found.shape for name, found in read.frames.items()} == {"a.png": (0, 24, 3), "b.png": (1, 24, 3)}


def test_a_known_schema_is_written_by_name(tmp_path):
    write_keypoints(tmp_path / "k.json", APOLLOCAR3D_24, (10, 10), {"x.png": rows(2, 24)})
    assert json.loads((tmp_path / "k.json").read_text())["schema"] == "apollocar3d-24"
    assert read_keypoints(tmp_path / "k.json").schema is APOLLOCAR3D_24


def coco(labels, values) -> dict:
    return {
        "images": [{"id": 5, "file_name": "a.png", "width": 40, "height": 30}, {"id": 6, "file_name": "b.png"}],
        "categories": [{"id": 1, "name": "thing", "keypoints": ["p", "q", "r", "s"]}],
        "annotations": [
            {
                "image_id": 5,
                "category_id": 1,
                "keypoints": [c for v, seen in zip(values, labels, strict=True) for c in (*v, seen)],
            }
        ],
    }


def test_coco_annotations(tmp_path):
    content = coco([2, 1, 0, 2], [(1, 2), (3, 4), (0, 0), (5, 6)])
    (tmp_path / "coco.json").write_text(json.dumps(content))
    read = read_keypoints(tmp_path / "coco.json")
    expected = [[1.5, 2.5, 1.0], [3.5, 4.5, 0.5], [0, 0, 0], [5.5, 6.5, 1.0]]
    np.testing.assert_allclose(read.frames["a.png"][0], expected)
    assert read.frames["b.png"].shape == (0, 4, 3)
    assert {*read.sizes.values()} == {(40, 30)}


def test_coco_scores_of_a_detector_are_kept(tmp_path):
    (tmp_path / "coco.json").write_text(json.dumps(coco([0.9, 0.4, 0, 1.0], [(1, 2), (3, 4), (0, 0), (5, 6)])))
    np.testing.assert_allclose(read_keypoints(tmp_path / "coco.json").frames["a.png"][0, :, 2], [0.9, 0.4, 0, 1.0])


def own(frames) -> str:
    return json.dumps({"schema": "apollocar3d-66", "width": 480, "height": 270, "frames": frames})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not valid JSON"),
        ("[]", "no keypoint file"),
        (own([{"file_path": "a.png", "keypoints": [[1, 2, 1]] * 65}]), "65 keypoints, expected 66"),
        (own([{"file_path": "a.png", "keypoints": [[1, 2, 1]] * 65 + [[float("nan"), 2, 1]]}]), "not finite"),
        (own([{"file_path": "a.png", "keypoints": [[1, 2, 1]] * 65 + [[1, 2, float("nan")]]}]), "not finite"),
        (own([{"file_path": "a.png", "keypoints": [[1, 2, -1]] * 66}]), "negative"),
        (own([{"file_path": "a.png", "keypoints": "none"}]), "not numbers"),
        (own([{"file_path": "a.png", "keypoints": [[0, 0, 0]] * 66}] * 2), "two frames are called a.png"),
        (own([{"keypoints": []}]), "lacks"),
        ('{"schema": "dogs", "frames": []}', "schema 'dogs' is unknown"),
    ],
)
def test_bad_files_get_a_clear_error(tmp_path, text, message):
    path = tmp_path / "keypoints.json"
    path.write_text(text)
    with pytest.raises(KroncError, match=message) as caught:
        read_keypoints(path)
    assert str(path) in str(caught.value)


def test_missing_and_empty_places_name_the_formats(tmp_path):
    for path in (tmp_path, tmp_path / "nothing.json"):
        with pytest.raises(KroncError, match="OpenPifPaf"):
            read_keypoints(path)


def test_nan_of_an_unseen_point_is_ignored(tmp_path):
    (tmp_path / "k.json").write_text(own([{"file_path": "a.png", "keypoints": [[float("nan"), 2, 0]] * 66}]))
    assert (read_keypoints(tmp_path / "k.json").frames["a.png"] == 0).all()


# ---- which detections are whose


CAMERA = Camera(500.0, 500.0, 240.0, 135.0, 480, 270)
NAMES = ("images/a.png", "images/b.png", "images/c.png")


def found(frames, size=(480, 270)) -> Detections:
    return Detections(Path("k.json"), APOLLOCAR3D_66, frames, size)


def test_rows_are_matched_by_path_or_by_file_name():
    one, other = rows(0), rows(1)
    matched, note = match_keypoints(found({"images/c.png": one[None], "photos/a.png": other[None]}), NAMES, CAMERA)
    np.testing.assert_array_equal(matched, [other, np.zeros_like(one), one])
    assert note == ""


def test_paths_tell_apart_what_file_names_do_not():
    names = ("left/a.png", "right/a.png")
    matched, _ = match_keypoints(found({name: rows(i)[None] for i, name in enumerate(names)}), names, CAMERA)
    np.testing.assert_array_equal(matched, [rows(0), rows(1)])
    with pytest.raises(KroncError, match=r"1 images that do not exist \(a\.png\)"):
        match_keypoints(found({"a.png": rows(0)[None]}), names, CAMERA)


def test_of_several_cars_the_mask_tells_the_one(tmp_path):
    near = rows(0)
    far = np.where(near[:, 2:] > 0, near * [0.1, 0.1, 1] + [400, 200, 0], 0)
    mask = np.zeros((270, 480), np.uint8)
    mask[200:, 400:] = 255
    masks = [tmp_path / f"{name}.png" for name in "abc"]
    cv2.imwrite(str(masks[0]), mask)  # of images with one car masks are not read
    frames = {"a.png": np.stack([near, far]), "b.png": far[None], "c.png": far[None]}
    matched, note = match_keypoints(found(frames), NAMES, CAMERA, masks)
    np.testing.assert_array_equal(matched[0], far)
    assert note.startswith("1 images show several cars: the main one was taken by overlap with the mask")


@pytest.mark.parametrize(
    ("frames", "size", "message"),
    [
        ({"a.png": rows(0)[None]}, (960, 540), "is for 960x540 images, the camera says 480x270"),
        ({"d.png": rows(0)[None]}, None, r"1 images that do not exist \(d\.png\): expected names like images/a\.png"),
        ({"a.png": 0 * rows(0)[None]}, None, "no keypoints for any of the 3 images"),
        ({}, None, "no keypoints for any of the 3 images"),
    ],
)
def test_detections_that_do_not_fit_are_named(frames, size, message):
    with pytest.raises(KroncError, match=message):
        match_keypoints(found(frames, size), NAMES, CAMERA)
