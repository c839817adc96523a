"""nerfstudio's transforms.json: what is written is what is read, and the axes in the file are OpenGL's."""

import json
from dataclasses import replace

import numpy as np
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.files.transforms import camera_and_frames, check_file_names, given_poses, read_poses, transforms_dict
from kronc_ns.geometry.poses import flip_camera_axes
from tests.files.conftest import FAILED_VIEW, KEPT


def test_reference_poses_come_back_in_opencv_axes(walk_folder, walk_capture):
    poses = read_poses(walk_folder / "reference.json")
    np.testing.assert_allclose(list(poses.values()), walk_capture.c2w, atol=1e-12)
    written = json.loads((walk_folder / "reference.json").read_text())["frames"][3]["transform_matrix"]
    opengl = np.array(written)[:3]
    np.testing.assert_allclose(flip_camera_axes(opengl), walk_capture.c2w[3], atol=1e-12)
    assert opengl[2, 1] > 0.9, "OpenGL's y axis points up in a walk"


def test_a_camera_and_poses_come_back_but_for_views_without_one(tmp_path, walk_capture):
    camera = replace(walk_capture.camera, k1=-0.1, k2=0.01, p1=0.002, p2=-0.003)
    c2w = walk_capture.c2w.copy()
    c2w[FAILED_VIEW] = np.nan
    names = [f"images/{i}.png" for i in range(16)]
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps(transforms_dict(camera, names, c2w, [f"masks/{i}.png" for i in range(16)])))
    again, frames = camera_and_frames(json.loads(file.read_text()), file)
    assert again == camera
    assert [frame["file_path"] for frame in frames] == [names[i] for i in KEPT]
    assert [frame["mask_path"] for frame in frames] == [f"masks/{i}.png" for i in KEPT]
    np.testing.assert_allclose(given_poses(frames, file), c2w[KEPT], atol=1e-12)


def test_poses_are_given_only_where_every_frame_has_one(tmp_path, walk_capture):
    content = transforms_dict(walk_capture.camera, ["a.png", "b.png"], walk_capture.c2w[:2])
    del content["frames"][1]["transform_matrix"]
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps(content))
    assert given_poses(content["frames"], file) is None
    assert list(read_poses(file)) == ["a.png"]


def test_a_rotation_that_is_nearly_one_is_made_one(tmp_path, walk_capture):
    content = transforms_dict(walk_capture.camera, ["a.png"], walk_capture.c2w[:1])
    matrix = np.array(content["frames"][0]["transform_matrix"])
    content["frames"][0]["transform_matrix"] = matrix.round(4).tolist()
    pose = given_poses(content["frames"], tmp_path)[0]
    np.testing.assert_allclose(pose[:, :3].T @ pose[:, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose, walk_capture.c2w[0], atol=2e-4)


def test_file_names_that_only_folders_tell_apart_are_named(tmp_path):
    check_file_names(["a/1.png", "a/2.png"], tmp_path)
    with pytest.raises(KroncError, match=r"2 images in different folders are called 1\.png"):
        check_file_names(["a/1.png", "b/1.png", "b/2.png"], tmp_path)
