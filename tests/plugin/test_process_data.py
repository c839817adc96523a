"""`kronc-process-data`: from photos, scene folders and videos to a dataset nerfstudio trains on, or one clear line."""

import dataclasses
import hashlib
import html
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image

from kronc_ns.capture.detection.builtin import detector as builtin
from kronc_ns.capture.detection.choice import DetectorOptions
from kronc_ns.capture.segmentation.choice import SegmenterOptions
from kronc_ns.commands.options import SolverOptions
from kronc_ns.files.keypoints import read_keypoints
from kronc_ns.files.output import MARKER
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.files.transforms import read_poses, transforms_dict
from kronc_ns.geometry.camera import Camera, Lenses
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.metrics.poses import evaluate_poses
from kronc_ns.plugin import process_data
from kronc_ns.plugin.process_data import KroncToNerfstudio
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import Capture, default_camera, make_capture
from tests.capture.detection.builtin_net import POINTS, builtin_net, car, draw_cars
from tests.capture.detection.dots import Net, save

VIEWS = 12
FRAMES_ONLY = DetectorOptions("none")
HASTY = "solver: adam\nadam:\n  steps: 3\n"  # too little for anything


@pytest.fixture(scope="module")
def capture() -> Capture:
    return make_capture("walk", views=VIEWS, seed=3)


@pytest.fixture
def config() -> SolverOptions:
    return SolverOptions()


@pytest.fixture
def scene(tmp_path: Path, made_scene: Path) -> Path:
    """A copy of the scene that the test may change."""
    return Path(shutil.copytree(made_scene, tmp_path / "scene"))


@pytest.fixture(scope="module")
def made_scene(tmp_path_factory: pytest.TempPathFactory, capture: Capture) -> Path:
    """Scene folder with the true poses given, photos IMG_1 ... IMG_12, masks and a reference."""
    folder = tmp_path_factory.mktemp("made") / "scene"
    write_capture(folder, capture, start=capture.c2w)
    for file in ("transforms.json", "reference.json", "keypoints.json"):
        content = json.loads((folder / file).read_text())
        for i, frame in enumerate(content["frames"], start=1):
            frame["file_path"] = f"images/IMG_{i}.jpg"
            if file == "transforms.json":
                frame["mask_path"] = f"masks/IMG_{i}.png"
        (folder / file).write_text(json.dumps(content))
    for i in range(1, VIEWS + 1):
        _picture(folder / f"images/IMG_{i}.jpg", i)
        mask = np.zeros((270, 480), dtype=np.uint8)
        mask[60:, 100:380] = 255
        (folder / "masks").mkdir(exist_ok=True)
        Image.fromarray(mask).save(folder / f"masks/IMG_{i}.png")
    return folder


def _picture(path: Path, seed: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    coarse = np.random.default_rng(seed).integers(0, 255, (27, 48, 3), dtype=np.uint8)
    Image.fromarray(coarse).resize((480, 270), Image.Resampling.BICUBIC).save(path)


def _status(command: KroncToNerfstudio) -> int:
    try:
        command.main()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else -1
    return 0


def _write_openpifpaf(folder: Path, capture: Capture, names: list[str]) -> None:
    folder.mkdir(exist_ok=True)
    for name, rows in zip(names, capture.keypoints, strict=True):
        shifted = np.where(rows[:, 2:] > 0, rows - [0.5, 0.5, 0.0], 0.0)
        text = json.dumps([{"keypoints": shifted.flatten().tolist()}])
        (folder / f"{name}.predictions.json").write_text(text)


def test_photos_of_two_phones_keep_their_own_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Every third photo by another phone, upright and of another focal length; EXIF tells both."""
    phones = default_camera("walk"), Camera(450.0, 450.0, 150.0, 200.0, 300, 400)
    captures = [make_capture("walk", views=20, seed=3, noise_px=0.5, camera=phone) for phone in phones]
    data, frames = tmp_path / "photos", []
    for i in range(20):
        of = int(i % 3 == 1)
        exif = Image.Exif()
        diagonal = np.hypot(phones[of].width, phones[of].height)
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = round(phones[of].fx / diagonal * 43.27)
        _picture(data / f"{i:02d}.jpg", i)
        picture = Image.open(data / f"{i:02d}.jpg").resize((phones[of].width, phones[of].height))
        picture.save(data / f"{i:02d}.jpg", exif=exif)
        frames.append({"file_path": f"{i:02d}.jpg", "keypoints": captures[of].keypoints[i].tolist()})
    (data / "keypoints.json").write_text(json.dumps({"schema": "apollocar3d-66", "frames": frames}))
    out = tmp_path / "out"
    assert _status(KroncToNerfstudio(data=data, output_dir=out, solve=SolverOptions(refine_focal=True))) == 0
    printed = capsys.readouterr().out
    assert "480x270 and 300x400" in printed
    content = json.loads((out / "transforms.json").read_text())
    assert "fl_x" not in content
    focal = {(frame["w"], frame["h"]): frame["fl_x"] for frame in content["frames"]}
    assert focal[480, 270] == pytest.approx(400, rel=0.02)
    assert focal[300, 400] == pytest.approx(450, rel=0.02)
    truth = {f"images/frame_{i + 1:05d}.jpg": pose for i, pose in enumerate(captures[0].c2w)}
    assert evaluate_poses(read_poses(out / "transforms.json"), truth).as_dict()["rotation_deg"]["mean"] < 1.0
    assert "480 × 270, 300 × 400" in (out / "report.html").read_text()


@pytest.mark.nerfstudio
def test_nerfstudio_reads_a_data_set_of_two_phones(tmp_path: Path):
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    phones = default_camera("walk"), Camera(450.0, 450.0, 150.0, 200.0, 300, 400)
    lenses = Lenses.of([phones[i % 2] for i in range(6)])
    capture, names = make_capture("walk", views=6, seed=3), [f"images/{i}.png" for i in range(6)]
    for name, phone in zip(names, lenses.each, strict=True):
        _picture(tmp_path / name, 0)
        Image.new("RGB", (phone.width, phone.height)).save(tmp_path / name)
    (tmp_path / "transforms.json").write_text(
        json.dumps(transforms_dict(lenses.usual, names, capture.c2w, lenses=lenses))
    )
    parser = NerfstudioDataParserConfig(data=tmp_path, downscale_factor=1, eval_mode="all").setup()
    cameras = parser.get_dataparser_outputs("train").cameras
    assert cameras.width.flatten().tolist() == [480, 300] * 3
    assert cameras.fx.flatten().tolist() == [400, 450] * 3


def test_scene_folder_to_dataset(scene: Path, tmp_path: Path, capture: Capture, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "out"
    assert _status(KroncToNerfstudio(data=scene, output_dir=out)) == 0
    printed = capsys.readouterr()
    assert "12 of 12" in printed.out
    assert "400.0 px: transforms.json" in printed.out
    assert f"ns-train nerfacto --data {out}" in printed.out
    assert "Traceback" not in printed.err

    errors = evaluate_poses(read_poses(out / "transforms.json"), read_poses(out / "reference.json")).as_dict()
    assert errors["registered"] == VIEWS
    assert errors["rotation_deg"]["max"] < 0.01
    assert not (out / MARKER).exists()
    assert "images/frame_00001.jpg" in (out / "report.html").read_text(encoding="utf-8")
    assert json.loads((out / "kronc.json").read_text())["status"] == "converged"
    content = json.loads((out / "transforms.json").read_text())
    assert content["frames"][0]["file_path"] == "images/frame_00001.jpg"
    for frame in content["frames"]:
        for path in (frame["file_path"], frame["mask_path"]):
            folder, name = path.split("/")
            assert (out / path).is_file()
            assert (out / f"{folder}_2" / name).is_file()
    found = read_keypoints(out)
    got = np.stack([found.frames[f"images/frame_{i + 1:05d}.jpg"][0] for i in range(VIEWS)])
    assert np.abs(got - capture.keypoints).max() < 1e-3


@pytest.mark.nerfstudio
def test_nerfstudio_reads_the_dataset(scene: Path, tmp_path: Path, config: SolverOptions):
    from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

    out = tmp_path / "out"
    assert _status(KroncToNerfstudio(data=scene, output_dir=out, solve=config)) == 0
    for factor in (1, 2):
        parser = NerfstudioDataParserConfig(data=out, downscale_factor=factor, eval_mode="all").setup()
        outputs = parser.get_dataparser_outputs("train")
        assert len(outputs.image_filenames) == VIEWS
        assert outputs.mask_filenames is not None
        for image, mask in zip(outputs.image_filenames, outputs.mask_filenames, strict=True):
            width, height = int(outputs.cameras.width[0]), int(outputs.cameras.height[0])
            assert Image.open(image).size == Image.open(mask).size == (width, height)
        assert float(outputs.cameras.fx[0]) == pytest.approx(400 / factor)
        assert float(outputs.cameras.cx[0]) == pytest.approx(240 / factor)


def test_given_poses_survive_an_interruption(
    scene: Path,
    tmp_path: Path,
    config: SolverOptions,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    out = tmp_path / "out"
    command = KroncToNerfstudio(data=scene, output_dir=out, solve=config)

    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(process_data, "solve_scene", interrupt)
        assert _status(command) == 130
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert (out / MARKER).exists()
    assert load_scene(out).given_c2w is not None
    assert _status(command) == 0
    assert "as an earlier run left them" in capsys.readouterr().out


def test_photos_without_keypoints_or_detector_say_how_to_go_on(
    scene: Path, tmp_path: Path, config: SolverOptions, capture: Capture, capsys: pytest.CaptureFixture[str]
):
    photos, out = scene / "images", tmp_path / "out"
    options = {"data": photos, "output_dir": out, "focal_length_px": 400.0, "solve": config, "detection": FRAMES_ONLY}
    assert _status(KroncToNerfstudio(**options)) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    assert printed.out.startswith("12 frames are ready in")
    assert "without `--detector none`" in printed.out
    assert "`--keypoints`" in printed.out
    assert (out / MARKER).exists()
    content = json.loads((out / "transforms.json").read_text())
    assert content["fl_x"] == 400.0
    assert "transform_matrix" not in content["frames"][0]

    _write_openpifpaf(out / "images", capture, [f"frame_{i:05d}.jpg" for i in range(1, VIEWS + 1)])
    written = (out / "images/frame_00001.jpg").stat().st_mtime_ns
    assert _status(KroncToNerfstudio(keypoints=out / "images", **options)) == 0
    assert "as an earlier run left them" in capsys.readouterr().out
    assert (out / "images/frame_00001.jpg").stat().st_mtime_ns == written
    assert (out / "images/frame_00001.jpg.predictions.json").exists()
    assert load_scene(out).visibility.sum() == capture.keypoints[..., 2].sum()

    assert _status(KroncToNerfstudio(**options)) == 2
    assert "is solved already: give --keypoints" in capsys.readouterr().err
    assert (out / "kronc.json").exists()

    (photos / "IMG_3.jpg").unlink()  # every later photo now has another number
    assert _status(KroncToNerfstudio(keypoints=out / "images", **options)) == 2
    assert "the keypoints beside them do not fit" in capsys.readouterr().err
    assert (out / "kronc.json").exists()
    assert (out / "images/frame_00012.jpg").exists()


def test_keypoints_may_use_the_names_of_the_photos(
    scene: Path, tmp_path: Path, config: SolverOptions, capture: Capture
):
    out, found = tmp_path / "out", tmp_path / "pifpaf"
    _write_openpifpaf(found, capture, [f"IMG_{i}.jpg" for i in range(1, VIEWS + 1)])
    command = KroncToNerfstudio(
        data=scene / "images",
        output_dir=out,
        keypoints=found,
        masks=scene / "masks",
        focal_length_px=400.0,
        solve=config,
    )
    assert _status(command) == 0
    assert np.abs(load_scene(out).keypoints - capture.keypoints).max() < 2e-3
    assert load_scene(out).masks is not None


def test_labels_of_another_tool_by_the_stems_of_the_photos(
    scene: Path, tmp_path: Path, config: SolverOptions, capture: Capture, capsys: pytest.CaptureFixture[str]
):
    labels, names = tmp_path / "labels", tmp_path / "names.txt"
    labels.mkdir()
    names.write_text("\n".join(APOLLOCAR3D_66.keypoints))
    for i, rows in enumerate(capture.keypoints, start=1):
        shares = np.where(rows[:, 2:] > 0, rows / [480, 270, 1], 0)
        words = [f"{value:.9f}" for value in shares.ravel()]
        words[int(np.flatnonzero(rows[:, 2])[0]) * 3] = "nan"
        (labels / f"IMG_{i}.txt").write_text(f"0 .5 .5 .5 .5 {' '.join(words)}")
    options = {"data": scene / "images", "output_dir": tmp_path / "out", "keypoint_names": str(names), "solve": config}
    assert _status(KroncToNerfstudio(**options)) == 2
    assert "names.txt: expected --keypoints, whose points they name" in capsys.readouterr().err
    assert _status(KroncToNerfstudio(keypoints=labels, focal_length_px=400.0, **options)) == 0
    assert "finite" in capsys.readouterr().out
    found, seen = load_scene(tmp_path / "out"), capture.keypoints[..., 2] > 0
    assert seen.sum() - found.seen.sum() == VIEWS
    assert np.abs(found.uv - capture.keypoints[..., :2])[found.seen].max() < 2e-3


def test_a_calibration_goes_through_to_the_dataset(scene: Path, tmp_path: Path, config: SolverOptions):
    lens = dataclasses.replace(default_camera("walk"), k1=-0.12, k2=0.03, cx=236.0)
    capture = make_capture("walk", views=VIEWS, seed=3, camera=lens)
    _write_openpifpaf(tmp_path / "pifpaf", capture, [f"IMG_{i}.jpg" for i in range(1, VIEWS + 1)])
    double = lens.scaled(2.0)  # as a photo of the target would give it
    calibration = {"fl_x": double.fx, "fl_y": double.fy, "cx": double.cx, "cy": double.cy, "w": 960, "h": 540}
    (tmp_path / "lens.json").write_text(json.dumps({**calibration, "k1": double.k1, "k2": double.k2}))
    out = tmp_path / "out"
    command = KroncToNerfstudio(
        data=scene / "images",
        output_dir=out,
        keypoints=tmp_path / "pifpaf",
        camera=tmp_path / "lens.json",
        solve=config,
    )
    assert _status(command) == 0
    assert load_scene(out).camera == lens
    truth = dict(zip([f"images/frame_{i:05d}.jpg" for i in range(1, VIEWS + 1)], capture.c2w, strict=True))
    assert evaluate_poses(read_poses(out / "transforms.json"), truth).as_dict()["rotation_deg"]["max"] < 0.01


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")
def test_video_in_two_runs(
    scene: Path, tmp_path: Path, config: SolverOptions, capture: Capture, capsys: pytest.CaptureFixture[str]
):
    video, out = tmp_path / "walk.mp4", tmp_path / "out"
    command = ["ffmpeg", "-v", "error", "-framerate", "6", "-i", str(scene / "images" / "IMG_%d.jpg"), str(video)]
    subprocess.run(command, check=True)
    options = {"data": video, "output_dir": out, "solve": config, "detection": FRAMES_ONLY}
    assert _status(KroncToNerfstudio(**options)) == 0
    printed = capsys.readouterr()
    assert printed.err.startswith("warning: focal length 377 px is an assumed field of view of 65 deg")
    assert printed.out.startswith("12 frames are ready in")
    assert len(list((out / "images").iterdir())) == VIEWS
    _write_openpifpaf(tmp_path / "pifpaf", capture, [f"frame_{i:05d}.png" for i in range(1, VIEWS + 1)])
    assert _status(KroncToNerfstudio(keypoints=tmp_path / "pifpaf", **options)) in (0, 3)  # 377 px, in truth 400
    assert "as an earlier run left them" in capsys.readouterr().out
    assert (out / "kronc.json").exists()


def test_a_doubtful_solution_is_written_and_ends_with_3(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    (tmp_path / "hasty.yaml").write_text(HASTY)
    solver = SolverOptions(config=str(tmp_path / "hasty.yaml"), init="circular")
    assert _status(KroncToNerfstudio(data=scene, output_dir=out, solve=solver)) == 3
    printed = capsys.readouterr()
    assert printed.err.startswith("failed: ")
    assert len(printed.err.strip().splitlines()) == 1
    assert "ns-train" not in printed.out
    told = json.loads((out / "kronc.json").read_text())
    assert told["status"] == "failed"
    assert html.escape(told["reason"].split(";")[0]) in (out / "report.html").read_text(encoding="utf-8")
    assert not (out / MARKER).exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"data": Path("nowhere")}, "nowhere does not exist: expected a scene folder"),
        ({"fps": 0.0}, "--fps is 0: expected a finite number above 0"),
        ({"num_frames": 2}, "--num-frames is 2: expected at least 3"),
        ({"num_downscales": -1}, "--num-downscales is -1"),
        ({"masks": Path("nowhere")}, "--masks nowhere is no folder"),
        ({"keypoints": Path("nowhere.json")}, "nowhere.json does not exist: expected our keypoints.json"),
        ({"focal_length_px": -3.0}, "focal length (-3, -3) px is not positive"),
        ({"solve": SolverOptions(config="nowhere")}, "there is no preset 'nowhere'"),
    ],
)
def test_what_the_user_can_mend_is_one_line_and_leaves_no_output(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: dict, message: str
):
    out = tmp_path / "out"
    assert _status(KroncToNerfstudio(**{"data": scene, "output_dir": out, **change})) == 2
    err = capsys.readouterr().err.strip().splitlines()
    assert len(err) == 1
    assert err[0].startswith("error: ")
    assert message in err[0]
    assert not out.exists()


def test_folders_that_are_not_ours_stay_as_they_are(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for out in (scene, scene.parent):
        assert _status(KroncToNerfstudio(data=scene, output_dir=out)) == 2
        assert "choose another output folder" in capsys.readouterr().err
    other = tmp_path / "other"
    other.mkdir()
    (other / "mine.txt").write_text("mine")
    assert _status(KroncToNerfstudio(data=scene, output_dir=other)) == 2
    assert "did not write" in capsys.readouterr().err
    assert [file.name for file in other.iterdir()] == ["mine.txt"]


def test_a_scene_folder_needs_keypoints(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (scene / "keypoints.json").unlink()
    assert _status(KroncToNerfstudio(data=scene, output_dir=tmp_path / "out", detection=FRAMES_ONLY)) == 2
    assert "has no keypoints.json: give --keypoints" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


FAKE_OPENPIFPAF = """#!{python}
import hashlib, json, sys
from pathlib import Path
answers = json.loads(Path({answers!r}).read_text())
images = [a for a in sys.argv if a.endswith(".jpg")]
Path({calls!r}).open("a").write(str(len(images)) + "\\n")
for image in images:
    answer = answers[hashlib.sha256(Path(image).read_bytes()).hexdigest()]
    Path("found", image + ".predictions.json").write_text(json.dumps(answer))
"""


def _fake_openpifpaf(folder: Path, capture: Capture, images: list[Path]) -> Path:
    """A program that takes OpenPifPaf's arguments and finds the capture's car, and a small second one."""
    ours = np.where(capture.keypoints[..., 2:] > 0, capture.keypoints - [0.5, 0.5, 0.0], 0.0)
    other = np.where(ours[..., 2:] > 0, ours * [0.1, 0.1, 1.0], 0.0)
    answers = {
        hashlib.sha256(image.read_bytes()).hexdigest(): [
            {"keypoints": car[i].flatten().tolist()} for car in (other, ours)
        ]
        for i, image in enumerate(images)
    }
    (folder / "answers.json").write_text(json.dumps(answers))
    program = folder / "openpifpaf"
    places = {"answers": str(folder / "answers.json"), "calls": str(folder / "calls")}
    program.write_text(FAKE_OPENPIFPAF.format(python=sys.executable, **places))
    program.chmod(0o755)
    return program


def test_a_detector_finds_the_keypoints(
    scene: Path,
    tmp_path: Path,
    config: SolverOptions,
    capture: Capture,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setenv("KRONC_NS_CACHE", str(tmp_path / "cache"))
    photos = [scene / f"images/IMG_{i}.jpg" for i in range(1, VIEWS + 1)]
    program, out = _fake_openpifpaf(tmp_path, capture, photos), tmp_path / "out"
    command = KroncToNerfstudio(
        data=scene / "images",
        output_dir=out,
        masks=scene / "masks",
        detection=DetectorOptions("openpifpaf", detector_python=program),
        focal_length_px=400.0,
        solve=config,
    )
    assert _status(command) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "12 of 12 frames with 4 or more" in printed
    assert "12 images show several cars" in printed
    assert np.abs(load_scene(out).keypoints - capture.keypoints).max() < 2e-3
    assert _status(command) == 0
    assert (tmp_path / "calls").read_text() == f"{VIEWS}\n"  # the second run had nothing left to detect


def test_the_builtin_detector_is_the_default(
    tmp_path: Path, config: SolverOptions, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("KRONC_NS_CACHE", str(tmp_path / "cache"))
    photos, out = tmp_path / "photos", tmp_path / "out"
    boxes = [(100.0 + 20 * i, 80.0, 500.0 + 20 * i, 290.0) for i in range(3)]
    for i, box in enumerate(boxes):
        save(photos / f"{i}.png", draw_cars((640, 360), box))
    monkeypatch.setattr(builtin, "WEIGHTS", builtin_net(tmp_path))
    status = _status(KroncToNerfstudio(data=photos, output_dir=out, focal_length_px=400.0, solve=config))
    assert status == 3  # a flat car
    assert "3 of 3 frames with 4 or more" in " ".join(capsys.readouterr().out.split())
    found = read_keypoints(out)
    assert found.sigma_px is not None
    for i, box in enumerate(boxes, start=1):
        (rows,) = found.frames[f"images/frame_{i:05d}.png"]
        assert np.abs(rows[list(POINTS), :2] - car(box)).max() < 1
        assert (found.sigma_px[f"images/frame_{i:05d}.png"][0, list(POINTS)] > 0).all()


def test_a_file_of_keypoints_keeps_the_builtin_detector_away(
    scene: Path, tmp_path: Path, config: SolverOptions, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(builtin, "WEIGHTS", tmp_path / "nowhere.onnx")
    command = KroncToNerfstudio(data=scene, output_dir=tmp_path / "out", solve=config)
    assert _status(command) == 0
    file = Path(shutil.move(scene / "keypoints.json", tmp_path / "kp.json"))
    assert _status(dataclasses.replace(command, keypoints=file)) == 0
    assert _status(dataclasses.replace(command, keypoints=file, detection=FRAMES_ONLY)) == 0
    assert _status(command) == 2  # none: now it is asked for


@pytest.mark.parametrize(
    ("detection", "message"),
    [
        (DetectorOptions("yolo-pose"), "--detector yolo-pose needs --detector-weights"),
        (DetectorOptions("onnx", Path("nowhere.onnx")), "nowhere.onnx does not exist"),
        (DetectorOptions("openpifpaf", detector_python=Path("nowhere")), "--detector-python nowhere is no program"),
        (DetectorOptions(detector_weights=Path("nowhere.onnx")), "--detector-weights and --detector-python say"),
    ],
)
def test_detectors_that_cannot_run_are_named_before_anything_is_written(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], detection: DetectorOptions, message: str
):
    out = tmp_path / "out"
    assert _status(KroncToNerfstudio(data=scene, output_dir=out, detection=detection)) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()


def test_a_segmenter_makes_the_masks(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("KRONC_NS_CACHE", str(tmp_path / "cache"))
    net, out = Net(), tmp_path / "out"
    column = net.constant(np.where(np.arange(64) < 32, 1.0, 0.0)[None, None, None])
    left = net("Add", net("Mul", net("ReduceMean", "image", axes=[1], keepdims=1), net.constant(0.0)), column)
    weights = net.save(tmp_path / "net.onnx", [1, 3, 64, 64], {"saliency": (left, [1, 1, 64, 64])})
    command = KroncToNerfstudio(data=scene, output_dir=out, segmentation=SegmenterOptions("saliency", weights))
    assert _status(command) == 0
    assert "12 of 12 frames" in capsys.readouterr().out
    for folder, width in (("masks", 480), ("masks_2", 240)):
        mask = np.array(Image.open(out / folder / "frame_00001.png"))
        assert (mask[:, : width // 2 - 8] == 255).all()
        assert (mask[:, width // 2 + 8 :] == 0).all()
    assert _status(dataclasses.replace(command, masks=scene / "masks")) == 2
    assert "and --segmenter saliency: give one of them" in capsys.readouterr().err


def test_keypoints_and_a_detector_are_one_too_many(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    detection = DetectorOptions("openpifpaf")
    command = KroncToNerfstudio(
        data=scene, output_dir=tmp_path / "out", keypoints=scene / "keypoints.json", detection=detection
    )
    assert _status(command) == 2
    assert "--detector openpifpaf: give one of them" in capsys.readouterr().err


def test_help_names_every_option(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("sys.argv", ["kronc-process-data", "--help"])
    with pytest.raises(SystemExit):
        process_data.main()
    text = capsys.readouterr().out
    for option in (
        "data",
        "output-dir",
        "keypoints",
        "masks",
        "fps",
        "num-frames",
        "focal-length-px",
        "config",
        "detector",
        "detector-weights",
    ):
        assert f"--{option} " in text
