"""Pinhole cameras: intrinsics, projection and back-projection.

Pixels: the centre of the top-left pixel is (0.5, 0.5), as in nerfstudio and COLMAP.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.errors import KroncError
from kronc_ns.geometry.poses import invert


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels (OpenCV distortion model)."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def __post_init__(self) -> None:
        values = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not all(np.isfinite(values)):
            raise KroncError(f"camera intrinsics {values} hold a value that is not finite: expected numbers in pixels")
        if self.fx <= 0 or self.fy <= 0:
            raise KroncError(
                f"focal length ({self.fx:g}, {self.fy:g}) px is not positive: give the true one in pixels "
                "as fl_x/fl_y in transforms.json or with --focal-length-px"
            )
        if self.width <= 0 or self.height <= 0:
            raise KroncError(f"image size {self.width}x{self.height} is not positive: expected w and h in pixels")
        if not (0 < self.cx < self.width and 0 < self.cy < self.height):
            raise KroncError(
                f"principal point ({self.cx:g}, {self.cy:g}) is not in the image of {self.width}x{self.height}: "
                "expected cx and cy in pixels, near its centre"
            )

    @property
    def distortion(self) -> tuple[float, float, float, float]:
        """OpenCV's (k1, k2, p1, p2)."""
        return (self.k1, self.k2, self.p1, self.p2)

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The paper's K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def undistort(self, uv: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b 2"]:
        """Pixels as an ideal pinhole camera with the same K would see them."""
        if not any(self.distortion) or not uv.size:
            return uv
        import cv2  # only lenses with distortion need it

        flat = np.ascontiguousarray(uv, dtype=np.float64).reshape(-1, 1, 2)
        # OpenCV's default of five iterations leaves up to a pixel in the corners of wide lenses
        exactly = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-10)
        ideal = cv2.undistortPointsIter(flat, self.matrix, np.array(self.distortion), np.eye(3), self.matrix, exactly)
        return ideal.reshape(uv.shape)

    def distort(self, uv: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b 2"]:
        """Pixels of the ideal pinhole camera as this one sees them: the inverse of `undistort`."""
        if not any(self.distortion) or not uv.size:
            return uv
        import cv2

        flat = uv.reshape(-1, 2)
        at_depth_1 = np.column_stack([(flat - (self.cx, self.cy)) / (self.fx, self.fy), np.ones(len(flat))])
        seen, _ = cv2.projectPoints(at_depth_1, np.zeros(3), np.zeros(3), self.matrix, np.array(self.distortion))
        return seen.reshape(uv.shape)

    def scaled(self, factor: float) -> "Camera":
        """The camera of the same image resized by ``factor``."""
        return replace(
            self,
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=self.cx * factor,
            cy=self.cy * factor,
            width=round(self.width * factor),
            height=round(self.height * factor),
        )


@dataclass(frozen=True)
class Lenses:
    """The cameras of N views where these are not all alike."""

    cameras: tuple[Camera, ...]
    """Each once."""
    of_view: Int[np.ndarray, "n"]
    """Which of them took each view."""

    @staticmethod
    def of(cameras: Sequence[Camera]) -> "Lenses | None":
        """From the camera of each view; None where all are the same."""
        distinct = tuple(dict.fromkeys(cameras))
        if len(distinct) < 2:
            return None
        return Lenses(distinct, np.array([distinct.index(camera) for camera in cameras]))

    @property
    def usual(self) -> Camera:
        """The one of most views."""
        return self.cameras[int(np.bincount(self.of_view).argmax())]

    @property
    def each(self) -> tuple[Camera, ...]:
        """The camera of each view."""
        return tuple(self.cameras[lens] for lens in self.of_view)

    def chosen(self, keep: Bool[np.ndarray, "n"]) -> "Lenses":
        """Of some of the views."""
        return Lenses(self.cameras, self.of_view[keep])


def rays(uv: Float[np.ndarray, "*b 2"], camera: Camera) -> Float[np.ndarray, "*b 3"]:
    """K^-1 (u, v, 1): camera-frame direction of each pixel with z = 1 (distortion is not considered)."""
    x = (uv[..., 0] - camera.cx) / camera.fx
    y = (uv[..., 1] - camera.cy) / camera.fy
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def project(points_camera: Float[np.ndarray, "*b 3"], camera: Camera) -> Float[np.ndarray, "*b 2"]:
    """Pixels of camera-frame points; meaningless where z <= 0, which the caller has to check."""
    x, y, z = points_camera[..., 0], points_camera[..., 1], points_camera[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=-1)


def lengths(off: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b"]:
    """Of offsets in pixels (numpy's hypot takes five times as long, for the sake of lengths past 1e154)."""
    x, y = off[..., 0], off[..., 1]
    return np.sqrt(x * x + y * y)


def reproject(
    points: Float[np.ndarray, "j 3"], c2w: Float[np.ndarray, "n 3 4"], camera: Camera
) -> Float[np.ndarray, "n j 2"]:
    """Pixels of every point in every view (the paper's equation 3 of its centroids); inf behind a camera."""
    w2c = invert(c2w)
    turned = (w2c[..., :3].reshape(-1, 3) @ points.T).reshape(len(c2w), 3, len(points))  # one product, not one a view
    x, y, z = np.moveaxis(turned + w2c[..., 3:], 1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=-1)
    pixels[~(z > 0)] = np.inf
    return pixels
