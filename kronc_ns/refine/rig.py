"""The cameras while they are refined."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from kronc_ns.geometry.alignment import Similarity
from kronc_ns.geometry.camera import Camera, rays
from kronc_ns.geometry.poses import invert, make_pose
from kronc_ns.refine.tracks import Cameras


@dataclass(frozen=True)
class Rig:
    """N cameras through G lenses, and the keypoints they were solved from.

    All pixels are carried into those of one ideal camera without distortion, square pixels and its principal point at
    0, whose focal length is that of the lens of most views.
    """

    rotation: Float[np.ndarray, "n 3 3"]
    """World to camera."""
    translation: Float[np.ndarray, "n 3"]
    lenses: tuple[Camera, ...]
    lens: Int[np.ndarray, "n"]
    """Which of them each view has."""
    keypoints: Float[np.ndarray, "j 3"]

    @staticmethod
    def of(
        c2w: Float[np.ndarray, "n 3 4"],
        lenses: Sequence[Camera],
        lens: Int[np.ndarray, "n"],
        keypoints: Float[np.ndarray, "j 3"],
    ) -> "Rig":
        """From camera poses."""
        w2c = invert(c2w)
        return Rig(np.ascontiguousarray(w2c[..., :3]), w2c[..., 3].copy(), tuple(lenses), lens, keypoints)

    @property
    def focal(self) -> float:
        """Of the ideal camera."""
        usual = self.lenses[int(np.bincount(self.lens).argmax())]
        return float(np.sqrt(usual.fx * usual.fy))

    @property
    def cameras(self) -> Cameras:
        """As points are triangulated by."""
        return Cameras(self.rotation, self.translation, self.focal)

    @property
    def c2w(self) -> Float[np.ndarray, "n 3 4"]:
        """Camera poses."""
        return invert(make_pose(self.rotation, self.translation))

    @property
    def enlargement(self) -> Float[np.ndarray, "n"]:
        """How many pixels of each view's own camera make one of the ideal one."""
        return np.array([camera.fx for camera in self.lenses])[self.lens] / self.focal

    def ideal(self, pixel: Float[np.ndarray, "s 2"], view: Int[np.ndarray, "s"]) -> Float[np.ndarray, "s 2"]:
        """Photographed pixels as the ideal camera would have seen them."""
        uv = np.empty(pixel.shape)
        for number, camera in enumerate(self.lenses):
            own = self.lens[view] == number
            uv[own] = rays(camera.undistort(pixel[own]), camera)[:, :2] * self.focal
        return uv

    def moved(self, by: Similarity) -> "Rig":
        """In another world."""
        c2w = by.apply_to_poses(self.c2w)
        return Rig.of(c2w, self.lenses, self.lens, by.apply(self.keypoints))

    def with_lenses(self, log_growth: Float[np.ndarray, "g"], k1: Float[np.ndarray, "g"]) -> "Rig":
        """With focal lengths that have grown, and distortion on top of what there is."""
        lenses = tuple(
            replace(camera, fx=camera.fx * growth, fy=camera.fy * growth, k1=camera.k1 + more)
            for camera, growth, more in zip(self.lenses, np.exp(log_growth).tolist(), k1.tolist(), strict=True)
        )
        return replace(self, lenses=lenses)
