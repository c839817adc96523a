"""The same keypoints from the files of every tool make the same scene."""

import json

import numpy as np
import pytest

from kronc_ns.files.keypoints import write_keypoints
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.scene import Scene
from tests.files.keypoints import tools


def loaded(write, scene: Scene, tmp_path, walk_folder) -> Scene:
    return load_scene(walk_folder, write(scene, tmp_path / "tool"))


@pytest.mark.parametrize("write", tools.WITH_SCORES, ids=lambda write: write.__name__)
def test_a_detector_s_places_and_scores(write, scene, tmp_path, walk_folder):
    confidence = np.random.default_rng(0).uniform(0.1, 1, scene.keypoints.shape[:2])
    detected = np.concatenate([scene.keypoints[..., :2], (confidence * scene.visibility)[..., None]], axis=2)
    write_keypoints(
        walk_folder / "keypoints.json",
        scene.schema,
        (scene.camera.width, scene.camera.height),
        dict(zip(scene.names, detected, strict=True)),
    )
    ours = load_scene(walk_folder)
    theirs = loaded(write, ours, tmp_path, walk_folder)
    assert theirs.schema is APOLLOCAR3D_66
    np.testing.assert_allclose(theirs.keypoints, ours.keypoints, atol=1e-6)
    assert theirs.notes == ()


@pytest.mark.parametrize("write", tools.WITHOUT_SCORES, ids=lambda write: write.__name__)
def test_an_annotator_s_places(write, scene, tmp_path, walk_folder):
    theirs = loaded(write, scene, tmp_path, walk_folder)
    assert theirs.schema is APOLLOCAR3D_66
    np.testing.assert_array_equal(theirs.seen, scene.seen)
    seen = scene.seen
    np.testing.assert_allclose(theirs.keypoints[seen][:, :2], scene.keypoints[seen][:, :2], atol=1e-6)
    assert (theirs.keypoints[seen][:, 2] == 1).all()


EVERY = (*tools.WITH_SCORES, *tools.WITHOUT_SCORES)


def with_nothing(value, count: list[int]):
    """The value with every so manieth float in it replaced: NaN, null, infinity, text."""
    if isinstance(value, dict):
        return {key: with_nothing(item, count) for key, item in value.items()}
    if isinstance(value, list):
        return [with_nothing(item, count) for item in value]
    if isinstance(value, float) and value not in (0.9, 0.4, 0.0):  # not the scores, sizes and points that are not seen
        count[0] += 1
        if count[0] % 97 == 0:
            return [float("nan"), None, float("inf"), "12.5"][count[0] // 97 % 4]
    return value


@pytest.mark.parametrize("write", [w for w in EVERY if "ultralytics" not in w.__name__ or "val" in w.__name__])
def test_what_is_no_number_is_counted_and_told(write, scene, tmp_path, walk_folder):
    source = write(scene, tmp_path / "tool")
    for file in [source] if source.is_file() else sorted(source.glob("*.json")):
        file.write_text(json.dumps(with_nothing(json.loads(file.read_text()), [0])))
    theirs = load_scene(walk_folder, source)
    lost = int((scene.seen & ~theirs.seen).sum())
    assert 4 < lost < scene.seen.sum() / 4
    assert (theirs.seen <= scene.seen).all()
    assert np.isfinite(theirs.keypoints).all()
    (note,) = theirs.notes
    assert f"no finite numbers and count as not seen: {lost} (" in note
    assert str(source) in note


def test_in_ultralytics_labels_too(scene, tmp_path, walk_folder):
    source = tools.ultralytics(scene, tmp_path / "tool")
    file = source / "labels" / "frame_00002.txt"
    words = file.read_text().split()
    first = next(i for i, word in enumerate(words[5:], start=5) if word not in ("0", "1"))
    words[first], words[first + 1] = "nan", "inf"
    file.write_text(" ".join(words))
    theirs = load_scene(walk_folder, source)
    assert scene.seen.sum() - theirs.seen.sum() == 1
    assert "not seen: 1 (" in theirs.notes[0]
    assert "in frame_00002)" in theirs.notes[0]
