"""The scene: everything a solver may know about a capture."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.errors import KroncError
from kronc_ns.geometry.camera import Camera, Lenses, rays
from kronc_ns.keypoints.schema import KeypointSchema

_SIGMA_LIMITS = (0.5, 3.0)  # of the usual one


@dataclass(frozen=True)
class Scene:
    """N views of one object with J keypoints; immutable, made by `load_scene` or by hand."""

    names: tuple[str, ...]
    """``file_path`` of each view, relative to the folder, in capture order."""
    camera: Camera
    """Of all views; where there are several, that whose pixels `uv` and all errors are in."""
    schema: KeypointSchema
    keypoints: Float[np.ndarray, "n j 3"]
    """(u, v, confidence) in pixels as detected (distorted); confidence 0: not seen."""
    given_c2w: Float[np.ndarray, "n 3 4"] | None = None
    """Poses that came with the images (OpenCV axes), for ``init="given"``."""
    given_depths: Float[np.ndarray, "n j"] | None = None
    """z-depth under each keypoint, in any unit common to all views; NaN where there is none."""
    masks: tuple[str, ...] | None = None
    """``mask_path`` of each view, or None."""
    notes: tuple[str, ...] = ()
    """What loading decided that the user may want to know."""
    sigma_px: Float[np.ndarray, "n j"] | None = None
    """Standard deviation of each place along one axis, where the detector knew it; 0 where nothing was found."""

    lenses: Lenses | None = None
    """The cameras of the views, where there are several."""

    def __post_init__(self) -> None:
        if self.keypoints.shape != (len(self.names), len(self.schema), 3):
            raise KroncError(
                f"keypoints have shape {tuple(self.keypoints.shape)}: "
                f"expected ({len(self.names)}, {len(self.schema)}, 3)"
            )

        if self.sigma_px is not None and self.sigma_px.shape != self.keypoints.shape[:2]:
            raise KroncError(
                f"sigma_px has shape {tuple(self.sigma_px.shape)}: expected {tuple(self.keypoints.shape[:2])}"
            )

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def seen(self) -> Bool[np.ndarray, "n j"]:
        """Where a keypoint was found."""
        return self.keypoints[..., 2] > 0

    @cached_property
    def visible(self) -> Int[np.ndarray, "n"]:
        """How many keypoints were found in each view."""
        return self.seen.sum(1)

    @cached_property
    def visibility(self) -> Float[np.ndarray, "n j"]:
        """The paper's m: 1 where a keypoint was found, else 0."""
        return self.seen.astype(np.float64)

    def camera_of(self, view: int) -> Camera:
        """The camera that took a view."""
        return self.camera if self.lenses is None else self.lenses.cameras[self.lenses.of_view[view]]

    @cached_property
    def enlargement(self) -> Float[np.ndarray, "n"]:
        """How many pixels of each view's own camera make one of `camera`."""
        if self.lenses is None:
            return np.ones(len(self))
        return np.array([camera.fx for camera in self.lenses.cameras])[self.lenses.of_view] / self.camera.fx

    @cached_property
    def precision(self) -> Float[np.ndarray, "n j"]:
        """How much each measurement counts beside the others: confidence over variance; 0 where nothing was found.

        What a detector says of its noise is believed within limits: no point counts for dozens of others.
        """
        confidence = self.keypoints[..., 2] * np.square(self.enlargement)[:, None]
        if self.sigma_px is None or not self.seen.any():
            return confidence
        usual = max(float(np.median(self.sigma_px[self.seen])), 1e-9)
        relative = np.clip(self.sigma_px / usual, *_SIGMA_LIMITS)
        return np.where(self.seen, confidence / relative**2, 0.0)

    def with_sides_swapped(self, swapped: Bool[np.ndarray, "n"]) -> "Scene":
        """The scene with left and right of these views exchanged."""
        flip = list(self.schema.flip)
        keypoints = np.where(swapped[:, None, None], self.keypoints[:, flip], self.keypoints)
        sigma = self.sigma_px
        if sigma is not None:
            sigma = np.where(swapped[:, None], sigma[:, flip], sigma)
        return replace(self, keypoints=keypoints, sigma_px=sigma)

    @cached_property
    def uv(self) -> Float[np.ndarray, "n j 2"]:
        """Pixels with lens distortion removed, as `camera` would have seen them."""
        if self.lenses is None:
            return np.ascontiguousarray(self.camera.undistort(self.keypoints[..., :2]))
        uv = np.empty(self.keypoints[..., :2].shape)
        for lens, camera in enumerate(self.lenses.cameras):
            own = self.lenses.of_view == lens
            plane = rays(camera.undistort(self.keypoints[own, :, :2]), camera)[..., :2]
            uv[own] = plane * (self.camera.fx, self.camera.fy) + (self.camera.cx, self.camera.cy)
        return uv
