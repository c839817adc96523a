"""Folders of photos as phones leave them: Live Photos, bursts, copies, subfolders."""

import json
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from kronc_ns.capture.duplicates import without_duplicates
from kronc_ns.capture.frames import check_source, find_frames, prepare_frames
from kronc_ns.capture.matching import match_frames
from kronc_ns.capture.selection import Sampling
from kronc_ns.capture.sidecars import copy_reference
from kronc_ns.capture.source import Source, find_source
from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import Detections
from kronc_ns.geometry.camera import Camera
from kronc_ns.keypoints.schema import APOLLOCAR3D_66

WIDTH, HEIGHT = 640, 480
_COARSE = np.random.default_rng(0).integers(0, 255, (48, 320, 3), dtype=np.uint8)
SCENERY = cv2.GaussianBlur(cv2.resize(_COARSE, (3200, HEIGHT), interpolation=cv2.INTER_NEAREST), (0, 0), 1.5)


def view(left: float, blur: float = 0.0, noise: int = 0) -> np.ndarray:
    """What a camera at ``left`` sees, out of focus by ``blur`` px."""
    seen = cv2.warpAffine(SCENERY, np.float32([[1, 0, -left], [0, 1, 0]]), (WIDTH, HEIGHT))
    if blur:
        seen = cv2.GaussianBlur(seen, (0, 0), blur)
    grain = np.random.default_rng(noise).normal(0, 2, seen.shape)
    return np.clip(seen + grain, 0, 255).astype(np.uint8)


def shoot(path: Path, left: float, blur: float = 0.0, noise: int = 0, **options) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    options = {"quality": 92, **options} if path.suffix.lower() in (".jpg", ".jpeg") else options
    Image.fromarray(view(left, blur, noise)).save(path, **options)
    return path


def clip(path: Path) -> Path:
    """A second of video, as beside a Live Photo."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=15)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        for i in range(15):
            frame = av.VideoFrame.from_ndarray(cv2.resize(view(5.0 * i), (160, 120)), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def looked_at(folder: Path) -> Source:
    source = find_source(folder)
    return without_duplicates(source, check_source(source)[0])


def test_of_live_photos_the_photos_are_taken_and_that_is_said(tmp_path: Path):
    for i in range(4):
        shoot(tmp_path / f"IMG_120{i}.JPG", 60.0 * i)
        clip(tmp_path / f"IMG_120{i}.MOV")
    source = looked_at(tmp_path)
    assert source.names == ("IMG_1200.JPG", "IMG_1201.JPG", "IMG_1202.JPG", "IMG_1203.JPG")
    assert source.note == "the videos of 4 Live Photos were left out"
    clip(tmp_path / "walk.mp4")
    note = find_source(tmp_path).note
    assert note.endswith("; walk.mp4 beside the photos left out (give a video itself as --data)")
    out = tmp_path / "out"
    out.mkdir()
    assert prepare_frames(source, out).note == source.note


def test_live_photos_in_heif(tmp_path: Path):
    heif = pytest.importorskip("pillow_heif")
    for i in range(3):
        heif.from_pillow(Image.fromarray(view(60.0 * i))).save(tmp_path / f"IMG_{i}.HEIC", quality=90)
        clip(tmp_path / f"img_{i}.mov")
    source = looked_at(tmp_path)
    assert source.names == ("IMG_0.HEIC", "IMG_1.HEIC", "IMG_2.HEIC")
    assert source.note == "the videos of 3 Live Photos were left out"
    # the same photos exported for other programs
    for i in range(3):
        shoot(tmp_path / f"IMG_{i}.JPG", 60.0 * i)
    both = looked_at(tmp_path)
    assert len(both.images) == 3
    assert [Path(name).stem for name in both.names] == ["IMG_0", "IMG_1", "IMG_2"]
    assert both.note.startswith("3 that show nothing new were left out (IMG_0.")


def test_of_a_burst_the_sharpest_is_taken_and_that_is_said(tmp_path: Path):
    places = [0, 60, 60, 60, 60, 120, 180]
    blurs = [0, 1.5, 0.8, 0, 2.0, 0, 0]
    for i, (place, blur) in enumerate(zip(places, blurs, strict=True)):
        shoot(tmp_path / f"IMG_{i}.jpg", place, blur, noise=i)
    source = looked_at(tmp_path)
    assert source.names == ("IMG_0.jpg", "IMG_3.jpg", "IMG_5.jpg", "IMG_6.jpg")
    assert [path.name for path in source.left_out] == ["IMG_1.jpg", "IMG_2.jpg", "IMG_4.jpg"]
    assert source.note == (
        "3 that show nothing new were left out (IMG_1.jpg, IMG_2.jpg, IMG_4.jpg; --keep-duplicates takes them)"
    )


def test_copies_and_turned_copies_are_left_out(tmp_path: Path):
    for i in range(3):
        shoot(tmp_path / f"IMG_{i}.png", 60.0 * i)
    (tmp_path / "IMG_1 (1).png").write_bytes((tmp_path / "IMG_1.png").read_bytes())
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    stored = np.rot90(view(120.0))  # a quarter to the left; shown, it is turned back
    Image.fromarray(np.ascontiguousarray(stored)).save(tmp_path / "IMG_2a.png", exif=exif)
    source = looked_at(tmp_path)
    assert len(source.images) == 3
    assert len(source.left_out) == 2


def test_what_moves_a_little_in_a_still_room_is_kept(tmp_path: Path):
    """A car on a turntable, of which every photo shows a fifth."""
    for i in range(6):
        pixels = view(0.0, noise=i)
        pixels[200:330, 240:400] = view(500.0 + 2.0 * i)[200:330, 240:400]
        Image.fromarray(pixels).save(tmp_path / f"{i}.png")
    assert len(looked_at(tmp_path).images) == 6


def test_slow_motion_is_thinned_not_lost(tmp_path: Path):
    """Steps that are too small one by one, but add up."""
    for i in range(12):
        shoot(tmp_path / f"{i:02d}.png", 0.3 * i)
    taken = [int(Path(name).stem) for name in looked_at(tmp_path).names]
    assert 3 <= len(taken) < 12
    assert np.diff(taken).max() <= 8


def test_too_few_different_photos_are_named_before_anything_is_written(tmp_path: Path):
    for i in range(5):
        shoot(tmp_path / f"{i}.jpg", 60.0 * (i == 4), noise=i)
    with pytest.raises(KroncError, match=r"holds 2 different photos \(3 show nothing new\).*--keep-duplicates"):
        looked_at(tmp_path)


def test_photos_that_cannot_be_read_are_named_while_comparing(tmp_path: Path):
    for i in range(4):
        shoot(tmp_path / f"{i}.jpg", 60.0 * i)
    whole = (tmp_path / "2.jpg").read_bytes()
    (tmp_path / "2.jpg").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(KroncError, match=r"2\.jpg is no image that can be read .*truncated"):
        looked_at(tmp_path)


def test_frames_are_known_again_with_and_without_duplicates(tmp_path: Path):
    photos, out = tmp_path / "photos", tmp_path / "out"
    out.mkdir()
    for i in range(5):
        shoot(photos / f"IMG_{i}.jpg", 60.0 * min(i, 3))
    source = looked_at(photos)
    frames = prepare_frames(source, out)
    assert frames.source_names == source.names
    again = find_frames(find_source(photos), out)
    assert again is not None
    assert (again.names, again.source_names, again.note) == (frames.names, frames.source_names, source.note)
    (photos / "reference.json").write_text(json.dumps({"frames": [{"file_path": f"IMG_{i}.jpg"} for i in range(5)]}))
    copy_reference(find_source(photos), again, out)
    copied = json.loads((out / "reference.json").read_text())["frames"]
    assert copied == [{"file_path": name} for name in frames.names]
    assert find_frames(find_source(photos), out, Sampling(keep_duplicates=True)) is None
    assert len(prepare_frames(find_source(photos), out, Sampling(keep_duplicates=True)).names) == 5


def test_keypoints_of_photos_that_were_left_out_are_not_missed(tmp_path: Path):
    photos, out = tmp_path / "photos", tmp_path / "out"
    out.mkdir()
    for i in range(5):
        shoot(photos / f"IMG_{i}.jpg", 60.0 * max(i, 1))
    every_name = find_source(photos).names
    frames = prepare_frames(looked_at(photos), out)
    assert len(frames.names) == 4
    rows = np.zeros((5, 1, 66, 3))
    rows[..., :10, :] = 1.0
    rows[..., 0] *= np.arange(5)[:, None, None]
    camera = Camera(500.0, 500.0, 320.0, 240.0, WIDTH, HEIGHT)
    left = (*every_name,).index(next(name for name in every_name if name not in frames.source_names))
    of_photos = Detections(photos, APOLLOCAR3D_66, dict(zip(every_name, rows, strict=True)))
    matched = match_frames(of_photos, every_name, frames, camera)
    assert matched.rows[:, 0, 0].tolist() == [i for i in range(5) if i != left]
    of_frames = Detections(photos, APOLLOCAR3D_66, dict(zip(frames.names, rows, strict=False)))
    assert match_frames(of_frames, every_name, frames, camera).rows[:, 0, 0].tolist() == [0, 1, 2, 3]
    strange = Detections(photos, APOLLOCAR3D_66, {**of_photos.frames, "IMG_77.jpg": rows[0]})
    with pytest.raises(KroncError, match=r"images that do not exist"):
        match_frames(strange, every_name, frames, camera)


@pytest.mark.parametrize("inside", ["", "images"])
def test_photos_of_several_rounds_in_subfolders(tmp_path: Path, inside: str):
    for i in range(3):
        for j, name in enumerate(("low", "high")):
            shoot(tmp_path / inside / name / f"IMG_{i + 9}.jpg", 60.0 * i + 200 * j)
    shoot(tmp_path / inside / "masks" / "low" / "IMG_9.png", 0)
    source = looked_at(tmp_path)
    assert source.names == tuple(f"{name}/IMG_{i}.jpg" for name in ("high", "low") for i in (9, 10, 11))
    assert source.note == "of the subfolders high, low"
    out = tmp_path.with_name(tmp_path.name + "_out")
    out.mkdir()
    assert prepare_frames(source, out).names == tuple(f"images/frame_{i:05d}.jpg" for i in range(1, 7))


def test_several_captures_are_not_one(tmp_path: Path):
    for name in ("first", "second"):
        shoot(tmp_path / name / "images" / "0.jpg", 0)
        (tmp_path / name / "transforms.json").write_text("{}")
    with pytest.raises(KroncError, match=r"holds several captures .*expected one; give its folder, .*first"):
        find_source(tmp_path)
