"""SIFT features of a view (Lowe, IJCV 2004), upright: their orientation is where the world's up points in the image."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from kronc_ns.geometry.camera import Camera
from kronc_ns.refine.pictures import Picture

_CONTRAST, _EDGE = 0.003, 16.0  # paint is plain: faint blobs and long edges count too
_MARGIN_PX = 2  # around the vehicle, whose outline belongs to it


@dataclass(frozen=True)
class Features:
    """Of one view."""

    pixel: Float[np.ndarray, "k 2"]
    """As photographed; the centre of the top-left pixel is (0.5, 0.5)."""
    size: Float[np.ndarray, "k"]
    """Radius in pixels."""
    descriptor: Float32[np.ndarray, "k 128"]
    """RootSIFT (Arandjelovic and Zisserman, CVPR 2012), of length 1."""
    on_vehicle: Bool[np.ndarray, "k"]
    """Where nobody says where the vehicle is, all are."""
    colour: UInt8[np.ndarray, "k 3"]

    def __len__(self) -> int:
        return len(self.pixel)


def find_features(picture: Picture, camera: Camera, up: Float[np.ndarray, "3"], most: int) -> Features:
    """The strongest features of a photo; ``up`` is the world's z axis in the camera's axes."""
    grey = cv2.cvtColor(picture.rgb, cv2.COLOR_RGB2GRAY)
    # without precise upscaling all features are a quarter of a pixel off
    sift = cv2.SIFT.create(most, contrastThreshold=_CONTRAST, edgeThreshold=_EDGE, enable_precise_upscale=True)
    found = sift.detect(grey, None)
    places = np.array([(*point.pt, point.size) for point in found]).reshape(-1, 3)
    # SIFT reports a place once for each of its orientations, of which none is needed
    first = np.sort(np.unique(np.round(4 * places), axis=0, return_index=True)[1])
    kept = [found[i] for i in first]
    for point, angle in zip(kept, _upright(places[first, :2] + 0.5, camera, up).tolist(), strict=True):
        point.angle = angle
    if not kept:
        return Features(
            np.empty((0, 2)),
            np.empty(0),
            np.empty((0, 128), np.float32),
            np.empty(0, bool),
            np.empty((0, 3), np.uint8),
        )
    kept, descriptor = sift.compute(grey, kept)
    pixel = np.array([point.pt for point in kept]) + 0.5
    return Features(
        pixel,
        np.array([point.size for point in kept]) / 2,
        np.sqrt(descriptor / np.maximum(descriptor.sum(1, keepdims=True), 1e-9)).astype(np.float32),
        _on_vehicle(picture, pixel),
        under(picture.rgb, pixel),
    )


def _on_vehicle(picture: Picture, pixel: Float[np.ndarray, "k 2"]) -> Bool[np.ndarray, "k"]:
    """Which places lie on the vehicle or its outline."""
    if picture.vehicle is None:
        return np.ones(len(pixel), bool)
    grown = cv2.dilate(picture.vehicle, np.ones((2 * _MARGIN_PX + 1,) * 2, np.uint8))
    return under(grown, pixel) > 0


def under(image: UInt8[np.ndarray, "h w *c"], pixel: Float[np.ndarray, "k 2"]) -> UInt8[np.ndarray, "k *c"]:
    """The image's values at some places."""
    height, width = image.shape[:2]
    column, row = np.floor(pixel).astype(int).T
    return image[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]


def _upright(pixel: Float[np.ndarray, "k 2"], camera: Camera, up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "k"]:
    """Degrees, clockwise from the x axis as OpenCV has it, in which the world's up points at each place."""
    x, y = (pixel[:, 0] - camera.cx) / camera.fx, (pixel[:, 1] - camera.cy) / camera.fy
    return np.degrees(np.arctan2(up[1] - y * up[2], up[0] - x * up[2])) % 360.0
