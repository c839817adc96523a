"""Corners followed from view to view (KLT: Lucas and Kanade, IJCAI 1981; Shi and Tomasi, CVPR 1994).

On real paint they find what SIFT's blobs do not; a corner is kept where it comes back to where it started.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Int, UInt8

MOST = 1000
"""Corners of a view."""
_QUALITY, _APART_PX, _BLOCK_PX = 0.003, 5, 5
_WINDOW_PX, _LEVELS = 11, 4
_BACK_PX = 0.2
"""Where a corner that is followed there and back may end."""
_STILL_PX = 1.5
"""What moves less stands still in the image."""
_BLUR_PX = 0.7


@dataclass(frozen=True)
class Followed:
    """Corners of one view that were found in another."""

    there: Float32[np.ndarray, "k 2"]
    """The centre of the top-left pixel is (0.5, 0.5)."""
    number: Int[np.ndarray, "k"]
    """Which of the view's corners each is."""


def smoothed(grey: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """The photo that corners are followed in."""
    return cv2.GaussianBlur(grey, (0, 0), _BLUR_PX)


def find_corners(
    grey: UInt8[np.ndarray, "h w"], vehicle: UInt8[np.ndarray, "h w"] | None
) -> Float32[np.ndarray, "k 2"]:
    """Corners on the vehicle (everywhere, where nobody says where it is); whole numbers at the pixels' centres."""
    inside = None if vehicle is None else cv2.erode(vehicle, np.ones((5, 5), np.uint8))
    found = cv2.goodFeaturesToTrack(grey, MOST, _QUALITY, _APART_PX, mask=inside, blockSize=_BLOCK_PX)
    return np.empty((0, 2), np.float32) if found is None else found[:, 0]


def follow(
    corners: Float32[np.ndarray, "k 2"], grey: UInt8[np.ndarray, "h w"], others: Sequence[UInt8[np.ndarray, "_ _"]]
) -> list[Followed]:
    """Corners of a view in each of the others (of its size)."""
    return [_follow(corners, grey, other) for other in others]


def _follow(
    corners: Float32[np.ndarray, "k 2"], grey: UInt8[np.ndarray, "h w"], other: UInt8[np.ndarray, "_ _"]
) -> Followed:
    if not len(corners) or grey.shape != other.shape:
        return Followed(np.empty((0, 2), np.float32), np.empty(0, int))
    window = (_WINDOW_PX, _WINDOW_PX)
    until = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 30, 0.005)
    start = corners[:, None]
    options = {"winSize": window, "maxLevel": _LEVELS, "criteria": until}
    there, found, _ = cv2.calcOpticalFlowPyrLK(grey, other, start, np.empty_like(start), **options)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(other, grey, there, np.empty_like(start), **options)
    same = np.linalg.norm(back - start, axis=2)[:, 0] < _BACK_PX
    moved = np.linalg.norm(there - start, axis=2)[:, 0] > _STILL_PX
    kept = np.flatnonzero((found[:, 0] > 0) & (returned[:, 0] > 0) & same & moved)
    return Followed(there[kept, 0] + 0.5, kept)
