"""The scene: everything a solver may know about a capture."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from kronc_ns.errors import KroncError
from kronc_ns.geometry.camera import Camera
from kronc_ns.keypoints.schema import KeypointSchema


@dataclass(frozen=True)
class Scene:
    """N views of one object by one camera, with J keypoints; immutable, made by `load_scene` or by hand."""

    names: tuple[str, ...]
    """``file_path`` of each view, relative to the folder, in capture order."""
    camera: Camera
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

    def __post_init__(self) -> None:
        if self.keypoints.shape != (len(self.names), len(self.schema), 3):
            raise KroncError(
                f"keypoints have shape {tuple(self.keypoints.shape)}: "
                f"expected ({len(self.names)}, {len(self.schema)}, 3)"
            )

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def seen(self) -> Bool[np.ndarray, "n j"]:
        """Where a keypoint was found."""
        return self.keypoints[..., 2] > 0

    @cached_property
    def visibility(self) -> Float[np.ndarray, "n j"]:
        """The paper's m: 1 where a keypoint was found, else 0."""
        return self.seen.astype(np.float64)

    @cached_property
    def uv(self) -> Float[np.ndarray, "n j 2"]:
        """Pixels with lens distortion removed."""
        return self.camera.undistort(self.keypoints[..., :2])
