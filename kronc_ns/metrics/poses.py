"""Pose errors against a reference: the figures `kronc eval` prints and the benchmarks are made of."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from kronc_ns.errors import KroncError
from kronc_ns.geometry.alignment import pose_errors

AUC_LIMITS_DEG = (3, 5, 30)


@dataclass(frozen=True)
class PoseErrors:
    """Errors of the registered views after similarity alignment, and how many views there should have been."""

    views: int
    """Views of the reference."""
    rotation_deg: Float[np.ndarray, "n"]
    translation: Float[np.ndarray, "n"]
    """Distance of camera centres in the reference's unit."""
    angle_deg: Float[np.ndarray, "n"]
    """Larger of rotation error and the angle the centre error subtends at the centre of the reference cameras."""

    @property
    def registered(self) -> int:
        """Views that have a pose."""
        return len(self.rotation_deg)

    def auc(self, limit_deg: float) -> float:
        """Area under the recall curve of `angle_deg` from 0 to ``limit_deg``, in [0, 1]; missing views never count."""
        within = np.maximum(1 - self.angle_deg / limit_deg, 0)
        return float(within.sum() / self.views)

    def as_dict(self) -> dict[str, Any]:
        """The JSON object of `kronc eval --json`."""
        return {
            "views": self.views,
            "registered": self.registered,
            "rotation_deg": _summary(self.rotation_deg),
            "translation": _summary(self.translation),
            **{f"auc_{limit}deg": self.auc(float(limit)) for limit in AUC_LIMITS_DEG},
        }


def evaluate_poses(
    poses: Mapping[str, Float[np.ndarray, "3 4"]], reference: Mapping[str, Float[np.ndarray, "3 4"]]
) -> PoseErrors:
    """Compare poses (OpenCV c2w by image path) with a reference; views are matched by file name.

    Suffixes do not count: frame_00001.jpg may have been made of frame_00001.heic. Raises `KroncError` when file names
    are ambiguous or fewer than three views are in both.
    """
    ours, theirs = _by_file_name(poses, "the poses"), _by_file_name(reference, "the reference")
    common = [name for name in theirs if name in ours]
    if len(common) < 3:
        raise KroncError(
            f"{len(common)} of {len(theirs)} reference views are among the {len(ours)} poses: expected at least 3 with "
            "equal file names"
        )
    estimate, truth = (np.stack([poses_of[name] for name in common]) for poses_of in (ours, theirs))
    rotation, translation = pose_errors(estimate, truth)
    distance = np.linalg.norm(truth[..., 3] - truth[..., 3].mean(0), axis=-1)
    angle = np.maximum(rotation, np.rad2deg(np.arctan2(translation, distance)))
    return PoseErrors(len(theirs), rotation, translation, angle)


def _by_file_name(poses: Mapping[str, Float[np.ndarray, "3 4"]], what: str) -> dict[str, Float[np.ndarray, "3 4"]]:
    named = {PurePosixPath(path).stem: pose for path, pose in poses.items()}
    if len(named) < len(poses):
        raise KroncError(f"two of {what} have the same file name: views are matched by file name")
    return named


def _summary(errors: Float[np.ndarray, "n"]) -> dict[str, float]:
    return {"mean": float(errors.mean()), "median": float(np.median(errors)), "max": float(errors.max())}
