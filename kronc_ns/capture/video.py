"""Frames of a video, decoded one after the other by PyAV (ffmpeg's libraries) and turned upright."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.error import EOFError as EndOfFile
from av.error import FFmpegError
from jaxtyping import UInt8
from PIL import Image

from kronc_ns.capture.progress import Count
from kronc_ns.capture.selection import Candidate, Sampling, choose
from kronc_ns.capture.source import MIN_FRAMES
from kronc_ns.capture.tone import srgb
from kronc_ns.errors import KroncError

_GREY_LONG_SIDE = 960  # px of the copies on which frames are compared
_THREADS = 4  # of the decoder: each holds frames
_CUT_S = 0.5  # a file that ends earlier than it says, by more than this, was cut off


@dataclass(frozen=True)
class Timeline:
    """When a video shows its frames, from the packets of the file alone."""

    first: int
    """Presentation time of the first frame, in units."""
    span: int
    """From there to the end of the last frame."""
    count: int
    unit: Fraction
    """Seconds."""
    timed: bool
    """Frames say their time; otherwise they are counted."""
    promised_s: float
    """Duration that the file gives itself; 0: none."""

    def slot(self, time: int, sampling: Sampling) -> int:
        """The slot in which a frame shown at ``time`` competes."""
        since = max(0, time - self.first)
        if sampling.fps is not None:
            return int(since * self.unit * Fraction(sampling.fps).limit_denominator(1000))
        return since if self.count <= sampling.num_frames else since * sampling.num_frames // self.span


class VideoFrames:
    """The frames of a video that are taken, decoded while iterating over them, once."""

    def __init__(self, video: Path, sampling: Sampling, progress: Count | None = None) -> None:
        self._video, self._sampling, self._progress = video, sampling, progress
        self._timeline = read_timeline(video)
        self._decoded = self._damaged = self._slots = self._taken = 0

    def __iter__(self) -> Iterator[Image.Image]:
        """Upright images in order, 8 bits a channel, sRGB."""
        with _opened(self._video) as container:
            for chosen in choose(self._candidates(container), self._sampling):
                self._taken += 1
                transfer = container.streams.video[0].codec_context.color_trc
                yield Image.fromarray(_upright(chosen.content, transfer))
        if self._taken < MIN_FRAMES:
            raise KroncError(
                f"{self._video} gives {self._taken} frames ({self.note() or f'{self._decoded} could be read'}): "
                f"expected at least {MIN_FRAMES} views of the car; check the file, or raise --fps where it was given"
            )

    def note(self) -> str:
        """What was left out and why; known when the iteration has ended."""
        ended_s = float(self._timeline.span * self._timeline.unit)
        notes = []
        if self._timeline.promised_s - ended_s > _CUT_S:
            notes.append(f"the file ends after {ended_s:.1f} of {self._timeline.promised_s:.1f} s")
        if self._damaged:
            notes.append(f"{self._damaged} of {self._timeline.count} frames are damaged and were left out")
        if self._slots > self._taken:
            notes.append(f"{self._slots - self._taken} that show nothing new were left out")
        return "; ".join(notes)

    def _candidates(self, container: InputContainer) -> Iterator[Candidate[av.VideoFrame]]:
        last, whole = -1, True
        for frame in _decode(container):
            # damage spreads until a frame that refers to no other
            whole = frame is not None and not frame.is_corrupt and (whole or frame.key_frame)
            if frame is None or not whole:
                self._damaged += 1
                continue
            time = frame.pts if self._timeline.timed and frame.pts is not None else self._decoded
            slot = max(last, self._timeline.slot(time, self._sampling))
            self._decoded += 1
            self._slots += slot != last
            last = slot
            if self._progress is not None:
                self._progress(self._decoded, max(self._decoded, self._timeline.count), None)
            yield Candidate(frame, slot, _grey(frame))


def probe_video(video: Path, sampling: Sampling) -> tuple[int, int]:
    """(width, height) of the upright frames, from the first one that can be decoded.

    Raises `KroncError` where there is none, or the video is too short for ``sampling``.
    """
    with _opened(video) as container:
        stream = container.streams.video[0]
        promised_s = _promised_s(container)
        if sampling.fps is not None and promised_s and promised_s * sampling.fps < MIN_FRAMES - 1:
            raise KroncError(
                f"{video} lasts {promised_s:.1f} s, of which --fps {sampling.fps:g} takes fewer than {MIN_FRAMES} "
                f"frames: expected at least {MIN_FRAMES} views of the car; raise --fps, or leave it out"
            )
        frame = next((frame for frame in _decode(container) if frame is not None), None)
        if frame is None:
            codec = stream.codec_context.name
            raise KroncError(f"{video}: none of its frames ({codec}) can be decoded: expected a video that plays")
        turned = round(frame.rotation / 90) % 2
        return (frame.height, frame.width) if turned else (frame.width, frame.height)


def read_timeline(video: Path) -> Timeline:
    """Look at every packet without decoding any."""
    with _opened(video) as container:
        stream = container.streams.video[0]
        times: list[int | None] = []
        with suppress(FFmpegError):  # what comes before can be used
            for packet in container.demux(stream):
                if packet.size and not packet.is_discard:
                    times.append(packet.pts)
        promised_s = _promised_s(container)
        known = sorted(time for time in times if time is not None)
        timed = len(known) == len(times) > 1 and known[-1] > known[0] and stream.time_base is not None
        if not timed:
            rate = stream.average_rate or stream.base_rate or Fraction(30)
            return Timeline(0, max(1, len(times)), len(times), 1 / rate, False, promised_s)
        span = known[-1] - known[0]
        step = max(1, round(span / (len(known) - 1)))
        return Timeline(known[0], span + step, len(known), Fraction(stream.time_base or 1), True, promised_s)


def _promised_s(container: InputContainer) -> float:
    stream = container.streams.video[0]
    return float((stream.duration or 0) * (stream.time_base or 0)) or (container.duration or 0) / av.time_base


@contextmanager
def _opened(video: Path) -> Iterator[InputContainer]:
    reason = "no video stream"
    try:
        with av.open(f"file:{video.resolve()}") as container:
            if container.streams.video and container.streams.video[0].codec_context is not None:
                yield container
                return
    except FFmpegError as error:
        reason = error.strerror or str(error)
    raise KroncError(
        f"{video} is no video that ffmpeg's libraries can read ({reason}): "
        "expected a video file, a folder of photos or a scene folder"
    )


def _decode(container: InputContainer) -> Iterator[av.VideoFrame | None]:
    """Frames in the order in which they are shown; None for each packet that cannot be decoded."""
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    stream.codec_context.thread_count = _THREADS
    stream.codec_context.options = {"err_detect": "explode"}  # no frames with made-up parts
    packets = container.demux(stream)
    while True:
        try:
            packet = next(packets, None)
        except FFmpegError:
            packet = None  # the file is cut off; the timeline tells
        if packet is None:
            return
        try:
            yield from packet.decode()
        except EndOfFile:
            return
        except FFmpegError:
            yield None


def _grey(frame: av.VideoFrame) -> UInt8[np.ndarray, "h w"]:
    factor = min(1.0, _GREY_LONG_SIDE / max(frame.width, frame.height))
    width, height = (max(1, round(side * factor)) for side in (frame.width, frame.height))
    return frame.reformat(width, height, "gray", interpolation="AREA").to_ndarray()


def _upright(frame: av.VideoFrame, transfer: int | None) -> UInt8[np.ndarray, "h w 3"]:
    return np.ascontiguousarray(np.rot90(srgb(frame, transfer), round(frame.rotation / 90)))
