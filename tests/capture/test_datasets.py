"""CarPatch's and COLMAP's folders become scene folders with the same poses, keypoints and masks."""

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from kronc_ns.capture.datasets import import_dataset
from kronc_ns.errors import KroncError
from kronc_ns.files.colmap import write_colmap
from kronc_ns.files.keypoints import write_keypoints
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.files.transforms import read_poses
from kronc_ns.geometry.poses import flip_camera_axes
from kronc_ns.keypoints.schema import APOLLOCAR3D_66, KeypointSchema
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import Capture, default_camera, make_capture

VIEWS, TRAIN = 6, 4


@pytest.fixture(scope="module")
def capture() -> Capture:
    return make_capture("carpatch", VIEWS, seed=2, noise_px=0.5, camera=default_camera("carpatch", 64))


@pytest.fixture
def carpatch(capture, tmp_path) -> Path:
    """The capture as CarPatch has it: two splits, RGBA images, Blender's field of view."""
    folder = tmp_path / "carpatch"
    matrices = flip_camera_axes(capture.c2w)
    rows = capture.keypoints
    for split, first, count in (("train", 0, TRAIN), ("test", TRAIN, VIEWS - TRAIN)):
        (folder / split).mkdir(parents=True)
        frames, keypoints = [], {}
        for i in range(count):
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": matrices[first + i].tolist()})
            keypoints[f"{split}/r_{i}.png"] = rows[first + i]
            image = np.full((64, 64, 4), 200, np.uint8)
            image[..., 3] = np.where(np.arange(64) < 10 + first + i, 255, 0)
            cv2.imwrite(str(folder / split / f"r_{i}.png"), image)
        angle = 2 * math.atan(64 / 2 / capture.camera.fx)
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
        write_keypoints(folder / f"keypoints_{split}.json", APOLLOCAR3D_66, (64, 64), keypoints)
    return folder


@pytest.fixture
def video(capture, tmp_path) -> Path:
    """The capture as frames, masks, keypoints and a COLMAP model, with a lens, in which one view is missing."""
    folder = tmp_path / "video"
    bent = replace(capture, camera=replace(capture.camera, k1=0.05, p2=0.01))
    write_capture(tmp_path / "scene", bent, start=bent.c2w)
    content = json.loads((tmp_path / "scene" / "transforms.json").read_text())
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].replace("frame", "video").replace(".png", ".jpg")
    content["frames"].pop(2)
    (tmp_path / "scene" / "transforms.json").write_text(json.dumps(content))
    (tmp_path / "scene" / "kronc.json").write_text('{"points": []}')
    write_colmap(folder / "sparse" / "0", tmp_path / "scene")
    names = [f"video_{i + 1:05d}.jpg" for i in range(VIEWS)]
    for kind in ("images", "masks"):
        (folder / kind).mkdir()
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / "images" / name), np.full((64, 64, 3), 90, np.uint8))
        mask = np.where(np.arange(64) < 10 + i, 255, 0).astype(np.uint8) * np.ones((64, 1), np.uint8)
        cv2.imwrite(str(folder / "masks" / f"{name}.png"), mask)
    write_keypoints(
        folder / "keypoints.json", APOLLOCAR3D_66, (64, 64), dict(zip(names, capture.keypoints, strict=True))
    )
    return folder


def check_masks(scene_folder: Path, masks: tuple[str, ...]) -> None:
    for i, name in enumerate(masks):
        mask = cv2.imread(str(scene_folder / name), cv2.IMREAD_GRAYSCALE)
        np.testing.assert_array_equal(mask[0] == 255, np.arange(64) < 10 + i)


def test_carpatch_comes_back_exactly(capture, carpatch, tmp_path):
    out = tmp_path / "out"
    assert import_dataset(carpatch, out) == VIEWS
    scene = load_scene(out)
    assert scene.given_c2w is None
    assert scene.names[0] == "images/train_r_0.png"
    assert scene.names[TRAIN] == "images/test_r_0.png"
    assert all((out / name).is_file() for name in scene.names)
    poses = read_poses(out / "reference.json")
    np.testing.assert_allclose(np.stack([poses[n] for n in scene.names]), capture.c2w, atol=1e-12, rtol=0)
    np.testing.assert_allclose(scene.keypoints, capture.keypoints, atol=5e-4, rtol=0)
    assert scene.camera.fx == pytest.approx(capture.camera.fx, rel=1e-12)
    assert (scene.camera.cx, scene.camera.width) == (32.0, 64)
    check_masks(out, scene.masks)


def test_a_single_split_and_keypoints_in_its_folder(capture, carpatch, tmp_path):
    (carpatch / "keypoints_train.json").rename(carpatch / "train" / "keypoints.json")
    assert import_dataset(carpatch, tmp_path / "out", ("train",)) == TRAIN
    np.testing.assert_allclose(load_scene(tmp_path / "out").keypoints, capture.keypoints[:TRAIN], atol=5e-4, rtol=0)


def test_a_video_posed_by_colmap_comes_back_exactly(capture, video, tmp_path):
    out = tmp_path / "out"
    assert import_dataset(video, out) == VIEWS
    scene = load_scene(out)
    assert len(scene) == VIEWS
    poses = read_poses(out / "reference.json")
    known = [i for i in range(VIEWS) if i != 2]
    assert set(poses) == {scene.names[i] for i in known}
    found = np.stack([poses[scene.names[i]] for i in known])
    np.testing.assert_allclose(found, capture.c2w[known], atol=1e-12, rtol=0)
    np.testing.assert_allclose(scene.keypoints, capture.keypoints, atol=5e-4, rtol=0)
    assert (scene.camera.k1, scene.camera.k2, scene.camera.p1, scene.camera.p2) == (0.05, 0.0, 0.0, 0.01)
    check_masks(out, scene.masks)


def test_splits_of_two_cameras(capture, carpatch, tmp_path):
    change(carpatch / "transforms_test.json", camera_angle_x=0.5)
    assert import_dataset(carpatch, tmp_path / "out") == VIEWS
    lenses = load_scene(tmp_path / "out").lenses
    assert lenses.of_view.tolist() == [0] * TRAIN + [1] * (VIEWS - TRAIN)
    assert [camera.fx for camera in lenses.cameras] == pytest.approx([capture.camera.fx, 32 / math.tan(0.25)])


@pytest.fixture
def two_cameras(video) -> Path:
    """The video with another camera, of a larger picture, for its last view."""
    import zlib  # noqa: F401 - before pycolmap

    import pycolmap

    model = pycolmap.Reconstruction(str(video / "sparse" / "0"))
    other = pycolmap.Camera(camera_id=7, model="PINHOLE", width=96, height=80, params=[90.0, 91.0, 48.0, 40.0])
    wide = pycolmap.Reconstruction()
    for camera in (*model.cameras.values(), other):
        wide.add_camera_with_trivial_rig(camera)
    for number, image in model.images.items():
        own = other.camera_id if image.name == "video_00006.jpg" else image.camera_id
        copy = pycolmap.Image(name=image.name, camera_id=own, image_id=number)
        wide.add_image_with_trivial_frame(copy, image.cam_from_world())
    wide.write_binary(str(video / "sparse" / "0"))
    write_picture(video / "images" / "video_00006.jpg", 96, 80)
    cv2.imwrite(str(video / "masks" / "video_00006.jpg.png"), np.full((80, 96), 255, np.uint8))
    content = json.loads((video / "keypoints.json").read_text())
    del content["width"], content["height"]
    (video / "keypoints.json").write_text(json.dumps(content))
    for kind in ("images/video_00003.jpg", "masks/video_00003.jpg.png"):  # which COLMAP has not placed
        (video / kind).unlink()
    content["frames"].pop(2)
    (video / "keypoints.json").write_text(json.dumps(content))
    return video


def test_a_video_of_two_cameras(capture, two_cameras, tmp_path):
    out = tmp_path / "out"
    assert import_dataset(two_cameras, out) == VIEWS - 1
    scene = load_scene(out)
    assert scene.lenses.of_view.tolist() == [0] * (VIEWS - 2) + [1]
    other = scene.lenses.cameras[1]
    assert (other.fx, other.fy, other.cx, other.width, other.height) == (90.0, 91.0, 48.0, 96, 80)
    poses = read_poses(out / "reference.json")
    known = [i for i in range(VIEWS) if i != 2]
    np.testing.assert_allclose(np.stack([poses[name] for name in scene.names]), capture.c2w[known], atol=1e-12, rtol=0)
    assert cv2.imread(str(out / scene.masks[-1])).shape[:2] == (80, 96)


def test_which_camera_took_an_image_that_colmap_has_not_placed_cannot_be_told(two_cameras, tmp_path):
    write_picture(two_cameras / "images" / "video_00003.jpg", 64, 64)
    with pytest.raises(KroncError, match=r"2 cameras and does not say which took video_00003\.jpg"):
        import_dataset(two_cameras, tmp_path / "out")


def change(file: Path, **values) -> None:
    file.write_text(json.dumps(json.loads(file.read_text()) | values))


def five_points(folder: Path) -> None:
    schema = KeypointSchema("five", tuple("abcde"), (0, 1, 2, 3, 4))
    write_keypoints(folder / "keypoints_test.json", schema, (64, 64), {"test/r_0.png": np.ones((5, 3))})


def one_keypoint_less(folder: Path) -> None:
    content = json.loads((folder / "keypoints_test.json").read_text())
    content["frames"][1]["keypoints"].pop()
    change(folder / "keypoints_test.json", frames=content["frames"])


def write_picture(file: Path, width: int = 64, height: int = 48) -> None:
    cv2.imwrite(str(file), np.zeros((height, width, 4), np.uint8))


BAD_CARPATCH = {
    "split": (lambda f: (f / "transforms_test.json").unlink(), r"transforms_test.*--splits train$"),
    "keypoints": (lambda f: (f / "keypoints_test.json").unlink(), r"no keypoints: expected .*keypoints_test\.json"),
    "image": (lambda f: (f / "test" / "r_1.png").unlink(), r"r_1\.png is no image"),
    "size": (lambda f: write_picture(f / "test" / "r_1.png"), r"64x64.*64x48: expected one camera and one size"),
    "angle": (lambda f: change(f / "transforms_test.json", camera_angle_x=None), "camera_angle_x is None"),
    "keypoints' size": (lambda f: change(f / "keypoints_train.json", width=80), "80x64 images"),
    "schema": (five_points, "66 keypoints for .*, 5 for"),
    "count": (one_keypoint_less, "65 keypoints, expected 66"),
    "frames": (lambda f: change(f / "transforms_train.json", frames=[]), "0 of 0 frames have a pose"),
}


@pytest.mark.parametrize("what", BAD_CARPATCH)
def test_what_is_wrong_with_a_carpatch_scene_is_said(what, carpatch, tmp_path):
    spoil, message = BAD_CARPATCH[what]
    spoil(carpatch)
    with pytest.raises(KroncError, match=message):
        import_dataset(carpatch, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def empty(folder: Path) -> None:
    for file in sorted(folder.rglob("*"), reverse=True):
        file.rmdir() if file.is_dir() else file.unlink()


BAD_VIDEO = {
    "everything": (empty, "neither transforms_train.json"),
    "model": (lambda f: empty(f / "sparse"), "no COLMAP model: expected cameras.bin or cameras.txt"),
    "half a model": (lambda f: next(f.rglob("images.bin")).unlink(), "cannot be read as a COLMAP model"),
    "image": (lambda f: (f / "images" / "video_00001.jpg").unlink(), r"has video_00001\.jpg, which is not among"),
    "size": (lambda f: [write_picture(i) for i in (f / "images").iterdir()], "64x48, COLMAP's camera 64x64"),
    "mask": (lambda f: (f / "masks" / "video_00003.jpg.png").unlink(), r"lacks a mask for video_00003\.jpg"),
    "keypoints": (lambda f: (f / "keypoints.json").unlink(), "no keypoints: expected"),
}


@pytest.mark.parametrize("what", BAD_VIDEO)
def test_what_is_wrong_with_a_video_is_said(what, video, tmp_path):
    spoil, message = BAD_VIDEO[what]
    spoil(video)
    with pytest.raises(KroncError, match=message):
        import_dataset(video, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_nothing_else_is_overwritten(carpatch, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    with pytest.raises(KroncError, match="already holds data"):
        import_dataset(carpatch, tmp_path / "out")
    with pytest.raises(KroncError, match="is no folder"):
        import_dataset(tmp_path / "nowhere", tmp_path / "other")
