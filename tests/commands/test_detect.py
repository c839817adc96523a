"""`kronc detect`: photos and videos in, keypoints.json and pictures out."""

import json
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import ExifTags, Image

from kronc_ns.files.keypoints import read_keypoints
from kronc_ns.files.output import MARKER
from tests.capture.detection.builtin_net import POINTS, builtin_net, car, draw_cars
from tests.capture.detection.dots import save
from tests.commands.conftest import contents

SIZE = (640, 360)
BOXES = [(100.0 + 20 * i, 80.0, 500.0 + 20 * i, 290.0) for i in range(4)]


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return builtin_net(tmp_path_factory.mktemp("weights"))


@pytest.fixture
def detect(kronc, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Run `kronc detect ARGUMENTS` with the builtin detector on a network that knows our cars."""
    monkeypatch.setenv("KRONC_NS_CACHE", str(tmp_path / "cache"))
    return lambda *arguments: kronc("detect", *arguments, "--detector", "builtin", "--detector-weights", weights)


def check(file: Path, name: str, uv: np.ndarray) -> None:
    found = read_keypoints(file)
    (rows,) = found.frames[name]
    assert np.flatnonzero(rows[:, 2]).tolist() == list(POINTS)
    assert np.abs(rows[list(POINTS), :2] - uv).max() < 1
    assert found.sigma_px is not None
    (sigma,) = found.sigma_px[name]
    assert ((sigma > 0) == (rows[:, 2] > 0)).all()


def test_photos(detect, tmp_path: Path):
    photos, out = tmp_path / "photos", tmp_path / "out"
    for i, box in enumerate(BOXES):
        save(photos / f"IMG_{i}.png", draw_cars(SIZE, box))
    before = contents(photos)
    result = detect("--data", photos, "--output-dir", out, "--pictures")
    assert (result.status, result.err) == (0, "")
    assert "4 of 4 images show the car, 13.0 points each" in result.out
    for i, box in enumerate(BOXES):
        check(out / "keypoints.json", f"IMG_{i}.png", car(box))
    assert read_keypoints(out).size == SIZE
    assert sorted(path.name for path in (out / "pictures").iterdir()) == [f"IMG_{i}.png.jpg" for i in range(4)]
    with Image.open(out / "pictures/IMG_0.png.jpg") as marked:
        assert marked.size == SIZE
        assert np.abs(np.array(marked).astype(int) - draw_cars(SIZE, BOXES[0])).max() > 100
    assert contents(photos) == before
    assert not (out / MARKER).exists()
    assert detect("--data", photos, "--output-dir", out).refused("already holds")


def test_photos_of_equal_names_in_subfolders_have_a_picture_each(detect, tmp_path: Path):
    for folder, box in zip(("near", "far"), BOXES, strict=False):
        save(tmp_path / "photos" / folder / "a.png", draw_cars(SIZE, box))
    out = tmp_path / "out"
    assert detect("--data", tmp_path / "photos", "--output-dir", out, "--pictures").status == 0
    drawn = {str(path.relative_to(out)) for path in (out / "pictures").rglob("*.jpg")}
    assert drawn == {"pictures/near/a.png.jpg", "pictures/far/a.png.jpg"}


def test_no_photo_is_drawn_over_wherever_a_scene_folder_says_that_it_is(detect, tmp_path: Path):
    scene, out = tmp_path / "scene", tmp_path / "out"
    near, far = tmp_path / "photos/a.jpg", tmp_path / "elsewhere/b.jpg"
    for photo in (near, far):
        save(photo, draw_cars(SIZE, BOXES[0]))
    width, height = SIZE
    lens = {"fl_x": 500.0, "fl_y": 500.0, "cx": width / 2, "cy": height / 2, "w": width, "h": height}
    frames = [{"file_path": "../photos/a.jpg"}, {"file_path": str(far)}]
    scene.mkdir()
    (scene / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    before = contents(tmp_path)
    assert detect("--data", scene, "--output-dir", out, "--pictures").status == 0
    assert {path: made for path, made in contents(tmp_path).items() if path in before} == before
    assert len([*(out / "pictures").rglob("*.jpg")]) == 2


def test_one_photo_turned_by_its_exif(detect, tmp_path: Path):
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    turned = Image.fromarray(draw_cars(SIZE, BOXES[0])).transpose(Image.Transpose.ROTATE_90)
    turned.save(tmp_path / "a.png", exif=exif)
    assert detect("--data", tmp_path / "a.png", "--output-dir", tmp_path / "out").status == 0
    check(tmp_path / "out/keypoints.json", "a.png", car(BOXES[0]))  # in the pixels that ns-process-data makes
    assert read_keypoints(tmp_path / "out").size == SIZE


def test_photos_of_several_sizes_have_none_in_common(detect, tmp_path: Path):
    save(tmp_path / "photos/a.png", draw_cars(SIZE, BOXES[0]))
    save(tmp_path / "photos/b.png", draw_cars((500, 400), (50.0, 90.0, 450.0, 300.0)))
    assert detect("--data", tmp_path / "photos", "--output-dir", tmp_path / "out").status == 0
    assert read_keypoints(tmp_path / "out").size is None
    check(tmp_path / "out/keypoints.json", "b.png", car((50.0, 90.0, 450.0, 300.0)))


def test_a_video_gives_its_frames_too(detect, tmp_path: Path):
    video, out = tmp_path / "walk.mp4", tmp_path / "out"
    with av.open(str(video), "w") as container:
        stream = container.add_stream("libx264", rate=5, options={"crf": "1"})
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv444p"
        for box in BOXES:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(draw_cars(SIZE, box), format="rgb24")))
        container.mux(stream.encode())
    result = detect("--data", video, "--output-dir", out, "--num-frames", 4)
    assert result.status == 0, result.err
    names = [frame["file_path"] for frame in json.loads((out / "keypoints.json").read_text())["frames"]]
    assert names == [f"images/frame_{i:05d}.png" for i in range(1, 5)]
    assert all((out / name).is_file() for name in names)
    found = read_keypoints(out)
    for name, box in zip(names, BOXES, strict=True):
        (rows,) = found.frames[name]
        assert np.abs(rows[list(POINTS), :2] - car(box))[rows[list(POINTS), 2] > 0].max() < 3


def test_no_car_ends_with_3(detect, tmp_path: Path):
    for i in range(2):
        save(tmp_path / f"photos/{i}.png", draw_cars(SIZE))
    result = detect("--data", tmp_path / "photos", "--output-dir", tmp_path / "out")
    assert result.status == 3
    assert result.err.startswith("no car was found in any of the 2 images")
    assert (tmp_path / "out/keypoints.json").exists()


def test_what_the_user_can_mend(detect, kronc, tmp_path: Path):
    out = ("--output-dir", tmp_path / "out")
    turned = np.ascontiguousarray(np.rot90(draw_cars(SIZE, BOXES[0])))
    save(tmp_path / "turned/a.png", turned)
    assert detect("--data", tmp_path / "turned", *out).refused("the car lies on its side", "90 degrees clockwise")
    assert kronc("detect", "--data", tmp_path / "turned", *out, "--detector", "none").refused("finds nothing")
    assert detect("--data", tmp_path / "nowhere", *out).refused("nowhere does not exist")
    (tmp_path / "turned/b.png").write_text("text")
    assert detect("--data", tmp_path / "turned", *out).refused("b.png is no image that can be read")
