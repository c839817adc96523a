"""All features of all views in a row, and the corners followed between neighbours."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from kronc_ns.geometry.camera import Camera
from kronc_ns.refine.corners import find_corners, follow, smoothed
from kronc_ns.refine.features import Features, find_features, under
from kronc_ns.refine.pictures import Picture, Pictures
from kronc_ns.refine.tracks import Linked
from kronc_ns.solve.threads import side_by_side

MOST_PX = 1280
"""Larger photos are made smaller: their finest detail is noise."""
_SIFT_PX, _SIFT_PX_OF_MANY, _MANY = 640, 480, 50
"""SIFT doubles photos before it looks; where features are exactly is found later, in the larger pictures. From so many
photos on there are features enough, and the finest are those least sure."""
_FEATURES, _LEAST_OF_VIEW, _MOST_OF_VIEW = 100_000, 1_500, 4_000
"""Of all views together; of each."""
_NEIGHBOURS, _NEIGHBOURS_DEG = 2, 35.0  # that corners are followed to
_CORNER_SIMILARITY, _CORNER_RATIO = 0.93, 0.5  # what a followed corner is worth beside a match of descriptors


@dataclass(frozen=True)
class Gathered:
    """Features of N views: those of SIFT view by view, then the corners."""

    first: Int[np.ndarray, "n1"]
    """SIFT's of view i are ``first[i]:first[i + 1]``."""
    descriptor: Float32[np.ndarray, "k 128"]
    """Of SIFT's."""
    size: Float[np.ndarray, "k"]
    view: Int[np.ndarray, "f"]
    pixel: Float[np.ndarray, "f 2"]
    """As photographed."""
    on_vehicle: Bool[np.ndarray, "f"] | None
    """None where nobody says where the vehicle is."""
    colour: UInt8[np.ndarray, "f 3"]
    followed: Linked
    """Corners."""
    grey: tuple[UInt8[np.ndarray, "_ _"], ...]
    """The photos, no larger than `MOST_PX`."""

    @property
    def sift(self) -> int:
        """How many of the features SIFT found."""
        return len(self.descriptor)


@dataclass(frozen=True)
class _Looked:
    """What one photo gives."""

    features: Features
    corners: Float32[np.ndarray, "k 2"]
    """In pixels of ``grey``, whole numbers at the centres."""
    colour: UInt8[np.ndarray, "k 3"]
    """Of the corners."""
    grey: UInt8[np.ndarray, "h w"]
    factor: float
    """Size of ``grey`` over that of the photo."""
    masked: bool
    """Whether it is known where the vehicle is: corners are looked for on it alone then."""


def gather(
    pictures: Pictures,
    views: Int[np.ndarray, "n"],
    cameras: Sequence[Camera],
    up: Float[np.ndarray, "n 3"],
    angles: Float[np.ndarray, "n n"],
    advance: Callable[[], None],
) -> Gathered:
    """Find features in the photos of ``views``, on all cores.

    ``up`` is the world's z axis in each camera's axes, ``angles`` degrees between viewing directions; ``advance`` is
    called after each photo.
    """
    most = min(max(_FEATURES // len(views), _LEAST_OF_VIEW), _MOST_OF_VIEW)
    sift_px = _SIFT_PX if len(views) < _MANY else _SIFT_PX_OF_MANY
    looked = []
    with _one_thread_each():
        for one in side_by_side(
            lambda i: _look(pictures(int(views[i])), cameras[i], up[i], sift_px, most), range(len(views))
        ):
            looked.append(one)
            advance()
    features = [one.features for one in looked]
    first = np.concatenate([[0], np.cumsum([len(one) for one in features])]).astype(np.int64)
    sift = Gathered(
        first,
        np.concatenate([one.descriptor for one in features]),
        np.concatenate([one.size for one in features]),
        np.repeat(np.arange(len(views)), np.diff(first)),
        np.concatenate([one.pixel for one in features]),
        np.concatenate([one.on_vehicle for one in features]) if all(one.masked for one in looked) else None,
        np.concatenate([one.colour for one in features]),
        Linked.none(),
        tuple(one.grey for one in looked),
    )
    return _with_corners(sift, looked, angles)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """OpenCV's own threads would only get in the way of ours."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _look(picture: Picture, camera: Camera, up: Float[np.ndarray, "3"], sift_px: int, most: int) -> _Looked:
    small, shrunk = _reduced(picture, sift_px)
    found = find_features(small, camera.scaled(shrunk), up, most)
    found = replace(found, pixel=found.pixel / shrunk, size=found.size / shrunk)
    picture, factor = _reduced(picture, MOST_PX)
    grey = cv2.cvtColor(picture.rgb, cv2.COLOR_RGB2GRAY)
    corners = find_corners(smoothed(grey), picture.vehicle)
    return _Looked(found, corners, under(picture.rgb, corners + 0.5), grey, factor, picture.vehicle is not None)


def _reduced(picture: Picture, most_px: int) -> tuple[Picture, float]:
    """The picture, no larger than ``most_px``, and the factor of its size."""
    height, width = picture.rgb.shape[:2]
    if max(height, width) <= most_px:
        return picture, 1.0
    factor = most_px / max(height, width)
    size = (round(width * factor), round(height * factor))
    vehicle = picture.vehicle
    if vehicle is not None:
        vehicle = cv2.resize(vehicle, size, interpolation=cv2.INTER_NEAREST)
    return Picture(cv2.resize(picture.rgb, size, interpolation=cv2.INTER_AREA), vehicle), size[0] / width


def _with_corners(sift: Gathered, looked: Sequence[_Looked], angles: Float[np.ndarray, "n n"]) -> Gathered:
    """Corners of each view, and where they are in its neighbours."""
    apart = np.where(np.eye(len(angles), dtype=bool), np.inf, angles)
    nearest = np.argsort(apart, axis=1, kind="stable")[:, :_NEIGHBOURS]
    others = [[j for j in row.tolist() if apart[i, j] < _NEIGHBOURS_DEG] for i, row in enumerate(nearest)]
    found = side_by_side(
        lambda i: follow(looked[i].corners, smoothed(looked[i].grey), [smoothed(looked[j].grey) for j in others[i]]),
        range(len(looked)),
    )
    view, pixel, colour = [sift.view], [sift.pixel], [sift.colour]
    here, there = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    count = len(sift.view)
    for i, followed in enumerate(found):
        origin, own = count, looked[i]
        places = [(own.corners + 0.5, i, own.colour)]
        count += len(own.corners)
        for one, j in zip(followed, others[i], strict=True):
            places.append((one.there, j, own.colour[one.number]))
            here.append(origin + one.number)
            there.append(count + np.arange(len(one.number)))
            count += len(one.number)
        for at, j, seen in places:
            view.append(np.full(len(at), j))
            pixel.append(at.astype(np.float64) / looked[j].factor)
            colour.append(seen)
    corners, added = np.concatenate(here), count - len(sift.view)
    strength = np.ones(len(corners))
    return replace(
        sift,
        view=np.concatenate(view),
        pixel=np.concatenate(pixel),
        on_vehicle=None if sift.on_vehicle is None else np.pad(sift.on_vehicle, (0, added), constant_values=True),
        colour=np.concatenate(colour),
        followed=Linked(corners, np.concatenate(there), _CORNER_SIMILARITY * strength, _CORNER_RATIO * strength),
    )
