"""MMPose's predictions/, in small files after the documentation of its inferencer (1.3)."""

import json

import numpy as np
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import match_keypoints, read_keypoints
from kronc_ns.geometry.camera import Camera

CAMERA = Camera(50.0, 50.0, 20.0, 15.0, 40, 30)
INSTANCE = {
    "keypoints": [[1.0, 2.0], [3.0, 2.0], [3.0, 4.0], [1.0, 4.0]],
    "keypoint_scores": [0.9, 0.8, -0.01, 1.02],
    "bbox": [[0.0, 1.0, 4.0, 5.0]],
    "bbox_score": 0.8,
}


@pytest.fixture
def predictions(tmp_path):
    folder = tmp_path / "vis" / "predictions"
    folder.mkdir(parents=True)
    (folder / "a.json").write_text(json.dumps([INSTANCE, {**INSTANCE, "bbox_score": 0.3}]))
    (folder / "b.json").write_text("[]")
    return folder


def test_images_are_known_by_their_stems(predictions):
    for given in (predictions, predictions.parent, predictions / "a.json"):
        found = read_keypoints(given)
        rows, note = match_keypoints(found, ("images/b.png", "images/a.jpg"), CAMERA)
        np.testing.assert_allclose(rows[1], [[1.5, 2.5, 0.9], [3.5, 2.5, 0.8], [0, 0, 0], [1.5, 4.5, 1]])
        assert (rows[0] == 0).all()
        assert note == ""


def test_images_of_one_stem_cannot_be_told_apart(predictions):
    with pytest.raises(KroncError, match=r"images that do not exist \(a\): expected names like a, of left/a\.jpg"):
        match_keypoints(read_keypoints(predictions), ("left/a.jpg", "right/a.jpg", "b.jpg"), CAMERA)


def test_wrong_counts_and_videos_are_told(predictions):
    (predictions / "b.json").write_text(json.dumps([{**INSTANCE, "keypoint_scores": [1.0] * 5}]))
    with pytest.raises(KroncError, match=r"b\.json: 4 keypoints with 5 scores, expected 4"):
        read_keypoints(predictions)
    video = predictions / "walk.json"
    video.write_text(json.dumps([{"frame_id": 0, "instances": [INSTANCE]}]))
    with pytest.raises(KroncError, match=r"walk\.json has MMPose's keypoints of a video: run it on the images"):
        read_keypoints(video)
