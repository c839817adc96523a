"""`kronc synth`: captures whose truth is exact and whose noise is as asked."""

import json

import cv2
import numpy as np
import pytest

from kronc_ns.files.images import read_depth
from kronc_ns.files.keypoints import read_keypoints
from kronc_ns.files.transforms import camera_and_frames, read_poses
from kronc_ns.geometry.camera import reproject
from kronc_ns.geometry.poses import invert, transform
from kronc_ns.geometry.rotations import rotation_angle_deg
from kronc_ns.synthetic.car import build_car
from kronc_ns.synthetic.car_parts import CarShape
from tests.commands.conftest import contents

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning", "error::UserWarning")  # they would reach stderr


def test_synth_follows_its_seed(kronc, tmp_path):
    options = ("--views", 4, "--noise-px", 1, "--missing", 0.2, "--outliers", 0.1, "--pose-noise-deg", 1)
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        assert kronc("synth", "--output-dir", tmp_path / name, *options, "--seed", seed).status == 0
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    for file in ("keypoints.json", "reference.json", "transforms.json"):
        assert (tmp_path / "a" / file).read_bytes() != (tmp_path / "c" / file).read_bytes()


def test_noise_is_on_the_start_only(kronc, tmp_path):
    """The reference explains the noiseless keypoints exactly; the start is off by as much as was asked for."""
    noise = ("--pose-noise-deg", 3, "--pose-noise-m", 0.2)
    assert kronc("synth", "--output-dir", tmp_path / "a", "--views", 40, *noise).status == 0
    content = json.loads((tmp_path / "a/reference.json").read_text())
    camera, _ = camera_and_frames(content, tmp_path)
    truth, start = (
        np.stack(list(read_poses(tmp_path / "a" / f"{name}.json").values())) for name in ("reference", "transforms")
    )
    rows = np.concatenate(list(read_keypoints(tmp_path / "a").frames.values()))
    pixels = reproject(build_car(CarShape()).keypoints, truth, camera)
    np.testing.assert_allclose(rows[..., :2][rows[..., 2] > 0], pixels[rows[..., 2] > 0], atol=1e-3)
    offset = (start - truth)[..., 3]
    angle = rotation_angle_deg(truth[..., :3].swapaxes(1, 2) @ start[..., :3])
    assert np.sqrt(np.square(offset).mean()) == pytest.approx(0.2, rel=0.3)
    assert np.sqrt(np.square(angle).mean() / 3) == pytest.approx(3, rel=0.3)


def test_without_pose_noise_there_is_no_start(kronc, tmp_path):
    kronc("synth", "--output-dir", tmp_path / "a", "--views", 4)
    assert read_poses(tmp_path / "a/transforms.json") == {}
    assert len(read_poses(tmp_path / "a/reference.json")) == 4


@pytest.mark.parametrize(("preset", "channels"), [("walk", 3), ("carpatch", 4)])
def test_rendered_captures_have_images_masks_and_depths(kronc, tmp_path, preset, channels):
    options = ("--preset", preset, "--views", 3, "--width", 64, "--render", "--pose-noise-m", 0.1)
    result = kronc("synth", "--output-dir", tmp_path / "a", *options)
    assert (result.status, result.err) == (0, "")
    content = json.loads((tmp_path / "a/transforms.json").read_text())
    camera, frames = camera_and_frames(content, tmp_path)
    assert (camera.width, camera.height) == ((64, 36) if preset == "walk" else (64, 64))
    size = (camera.height, camera.width)
    reference = read_poses(tmp_path / "a/reference.json")
    keypoints = read_keypoints(tmp_path / "a").frames
    points = build_car(CarShape()).keypoints
    assert len(frames) == 3
    for frame in frames:
        image = cv2.imread(str(tmp_path / "a" / frame["file_path"]), cv2.IMREAD_UNCHANGED)
        mask = cv2.imread(str(tmp_path / "a" / frame["mask_path"]), cv2.IMREAD_UNCHANGED)
        depth = read_depth(tmp_path / "a" / frame["depth_file_path"])
        assert image.shape == (*size, channels)
        assert mask.shape == depth.shape == size
        assert set(np.unique(mask)) == {0, 255}
        assert image[mask > 0][:, :3].std() > 10
        # the picture was taken from the reference pose: its depth under the keypoints is the points' own
        rows = keypoints[frame["file_path"]][0]
        seen = rows[:, 2] > 0
        column, line = np.floor(rows[seen, :2]).astype(int).T
        z = transform(invert(reference[frame["file_path"]]), points)[seen, 2]
        on_car = mask[line, column] > 0
        assert on_car.mean() > 0.7
        assert np.median(np.abs(depth[line, column] - z)[on_car]) < 0.06
        start = read_poses(tmp_path / "a/transforms.json")[frame["file_path"]]
        assert not np.array_equal(start, reference[frame["file_path"]])


@pytest.mark.parametrize(
    ("options", "parts"),
    [
        (("--outliers", 1.5), ["--outliers", "1.5"]),
        (("--missing", -0.1), ["--missing", "-0.1"]),
        (("--views", 0), ["--views", "0"]),
        (("--width", 8), ["--width", "8"]),
        (("--noise-px", -1), ["--noise-px"]),
        (("--noise-px", "nan"), ["--noise-px"]),
        (("--missing", "nan"), ["--missing"]),
    ],
)
def test_impossible_captures_are_refused(kronc, tmp_path, options, parts):
    assert kronc("synth", "--output-dir", tmp_path / "a", *options).refused(*parts)
    assert not (tmp_path / "a").exists()
