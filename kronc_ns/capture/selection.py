"""Which frames of a video, and which photos, are taken: sharp ones, spread evenly over its time, none of them twice."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby
from typing import Generic, TypeVar

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from kronc_ns.capture.source import MIN_FRAMES
from kronc_ns.errors import KroncError

_STILL = 1e-3  # of the longer side: what has moved by less on average shows nothing new
_MOTION_LONG_SIDE = 320  # px, on which motion is measured
_TILES = 8  # a side; photos are compared tile by tile

Content = TypeVar("Content")


@dataclass(frozen=True)
class Sampling:
    """How many frames of a video are taken."""

    num_frames: int = 100
    """As many slots of equal time; of each the sharpest frame is taken, unless nothing has moved."""
    fps: float | None = None
    """Frames per second at equal steps, sharp or not, instead."""
    keep_duplicates: bool = False
    """Take also what shows nothing new."""

    def __post_init__(self) -> None:
        if self.num_frames < MIN_FRAMES:
            raise KroncError(f"--num-frames is {self.num_frames}: expected at least {MIN_FRAMES}")
        if self.fps is not None and not 0 < self.fps < float("inf"):
            raise KroncError(f"--fps is {self.fps:g}: expected a finite number above 0")


@dataclass(frozen=True)
class Candidate(Generic[Content]):
    """A frame that may be taken."""

    content: Content
    slot: int
    """Frames of one slot compete; slots come in order."""
    grey: UInt8[np.ndarray, "h w"]
    """Small copy, on which frames are compared."""


def choose(candidates: Iterable[Candidate[Content]], sampling: Sampling) -> Iterator[Candidate[Content]]:
    """One frame of each slot: the first, or the sharpest that shows something new.

    Holds no more than three frames at a time: the last one taken, the best of the slot and the one looked at.
    """
    last = None
    for _, group in groupby(candidates, key=lambda candidate: candidate.slot):
        if sampling.fps is not None:
            yield next(group)
            continue
        fresh = (
            frame
            for frame in group
            if last is None or sampling.keep_duplicates or motion(_shrunk(last.grey), _shrunk(frame.grey)) > _STILL
        )
        best = max(fresh, key=lambda frame: sharpness(frame.grey), default=None)
        if best is not None:
            yield best
            last = best


def distinct(photos: Iterable[UInt8[np.ndarray, "h w"]]) -> list[int]:
    """Indices of the photos that are taken, one of each row of photos in which nothing has moved: the sharpest."""
    taken: list[int] = []
    first, best = None, 0.0
    for index, grey in enumerate(photos):
        small, sharp = _shrunk(grey), sharpness(grey)
        if first is None or _anything_moved(first, small):
            first, best = small, sharp
            taken.append(index)
        elif sharp > best:
            taken[-1], best = index, sharp
    return taken


def sharpness(grey: UInt8[np.ndarray, "h w"]) -> float:
    """Variance of the Laplacian: what motion blur and wrong focus take away first."""
    return float(cv2.Laplacian(grey, cv2.CV_32F, ksize=3).var())


def motion(first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"]) -> float:
    """About how far things have moved along their gradient, as a share of the longer side.

    The mean change of brightness over the mean gradient (the equation of optical flow), so that neither contrast nor
    the size of the image matters.
    """
    change, gradient = _change_and_gradient(first, second)
    return float(change.mean() / max(gradient.mean(), 1e-3)) / max(first.shape)


def _anything_moved(first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"]) -> bool:
    """Whether there is `motion` in any tile: of a car on a turntable most of the photo stands still."""
    change, gradient = _change_and_gradient(first, second)
    tiles = (min(_TILES, change.shape[1]), min(_TILES, change.shape[0]))
    of_tiles = (cv2.resize(values, tiles, interpolation=cv2.INTER_AREA) for values in (change, gradient))
    change_there, gradient_there = of_tiles
    # where a tile is nearly plain its noise would look like motion
    moved = change_there / np.maximum(gradient_there, max(float(gradient.mean()), 1e-3))
    return bool(moved.max() > _STILL * max(first.shape))


def _change_and_gradient(
    first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    a, b = (cv2.GaussianBlur(grey, (0, 0), 1.0).astype(np.float32) for grey in (first, second))
    gradient = cv2.magnitude(cv2.Sobel(a, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(a, cv2.CV_32F, 0, 1, scale=1 / 8))
    return np.abs(b - a), gradient


def _shrunk(grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h2 w2"]:
    factor = min(1.0, _MOTION_LONG_SIDE / max(grey.shape))
    size = (max(1, round(grey.shape[1] * factor)), max(1, round(grey.shape[0] * factor)))
    return cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.uint8)
