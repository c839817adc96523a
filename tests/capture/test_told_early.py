"""What is wrong with the input of `ns-process-data kronc` is told before anything is written or detected."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from kronc_ns.capture.detection.choice import DetectorOptions
from kronc_ns.commands.options import SolverOptions
from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import write_keypoints
from kronc_ns.files.output import check_output
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.plugin.process_data import KroncToNerfstudio
from tests.capture.test_masks import SIZE, mask, scene
from tests.capture.test_photos import HEIGHT, WIDTH, clip, shoot

FRAMES_ONLY = DetectorOptions("none")


def status_of(command: KroncToNerfstudio) -> int:
    try:
        command.main()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else -1
    return 0


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    for i in range(4):
        shoot(tmp_path / "photos" / f"IMG_{i}.jpg", 60.0 * i)
    return tmp_path / "photos"


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Run with these options: it ends with 2 and one line, which is returned, and leaves the output as it was."""
    new, solved = tmp_path / "new", tmp_path / "solved"
    solved.mkdir()
    (solved / "kronc.json").write_text('{"data": "."}')

    def run(data: Path, **options) -> str:
        for out in (new, solved):
            assert status_of(KroncToNerfstudio(data=data, output_dir=out, **options)) == 2
        assert not new.exists()
        assert [file.name for file in solved.iterdir()] == ["kronc.json"]
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 2
        assert lines[0] == lines[1]
        assert lines[0].startswith("error: ")
        return lines[0]

    return run


def test_masks_of_photos(photos: Path, tmp_path: Path, refused):
    masks = tmp_path / "masks"
    for i in range(4):
        mask(masks / f"IMG_{i}.png", 10, (WIDTH, HEIGHT))
    (masks / "IMG_3.png").unlink()
    assert "lacks a mask for IMG_3 (1 of 4 are missing)" in refused(photos, masks=masks)
    mask(masks / "IMG_3.png", 10, (WIDTH // 2, HEIGHT // 2))
    line = refused(photos, masks=masks)
    assert "IMG_3.png is 320x240, its image 640x480: expected masks in the pixels of the images" in line
    mask(photos / "masks" / "mask.png", 10, (HEIGHT, WIDTH))  # beside the photos
    assert "mask.png is 480x640, its image 640x480" in refused(photos)


def test_masks_of_frames_that_are_there(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    options = {"data": photos, "output_dir": tmp_path / "out", "detection": FRAMES_ONLY}
    assert status_of(KroncToNerfstudio(**options)) == 0
    one = mask(tmp_path / "one.png", 10, (WIDTH, HEIGHT - 1))
    assert status_of(KroncToNerfstudio(**options, masks=one)) == 2
    assert "one.png is 640x479, its image 640x480" in capsys.readouterr().err
    assert status_of(KroncToNerfstudio(**options, masks=mask(one, 10, (WIDTH, HEIGHT)))) == 0
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert [frame["mask_path"] for frame in content["frames"]] == [f"masks/frame_0000{i}.png" for i in (1, 2, 3, 4)]


def test_a_mask_in_the_output_survives_as_the_one_for_all(photos: Path, tmp_path: Path):
    options = {"data": photos, "output_dir": tmp_path / "out", "detection": FRAMES_ONLY}
    own = mask(tmp_path / "out" / "masks" / "frame_00001.png", 10, (WIDTH, HEIGHT))
    (tmp_path / "out" / ".kronc-incomplete").write_text("data set")
    assert status_of(KroncToNerfstudio(**options, masks=own)) == 0
    assert len(list((tmp_path / "out" / "masks").iterdir())) == 4


def test_masks_of_a_video(tmp_path: Path, refused):
    video = clip(tmp_path / "walk.mov")
    one = mask(tmp_path / "one.png", 10, (120, 160))
    assert "one.png is 120x160, its image 160x120" in refused(video, masks=one)
    assert "holds 0 masks called as the frames of a video" in refused(video, masks=tmp_path)


def test_intrinsics_of_a_video(tmp_path: Path, refused):
    video = clip(tmp_path / "walk.mov")
    lens = {"fl_x": 500, "cx": 100, "cy": 200, "w": 200, "h": 400}
    (tmp_path / "lens.json").write_text(json.dumps(lens))
    assert "is for 200x400 images, the images are 160x120" in refused(video, camera=tmp_path / "lens.json")
    assert "focal length (-3, -3) px is not positive" in refused(video, focal_length_px=-3.0)
    assert "--fov-deg is 0: expected degrees" in refused(video, fov_deg=0.0)
    assert "of which --fps 1 takes fewer than 3 frames" in refused(video, fps=1.0)


def test_poses_that_are_not_there(photos: Path, refused):
    line = refused(photos, solve=SolverOptions(init="given"))
    assert "--init given: " in line
    assert "use --init auto" in line


def test_keypoints_of_other_photos(photos: Path, tmp_path: Path, refused):
    rows = np.ones((66, 3))
    write_keypoints(tmp_path / "kp.json", APOLLOCAR3D_66, (100, 50), {f"IMG_{i}.jpg": rows for i in range(4)})
    assert "kp.json is for 100x50 images, the camera says 640x480" in refused(photos, keypoints=tmp_path / "kp.json")
    write_keypoints(tmp_path / "kp.json", APOLLOCAR3D_66, (WIDTH, HEIGHT), {f"DSC_{i}.jpg": rows for i in range(4)})
    assert "4 images that do not exist (DSC_0.jpg)" in refused(photos, keypoints=tmp_path / "kp.json")


def test_what_lies_beside_the_images(tmp_path: Path, refused):
    names = [f"images/{i}.png" for i in range(3)]
    data = scene(tmp_path / "scene", names, depth_file_path=["depths/0.png"] * 3)
    (data / "depths").mkdir()
    Image.new("RGB", SIZE).save(data / "depths" / "0.png")
    assert "0.png is no depth map: expected a 16-bit" in refused(data)
    scene(data, names)
    (data / "reference.json").write_text('{"frames": 3}')
    assert 'reference.json: expected "frames", a list' in refused(data)


def test_photos_that_are_all_one(tmp_path: Path, refused):
    for i in range(4):
        shoot(tmp_path / "photos" / f"{i}.jpg", 0.0, noise=i)
    assert "holds 1 different photos (3 show nothing new)" in refused(tmp_path / "photos")


def test_duplicates_are_said_and_taken_on_demand(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    shoot(photos / "IMG_4.jpg", 180.0, blur=1.0)
    clip(photos / "IMG_4.MOV")
    options = {"data": photos, "output_dir": tmp_path / "out", "detection": FRAMES_ONLY}
    assert status_of(KroncToNerfstudio(**options)) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert said.startswith("4 frames are ready in")
    assert "1 that show nothing new were left out (IMG_4.jpg; --keep-duplicates takes them)" in said
    assert "the videos of 1 Live Photos were left out" in said
    assert status_of(KroncToNerfstudio(**options, keep_duplicates=True)) == 0
    assert capsys.readouterr().out.startswith("5 frames are ready in")


def test_an_output_that_cannot_be_written(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "file").write_text("mine")
    missing = DetectorOptions("onnx", tmp_path / "nowhere.onnx")  # would be named next
    for out, message in (
        (tmp_path / "file", "file is a file: expected a folder for the output"),
        (tmp_path / "file" / "out", "file/out cannot be written: "),
    ):
        assert status_of(KroncToNerfstudio(data=photos, output_dir=out, detection=missing)) == 2
        assert message in capsys.readouterr().err
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody to whom a folder is closed")
def test_a_folder_that_is_closed(tmp_path: Path):
    for folder in (tmp_path, *tmp_path.parents):
        if folder.owner() == "root" and folder.is_relative_to("/tmp/pytest-of-root"):
            folder.chmod(0o755)
    (tmp_path / "closed").mkdir(mode=0o555)
    child = os.fork()
    if child == 0:
        os.setuid(65534)
        try:
            check_output(tmp_path / "closed" / "out")
        except KroncError as error:
            os._exit(0 if f"out cannot be written: {tmp_path / 'closed'} is not writable" in str(error) else 2)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
