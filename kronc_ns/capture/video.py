"""Frames of a video by ffmpeg, which turns them upright as the video's rotation says."""

import json
import shutil
import subprocess
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from kronc_ns.capture.source import MIN_FRAMES, Count, natural_key
from kronc_ns.errors import KroncError

PATTERN = "frame_%05d.png"
"""Names of extracted frames, counted from 1."""


@dataclass(frozen=True)
class VideoInfo:
    """What the container says."""

    rate: float
    """Frames per second."""
    duration_s: float | None


def probe_video(video: Path) -> VideoInfo:
    """Rate and duration of the first video stream; raises `KroncError` where there is none."""
    wanted = "stream=avg_frame_rate,r_frame_rate,duration:format=duration"
    command = [_tool("ffprobe"), "-v", "error", "-select_streams", "v:0", "-show_entries", wanted, "-of", "json"]
    done = subprocess.run([*command, _url(video)], capture_output=True, text=True, errors="replace", check=False)
    try:
        content = json.loads(done.stdout)
    except json.JSONDecodeError:
        content = {}
    if done.returncode or not content.get("streams"):
        raise KroncError(
            f"{video} is no video that ffmpeg can read ({_last_line(done.stderr, video) or 'no video stream'}): "
            "expected a video file, a folder of photos or a scene folder"
        )
    stream = content["streams"][0]
    rate = _rate(stream.get("avg_frame_rate")) or _rate(stream.get("r_frame_rate"))
    durations = (_seconds(part.get("duration")) for part in (stream, content.get("format", {})))
    duration = next((seconds for seconds in durations if seconds), None)
    if not rate:
        raise KroncError(f"{video} does not say its frame rate: expected a video with several frames")
    return VideoInfo(rate, duration)


def sampling_rate(video: Path, info: VideoInfo, fps: float, num_frames_target: int | None) -> float:
    """Frames per second to extract: ``fps``, or what gives the target; never more than the video has."""
    if num_frames_target is None:
        return min(fps, info.rate)
    if info.duration_s is None:
        raise KroncError(f"{video} does not say how long it is: use --fps instead of --num-frames-target")
    return min(num_frames_target / info.duration_s, info.rate)


def extract_frames(
    video: Path, folder: Path, fps: float, num_frames_target: int | None, progress: Count | None = None
) -> tuple[Path, ...]:
    """Write frames of ``video`` as PNG (8 bits a channel, upright) into ``folder`` and list them."""
    info = probe_video(video)
    rate = sampling_rate(video, info, fps, num_frames_target)
    expected = max(1, round((info.duration_s or 0) * rate))
    command = [_tool("ffmpeg"), "-nostdin", "-hide_banner", "-loglevel", "error", "-y", "-i", _url(video)]
    command += ["-map", "0:v:0", "-vf", f"fps={rate:.9g}", "-pix_fmt", "rgb24", "-progress", "pipe:1", PATTERN]
    with subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
    ) as process:
        complaints = []
        try:
            assert process.stdout is not None
            for line in process.stdout:
                key, _, value = line.strip().partition("=")
                if key == "frame" and value.strip().isdecimal() and progress is not None:
                    progress(int(value), max(expected, int(value)), None)
                elif " " in key:  # the keys of -progress are single words
                    complaints.append(line.strip())
        except BaseException:
            process.kill()
            raise
    frames = tuple(sorted(folder.glob("frame_*.png"), key=lambda file: natural_key(file.name)))
    complaint = _last_line("\n".join(complaints), video)
    if process.returncode:
        why = complaint or f"status {process.returncode}"
        raise KroncError(f"ffmpeg stopped on {video} ({why}): check the file and the space in {folder}")
    if len(frames) < MIN_FRAMES:
        why = f" ({complaint})" if complaint else ""
        raise KroncError(
            f"{video} gives {len(frames)} frames at {rate:g} frames per second{why}: expected at least {MIN_FRAMES}; "
            "raise --fps or --num-frames-target, or check the file"
        )
    return frames


def _tool(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        raise KroncError(
            f"{name} is not on PATH, and videos need it: install ffmpeg, or give a folder of frames as --data"
        )
    return path


def _url(video: Path) -> str:
    return f"file:{video.resolve()}"


def _last_line(text: str, video: Path) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1].removeprefix(f"{_url(video)}: ") if lines else ""


def _rate(text: str | None) -> float:
    try:
        return float(Fraction(text or "0"))
    except (ValueError, ZeroDivisionError):
        return 0.0


def _seconds(text: str | None) -> float | None:
    try:
        return float(text) if text else None
    except ValueError:
        return None
