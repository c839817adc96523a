"""Scene folders are read as they were written, and whatever is wrong in them is named."""

import math

import cv2
import numpy as np
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.files.scene_folder import load_scene


def test_scene_is_what_was_written(walk_folder, walk_capture):
    scene = load_scene(walk_folder)
    assert len(scene) == 16
    assert scene.camera == walk_capture.camera
    assert scene.given_c2w is None
    np.testing.assert_allclose(scene.keypoints, walk_capture.keypoints, atol=1e-3)


def test_given_poses_are_taken_but_a_solutions_are_not(walk_folder):
    (walk_folder / "transforms.json").write_text((walk_folder / "reference.json").read_text())
    assert load_scene(walk_folder).given_c2w is not None
    (walk_folder / "kronc.json").write_text('{"views": []}')
    assert load_scene(walk_folder).given_c2w is None


def test_distortion_is_removed_from_the_pixels(walk_folder, edit):
    plain = load_scene(walk_folder)
    edit(walk_folder / "transforms.json", lambda c: c.update(k1=-0.1))
    bent = load_scene(walk_folder)
    straight, curved = (np.linalg.norm(scene.uv[scene.seen] - (240, 135), axis=-1) for scene in (plain, bent))
    assert (curved >= straight - 1e-9).all()
    np.testing.assert_array_equal(bent.keypoints, plain.keypoints)


def test_depth_maps_are_read_under_the_keypoints(walk_folder, edit):
    (walk_folder / "depths").mkdir()
    for i in range(16):
        image = np.full((270, 480), 4000 + i, dtype=np.uint16)
        image[:, :240] = 0  # unknown
        cv2.imwrite(str(walk_folder / f"depths/d{i}.png"), image)

    def add(content):
        for i, frame in enumerate(content["frames"]):
            frame["depth_file_path"] = f"depths/d{i}.png"

    edit(walk_folder / "transforms.json", add)
    scene = load_scene(walk_folder)
    right = scene.seen & (scene.keypoints[..., 0] >= 240)
    expected = np.where(right, 4.0 + np.arange(16)[:, None] / 1000, np.nan)
    np.testing.assert_allclose(scene.given_depths, expected)


def frames(change):
    return lambda content: [change(frame) for frame in content["frames"]]


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("transforms.json", lambda c: c.pop("fl_x"), "fl_x missing"),
        ("transforms.json", lambda c: c.update(fl_x=0.0, fl_y=0.0), "not positive"),
        ("transforms.json", lambda c: c.update(cx=None), "cx missing"),
        ("transforms.json", lambda c: c.update(cx=[]), "not all finite numbers"),
        ("transforms.json", lambda c: c.update(w=math.inf), "not all finite numbers"),
        ("transforms.json", lambda c: c.update(cx=-5), "principal point"),
        ("transforms.json", lambda c: c.update(k1=1e9), "cannot be undone for"),
        ("keypoints.json", lambda c: c.update(width="abc"), "width and height are 'abc'"),
        ("keypoints.json", lambda c: c.update(frames=None), "expected .frames."),
        ("keypoints.json", lambda c: c.update(schema={"name": "x", "keypoints": 5}), "a list of names"),
        ("keypoints.json", lambda c: c["frames"][0]["keypoints"][0].__setitem__(2, 100.0), "confidence is 100"),
        ("transforms.json", lambda c: c.update(frames=[]), "no frames"),
        ("transforms.json", lambda c: c.update(frames="x"), "expected .frames."),
        ("transforms.json", lambda c: c.update(camera_model="OPENCV_FISHEYE"), "not supported"),
        ("transforms.json", lambda c: c["frames"][2].update(w=481), "the camera says 2 sizes"),
        ("transforms.json", lambda c: c["frames"].append(c["frames"][0]), "listed twice"),
        ("transforms.json", lambda c: c["frames"][0].update(mask_path="masks/a.png"), "lacks a mask_path"),
        ("transforms.json", lambda c: c.update(w=640), "keypoints in the pixels"),
        ("transforms.json", frames(lambda f: f.update(transform_matrix=np.zeros((4, 4)).tolist())), "no rotation"),
        ("transforms.json", frames(lambda f: f.update(transform_matrix=[[1, 2]])), "4x4"),
        ("transforms.json", frames(lambda f: f.update(depth_file_path="depths/none.png")), "no depth map"),
        ("keypoints.json", lambda c: c["frames"][0].update(file_path="images/other.png"), "do not exist"),
        ("keypoints.json", frames(lambda f: f.update(keypoints=[[0, 0, 0]] * 66)), "no keypoints for any"),
        ("keypoints.json", frames(lambda f: f["keypoints"].pop()), "65 keypoints"),
    ],
)
def test_bad_scenes_get_a_clear_error(walk_folder, edit, file, change, message):
    edit(walk_folder / file, change)
    with pytest.raises(KroncError, match=message) as caught:
        load_scene(walk_folder)
    assert "\n" not in str(caught.value)


def test_missing_files_are_named(walk_folder, tmp_path):
    with pytest.raises(KroncError, match="no folder"):
        load_scene(tmp_path / "nowhere")
    (walk_folder / "keypoints.json").unlink()
    with pytest.raises(KroncError, match=r"keypoints\.json"):
        load_scene(walk_folder)
    (walk_folder / "transforms.json").unlink()
    with pytest.raises(KroncError, match="intrinsics"):
        load_scene(walk_folder)


def test_missing_images_are_named(walk_folder):
    (walk_folder / "images").mkdir()
    (walk_folder / "images/frame_00001.png").touch()
    with pytest.raises(KroncError, match=r"frame_00002\.png does not exist \(15 images"):
        load_scene(walk_folder)
