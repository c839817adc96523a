"""Videos become sharp, upright frames, evenly spread over time; what cannot be used of them is told."""

import json
import shutil
import subprocess
import weakref
from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from kronc_ns.capture.frames import Frames, check_source, find_frames, prepare_frames
from kronc_ns.capture.selection import Candidate, Sampling, choose, motion, sharpness
from kronc_ns.capture.source import find_source
from kronc_ns.capture.tone import hlg_display, hlg_light, pq_light, tone_map
from kronc_ns.capture.video import VideoFrames
from kronc_ns.errors import KroncError

pytestmark = pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")
WIDTH, HEIGHT = 320, 192
LOSSLESS = ("-c:v", "libx264", "-qp", "0", "-preset", "ultrafast")


def scenery() -> np.ndarray:
    """A wide textured picture to pan over: red to the left, blue to the right, with hard edges."""
    random = np.random.default_rng(0)
    coarse = random.integers(0, 150, (HEIGHT // 8, 200, 3)).astype(np.uint8)
    picture = cv2.resize(coarse, (1600, HEIGHT), interpolation=cv2.INTER_NEAREST).astype(np.float32)
    picture += random.normal(0, 12, picture.shape)
    return picture


SCENERY = scenery()


def view(left: float, blur: float = 0.0) -> np.ndarray:
    """What a camera at ``left`` sees that moves on by ``blur`` pixels while its shutter is open."""
    steps = np.linspace(0, blur, max(1, round(blur)))
    shots = [cv2.warpAffine(SCENERY, np.float32([[1, 0, -left - step], [0, 1, 0]]), (WIDTH, HEIGHT)) for step in steps]
    return np.clip(np.mean(shots, axis=0), 0, 255).astype(np.uint8)


def film(path: Path, frames: list[np.ndarray], rate: int = 30, options: tuple[str, ...] = LOSSLESS) -> Path:
    """Encode RGB frames with ffmpeg."""
    height, width = frames[0].shape[:2]
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(rate), "-i", "pipe:0"]
    pixels = () if "-pix_fmt" in options else ("-pix_fmt", "yuv420p")
    command = ["ffmpeg", "-v", "error", "-y", *raw, *options, *pixels, str(path)]
    subprocess.run(command, input=b"".join(frame.tobytes() for frame in frames), check=True)
    return path


def remux(source: Path, target: Path, *options: str, before: tuple[str, ...] = ()) -> Path:
    subprocess.run(
        ["ffmpeg", "-v", "error", "-y", *before, "-i", str(source), "-c", "copy", *options, str(target)], check=True
    )
    return target


def turn(plain: Path, target: Path, angle: int) -> Path:
    """Give a video a display matrix."""
    remux(plain, target, "-map", "0", "-metadata:s:v:0", f"rotate={angle}")
    probe = subprocess.run(["ffprobe", "-v", "error", "-show_streams", str(target)], capture_output=True, text=True)
    if "rotation=" not in probe.stdout:  # ffmpeg from 7 on
        remux(plain, target, "-map", "0", before=("-display_rotation", str(angle)))
    return target


def ffmpegs_frames(video: Path, folder: Path) -> list[np.ndarray]:
    """The frames as ffmpeg's own command writes them."""
    folder.mkdir()
    subprocess.run(
        ["ffmpeg", "-v", "error", "-i", str(video), "-pix_fmt", "rgb24", str(folder / "%03d.png")], check=True
    )
    return [np.array(Image.open(file)) for file in sorted(folder.iterdir())]


def taken(video: Path, **sampling) -> tuple[list[np.ndarray], str]:
    frames = VideoFrames(video, Sampling(**sampling))
    images = [np.array(image) for image in frames]
    return images, frames.note()


def which(image: np.ndarray, originals: list[np.ndarray]) -> int:
    """Index of the original that an image was made from."""
    rows = image[::8].astype(np.int16)
    return int(np.argmin([np.abs(rows - original[::8]).mean() for original in originals]))


def prepare(video: Path, out: Path, sampling: Sampling | None = None, progress=None) -> Frames:
    out.mkdir(exist_ok=True)
    source = find_source(video)
    check_source(source)
    return find_frames(source, out, sampling) or prepare_frames(source, out, sampling, progress=progress)


def test_of_each_span_of_time_the_sharp_frame_is_taken(tmp_path: Path):
    random = np.random.default_rng(1)
    sharp = [6 * slot + int(random.integers(6)) for slot in range(10)]
    originals = [view(5.0 * i, 0.0 if i in sharp else random.uniform(3, 12)) for i in range(60)]
    images, note = taken(film(tmp_path / "walk.mp4", originals, 60), num_frames=10)
    assert [which(image, originals) for image in images] == sharp
    assert note == ""


def test_compression_does_not_hide_what_is_sharp(tmp_path: Path):
    sharp = [6 * slot + (2 * slot) % 6 for slot in range(10)]
    originals = [view(5.0 * i, 0.0 if i in sharp else 5.0) for i in range(60)]
    images, _ = taken(film(tmp_path / "walk.mp4", originals, 60, ("-c:v", "libx264", "-crf", "23")), num_frames=10)
    assert [which(image, originals) for image in images] == sharp


def test_a_camera_that_stands_still_is_taken_once(tmp_path: Path):
    random = np.random.default_rng(2)
    places = [0.0] * 30 + [5.0 * i for i in range(1, 31)]
    originals = [
        np.clip(view(place) + random.normal(0, 4, (HEIGHT, WIDTH, 3)), 0, 255).astype(np.uint8) for place in places
    ]
    images, note = taken(film(tmp_path / "walk.mp4", originals), num_frames=12)
    assert len(images) == 7
    indices = [which(image, originals) for image in images]
    assert indices[0] < 5
    assert [(index - 30) // 5 for index in indices[1:]] == [0, 1, 2, 3, 4, 5]
    assert note == "5 that show nothing new were left out"


def test_motion_is_measured_in_shares_of_the_image():
    start = cv2.cvtColor(cv2.GaussianBlur(view(100.0), (0, 0), 3), cv2.COLOR_RGB2GRAY)
    for shift in (0.5, 1.0, 2.0):
        moved = cv2.cvtColor(cv2.GaussianBlur(view(100.0 + shift), (0, 0), 3), cv2.COLOR_RGB2GRAY)
        assert 0.4 * shift / WIDTH < motion(start, moved) < 1.1 * shift / WIDTH
        darker = motion((0.5 * start).astype(np.uint8), (0.5 * moved).astype(np.uint8))
        assert darker == pytest.approx(motion(start, moved), rel=0.15)
    assert motion(start, start) == 0.0


def test_blur_lowers_sharpness_step_by_step():
    values = [sharpness(cv2.cvtColor(view(50.0, blur), cv2.COLOR_RGB2GRAY)) for blur in (0, 2, 4, 8)]
    assert values == sorted(values, reverse=True)
    assert values[0] > 1.5 * values[1]


def test_frames_of_a_variable_rate_are_spread_over_time(tmp_path: Path):
    originals = [view(4.0 * i) for i in range(120)]
    constant = film(tmp_path / "constant.mkv", originals, 30)
    slow = tmp_path / "variable.mkv"  # from 2 s on, every sixth frame only
    select = ["-vf", "select='lt(t,2)+not(mod(n,6))'", "-vsync", "vfr", *LOSSLESS]
    subprocess.run(["ffmpeg", "-v", "error", "-i", str(constant), *select, str(slow)], check=True)
    images, _ = taken(slow, num_frames=8)  # frames at 0 to 2 s and 2.0, 2.2, ... 3.8 s
    seconds = np.array([which(image, originals) for image in images]) / 30
    assert len(seconds) == 8
    assert np.abs(seconds - (np.arange(8) + 0.5) * 3.9 / 8).max() < 0.3
    plain, _ = taken(slow, fps=2.0)
    np.testing.assert_allclose([which(image, originals) / 30 for image in plain], np.arange(8) / 2, atol=0.1 + 1e-9)


def test_the_papers_plain_rate(tmp_path: Path):
    originals = [view(6.0 * i) for i in range(60)]
    images, _ = taken(film(tmp_path / "walk.mp4", originals, 30), fps=5.0)
    assert [which(image, originals) for image in images] == list(range(0, 60, 6))
    everything, _ = taken(tmp_path / "walk.mp4", fps=240.0)
    assert len(everything) == 60


def test_a_short_video_gives_all_its_frames(tmp_path: Path):
    originals = [view(20.0 * i) for i in range(3)]
    images, note = taken(film(tmp_path / "three.mp4", originals), num_frames=100)
    assert [which(image, originals) for image in images] == [0, 1, 2]
    assert note == ""
    with pytest.raises(KroncError, match=r"two\.mp4 gives 2 frames \(2 could be read\): expected at least 3 views"):
        taken(film(tmp_path / "two.mp4", originals[:2]))
    with pytest.raises(KroncError, match=r"gives 1 frames \(9 that show nothing new were left out\)"):
        taken(film(tmp_path / "still.mp4", originals[:1] * 10))


@pytest.mark.parametrize("angle", [90, 180, 270])
def test_frames_stand_upright(tmp_path: Path, angle: int):
    turned = turn(film(tmp_path / "plain.mp4", [view(20.0 * i) for i in range(4)]), tmp_path / "turned.mp4", angle)
    images, _ = taken(turned)
    assert images[0].shape == ((WIDTH, HEIGHT, 3) if angle != 180 else (HEIGHT, WIDTH, 3))
    for image, expected in zip(images, ffmpegs_frames(turned, tmp_path / "ffmpeg"), strict=True):
        np.testing.assert_array_equal(image, expected)


def test_a_phones_video_is_upright_in_its_colours_and_spread_over_time(tmp_path: Path):
    """HEVC of 10 bits in .MOV, held upright (a display matrix), sound first, the rate falling to a third later on."""
    encoders = subprocess.run(["ffmpeg", "-hide_banner", "-encoders"], capture_output=True, text=True, check=True)
    if " libx265 " not in encoders.stdout:
        pytest.skip("this ffmpeg has no encoder for HEVC (libx265)")
    originals = [np.ascontiguousarray(cv2.GaussianBlur(view(4.0 * i), (0, 0), 1.5)) for i in range(120)]
    constant = film(tmp_path / "constant.mkv", originals, 30)
    slower = "select='lt(t,2)+not(mod(n,3))',scale=out_color_matrix=bt709"
    hevc = ("-c:v", "libx265", "-x265-params", "log-level=error:crf=6", "-pix_fmt", "yuv420p10le", "-tag:v", "hvc1")
    sound = ("-f", "lavfi", "-i", "sine=duration=4")
    streams = ("-map", "0:a", "-map", "1:v", "-vf", slower, "-vsync", "vfr", *hevc, "-colorspace", "bt709")
    lying = tmp_path / "lying.mov"
    subprocess.run(["ffmpeg", "-v", "error", *sound, "-i", str(constant), *streams, str(lying)], check=True)
    phone = turn(lying, tmp_path / "IMG_0001.MOV", 90)
    with av.open(str(phone)) as container:
        assert container.streams[0].type == "audio"
        assert container.streams.video[0].codec_context.pix_fmt == "yuv420p10le"
    assert set(check_source(find_source(phone))) == {(HEIGHT, WIDTH)}

    quarter = (
        1
        if which(ffmpegs_frames(phone, tmp_path / "upright")[0], [np.rot90(originals[0]), np.rot90(originals[0], -1)])
        == 0
        else -1
    )
    # turned by us: ffmpeg turns 10 bits before it interpolates chroma, which is not the same
    shown = [np.rot90(frame, quarter) for frame in ffmpegs_frames(lying, tmp_path / "lying")]
    upright = [np.rot90(original, quarter) for original in originals]
    images, note = taken(phone, num_frames=8)
    assert note == ""
    seconds = np.array([which(image, upright) for image in images]) / 30
    assert np.abs(seconds - (np.arange(8) + 0.5) * 0.5).max() < 0.3
    for image in images:
        assert image.shape == (WIDTH, HEIGHT, 3)
        assert np.abs(image.astype(int) - shown[which(image, shown)]).max() <= 1
        assert np.abs(image.astype(int) - upright[which(image, upright)]).mean() < 8  # chroma of half the size
    plain, _ = taken(phone, fps=2.0)
    np.testing.assert_allclose([which(image, upright) / 30 for image in plain], np.arange(8) / 2, atol=0.1 + 1e-9)


def test_the_size_of_a_video_is_known_before_its_frames(tmp_path: Path):
    video = film(tmp_path / "walk.mp4", [view(20.0 * i) for i in range(60)])
    assert set(check_source(find_source(video))) == {(WIDTH, HEIGHT)}
    assert set(check_source(find_source(turn(video, tmp_path / "turned.mp4", 90)))) == {(HEIGHT, WIDTH)}
    assert set(check_source(find_source(turn(video, tmp_path / "head.mp4", 180)))) == {(WIDTH, HEIGHT)}


def test_a_rate_that_gives_too_few_frames_is_named_at_once(tmp_path: Path):
    video = film(tmp_path / "walk.mp4", [view(20.0 * i) for i in range(60)])
    with pytest.raises(KroncError, match=r"walk\.mp4 lasts 2\.0 s, of which --fps 0\.9 takes fewer than 3 frames"):
        check_source(find_source(video), Sampling(fps=0.9))
    check_source(find_source(video), Sampling(fps=1.5))


def test_a_video_of_nothing_but_damage_is_named_at_once(tmp_path: Path):
    video = film(tmp_path / "walk.mp4", [view(20.0 * i) for i in range(20)])
    content = bytearray(video.read_bytes())
    start, end = content.find(b"mdat") + 4, content.rfind(b"moov") - 4
    content[start:end] = bytes(end - start)
    video.write_bytes(content)
    with pytest.raises(KroncError, match=r"walk\.mp4: none of its frames \(h264\) can be decoded"):
        check_source(find_source(video))


def test_duplicates_are_taken_where_they_are_wanted(tmp_path: Path):
    video = film(tmp_path / "still.mp4", [view(0.0)] * 30)
    images, note = taken(video, num_frames=10, keep_duplicates=True)
    assert len(images) == 10
    assert note == ""


@pytest.mark.parametrize(
    "options",
    [
        ("-vf", "scale=out_color_matrix=bt709", "-colorspace", "bt709", "-pix_fmt", "yuv420p"),
        ("-vf", "scale=out_color_matrix=bt709:out_range=pc", "-colorspace", "bt709", "-pix_fmt", "yuvj420p"),
        ("-pix_fmt", "yuv420p10le"),
        ("-pix_fmt", "yuv444p"),
    ],
    ids=["BT.709", "full range", "10 bit", "4:4:4"],
)
def test_colours_are_those_of_ffmpeg(tmp_path: Path, options: tuple[str, ...]):
    video = film(tmp_path / "walk.mp4", [view(20.0 * i) for i in range(4)], options=(*LOSSLESS, *options))
    images, _ = taken(video)
    for image, expected in zip(images, ffmpegs_frames(video, tmp_path / "ffmpeg"), strict=True):
        assert image.dtype == np.uint8
        assert np.abs(image.astype(int) - expected).max() <= 1


@pytest.mark.parametrize("transfer", ["smpte2084", "arib-std-b67"])
def test_high_dynamic_range_looks_as_it_was(tmp_path: Path, transfer: str):
    """Pictures graded as HDR by zimg, with diffuse white at 203 nits, come back as they were below the knee.

    Grey ones for HLG, whose system gamma ffmpeg's zscale applies to each channel instead of the luminance.
    """
    filters = subprocess.run(["ffmpeg", "-hide_banner", "-filters"], capture_output=True, text=True, check=True)
    if " zscale " not in filters.stdout:
        pytest.skip("this ffmpeg has no zscale filter")
    originals = [cv2.GaussianBlur(view(40.0 * i), (0, 0), 4) for i in range(3)]
    if transfer == "arib-std-b67":
        originals = [np.repeat(original[..., 1:2], 3, axis=2) for original in originals]
    grade = (
        "format=gbrpf32le,setparams=color_primaries=bt709:color_trc=iec61966-2-1:colorspace=gbr:range=pc,"
        f"zscale=t=linear:npl=203,zscale=t={transfer}:p=2020:m=2020_ncl:r=tv:npl=203,format=yuv444p10le"
    )
    tags = f"log-level=error:lossless=1:colorprim=bt2020:transfer={transfer}:colormatrix=bt2020nc"
    options = ("-vf", grade, "-c:v", "libx265", "-x265-params", tags, "-pix_fmt", "yuv444p10le")
    images, _ = taken(film(tmp_path / "hdr.mp4", originals, options=options))
    for image, original in zip(images, originals, strict=True):
        difference = image.astype(int) - original
        assert abs(np.median(difference)) <= 1
        assert np.percentile(np.abs(difference), 95) <= 3


def test_tone_mapping_keeps_greys_and_order():
    light = np.concatenate([np.linspace(0, 1, 200), np.geomspace(1, 1000 / 203, 100)]).astype(np.float32)
    grey = tone_map(np.repeat(light[None, :, None], 3, axis=2))[0]
    assert np.ptp(grey.astype(int), axis=1).max() <= 1
    assert (np.diff(grey[:, 0].astype(int)) >= 0).all()
    assert grey[0, 0] == 0
    assert grey[-1, 0] == 255
    assert abs(int(grey[np.searchsorted(light, 0.2140), 0]) - 128) <= 1  # sRGB's middle
    assert 235 <= grey[199, 0] <= 248  # diffuse white, with room for highlights above


def test_transfer_functions_meet_their_standards():
    assert pq_light(np.array([0.0, 0.5081, 1.0])) * 203 == pytest.approx([0, 100, 10_000], rel=2e-3)
    assert hlg_light(np.array([0.0, 0.5, 1.0])) == pytest.approx([0, 1 / 12, 1], abs=1e-4)
    white = hlg_display(np.full((1, 1, 3), hlg_light(np.array([0.75]))[0], dtype=np.float32))
    np.testing.assert_allclose(white, 1.0, rtol=5e-3)  # 75 % signal is diffuse white (BT.2408)


def damaged(video: Path, target: Path, how: str) -> Path:
    content = bytearray(video.read_bytes())
    start = int(0.6 * len(content))
    index = content.rfind(b"moov") - 4
    end = index if index > start else len(content)
    if how == "cut":
        content = content[:start]
    else:
        content[start:end] = bytes(end - start)
    target.write_bytes(content)
    return target


@pytest.mark.parametrize(
    ("how", "message"), [("cut", "the file ends after"), ("zeroed", "frames are damaged and were left out")]
)
@pytest.mark.parametrize("codec", ["libx264", "libx265"])
def test_of_a_damaged_video_the_whole_part_is_used(tmp_path: Path, how: str, message: str, codec: str):
    quiet = ("-x265-params", "log-level=error") if codec == "libx265" else ()
    options = ("-c:v", codec, *quiet, "-crf", "12", "-g", "15", "-movflags", "+faststart")
    video = film(tmp_path / "walk.mp4", [view(5.0 * i) for i in range(60)], options=options)
    whole, _ = taken(video, fps=30.0)
    assert len(whole) == 60
    images, note = taken(damaged(video, tmp_path / "damaged.mp4", how), num_frames=20)
    assert message in note
    assert 5 <= len(images) < 20 if how == "zeroed" else len(images) >= 16
    indices = [which(image, whole) for image in images]
    for image, index in zip(images, indices, strict=True):
        np.testing.assert_array_equal(image, whole[index])  # none has parts that are made up
    assert indices == sorted(set(indices))
    assert 24 < indices[-1] < 50


def test_what_is_no_video_is_named(tmp_path: Path):
    video = film(tmp_path / "walk.mp4", [view(20.0 * i) for i in range(4)])
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(video.read_bytes()[:200])
    with pytest.raises(KroncError, match=r"broken\.mp4 is no video that .* can read \(.+\): expected a video"):
        check_source(find_source(broken))
    sound = tmp_path / "sound.wav"
    subprocess.run(["ffmpeg", "-v", "error", "-f", "lavfi", "-i", "sine=duration=0.1", str(sound)], check=True)
    with pytest.raises(KroncError, match="no video stream"):
        check_source(find_source(sound))


@pytest.mark.parametrize(
    ("options", "message"), [({"num_frames": 2}, "--num-frames is 2"), ({"fps": 0.0}, "--fps is 0")]
)
def test_samplings_that_cannot_be_are_named(options: dict, message: str):
    with pytest.raises(KroncError, match=message):
        Sampling(**options)


def test_few_frames_are_held_at_a_time():
    class Content:
        pass

    living: weakref.WeakSet[Content] = weakref.WeakSet()
    most = 0

    def candidates() -> Iterator[Candidate[Content]]:
        nonlocal most
        random = np.random.default_rng(0)
        for i in range(200):
            content = Content()
            living.add(content)
            most = max(most, len(living))
            yield Candidate(content, i // 20, random.integers(0, 255, (30, 40), dtype=np.uint8))
            del content

    assert sum(1 for _ in choose(candidates(), Sampling(10))) == 10
    assert most <= 4


def test_frames_lie_in_nerfstudios_layout_and_are_reused(tmp_path: Path):
    originals = [view(5.0 * i) for i in range(60)]
    video = film(tmp_path / "Größe 100%: walk.mp4", originals)
    steps: list[tuple[int, int]] = []
    out = tmp_path / "out"
    frames = prepare(video, out, Sampling(10), lambda step, steps_, _: steps.append((step, steps_)))
    assert frames.names == tuple(f"images/frame_{number:05d}.png" for number in range(1, 11))
    assert frames.source_names == frames.names
    assert steps[-1] == (60, 60)
    with Image.open(out / frames.names[-1]) as image:
        assert image.mode == "RGB"
        assert image.size == frames.size == (WIDTH, HEIGHT)
    assert prepare(video, out, Sampling(10)).reused
    again = prepare(video, out, Sampling(5))
    assert not again.reused
    assert len(list((out / "images").iterdir())) == 5
    record = json.loads((out / ".kronc-frames.json").read_text())
    assert record["note"] == ""
