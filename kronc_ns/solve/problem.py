"""What bundle adjustment knows and seeks: measurements, priors and unknowns of a batch of scenes.

Arrays of views and keypoints are planar, [B, N, component, J]: B scenes, N views, J keypoints. The unknowns of the
reduced system are ordered (x of all points, y of all, z of all, intrinsics).
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from kronc_ns.geometry.poses import invert, make_pose

Record = TypeVar("Record", bound="Batched")


class Batched:
    """A dataclass of tensors (or of such dataclasses) with the scenes in front."""

    def each(self: Record, function: Callable[..., Tensor], *others: Record) -> Record:
        """``function`` of every tensor and its counterparts in ``others``."""
        changes = {}
        for f in fields(self):  # pyright: ignore[reportArgumentType]
            value = getattr(self, f.name)
            if isinstance(value, Tensor):
                changes[f.name] = function(value, *(getattr(other, f.name) for other in others))
            elif isinstance(value, Batched):
                changes[f.name] = value.each(function, *(getattr(other, f.name) for other in others))
        return replace(self, **changes)  # pyright: ignore[reportArgumentType]

    def __getitem__(self: Record, scenes: Int[Tensor, "c"]) -> Record:
        return self.each(lambda x: x[scenes])


@dataclass(frozen=True)
class ShapePrior:
    """What is known of the points beforehand: about normal around a mean shape, in the world's own frame.

    Arrays are in the planar order of the reduced system.
    """

    mean: Float[Tensor, "p"]
    precision: Float[Tensor, "p p"]
    """Inverse covariance."""
    freedom: float = 20.0
    """Degrees of freedom of the tail (Student t): the fewer, the sooner an unusual shape is believed."""

    @staticmethod
    def of(mean: Float[Tensor, "j 3"], precision: Float[Tensor, "p p"]) -> "ShapePrior":
        """Prior from a mean shape and an inverse covariance in the order index = 3 * point + axis."""
        order = torch.arange(mean.numel(), device=mean.device).view(-1, 3).T.flatten()
        return ShapePrior(mean.T.flatten(), precision[order][:, order].contiguous())

    def to(self, device: torch.device) -> "ShapePrior":
        """The same on a device."""
        return replace(self, mean=self.mean.to(device), precision=self.precision.to(device))

    @staticmethod
    def nothing(like: Tensor) -> "ShapePrior":
        """What the compiled loops take for no prior."""
        return ShapePrior(like.new_empty(0), like.new_empty(0, 0))


@dataclass(frozen=True)
class OrbitPrior(Batched):
    """Expected camera centres, such as those of a smooth walk."""

    centre: Float[Tensor, "b n 3"]
    sigma: Float[Tensor, "b n"]
    """Standard deviation per axis; inf where nothing is expected."""


@dataclass(frozen=True)
class Problem(Batched):
    """What a batch of scenes measured."""

    uv: Float[Tensor, "b n 2 j"]
    """Undistorted pixels less the principal point, planar."""
    weight: Float[Tensor, "b n j"]
    """Weight of each detection's squared error; 0: not seen."""
    focal: Float[Tensor, "b 2"]
    shape: ShapePrior | None = None
    orbit: OrbitPrior | None = None
    refine: tuple[Literal["focal", "k1"], ...] = ()
    """Shared intrinsics that are unknown too."""
    points_known: bool = False
    """Whether only the cameras are sought (resection)."""

    def to(self, device: torch.device) -> "Problem":
        """The same on a device, the prior that all scenes share included."""
        shape = None if self.shape is None else self.shape.to(device)
        return replace(self.each(lambda x: x.to(device)), shape=shape)

    @property
    def plain(self) -> bool:
        """Whether the loops compiled for the CPU serve: doubles there, no orbit, no unknown intrinsics."""
        ours = self.uv.device.type == "cpu" and self.uv.dtype == torch.float64
        return ours and self.orbit is None and not self.refine


@dataclass(frozen=True)
class State(Batched):
    """The unknowns of a batch of scenes."""

    rotation: Float[Tensor, "b n 3 3"]
    """World to camera."""
    translation: Float[Tensor, "b n 3"]
    """World to camera."""
    points: Float[Tensor, "b j 3"]
    intrinsics: Float[Tensor, "b k"]
    """As far as `Problem.refine` names them: logarithm of the focal length's factor; k1."""

    @property
    def c2w(self) -> Float[Tensor, "b n 3 4"]:
        """Camera poses."""
        return invert(make_pose(self.rotation, self.translation))

    @staticmethod
    def of(c2w: Float[Tensor, "b n 3 4"], points: Float[Tensor, "b j 3"], unknown: int = 0) -> "State":
        """State with the given poses and ``unknown`` intrinsics as the camera has them."""
        rotation = c2w[..., :3].transpose(-1, -2).contiguous()
        translation = -(rotation @ c2w[..., 3:])[..., 0]
        return State(rotation, translation, points, points.new_zeros(len(points), unknown))


@dataclass(frozen=True)
class Residuals(Batched):
    """Reprojection of every point into every view, planar."""

    plane: Float[Tensor, "b n 2 j"]
    """Normalised image coordinates before k1."""
    inverse_z: Float[Tensor, "b n 1 j"]
    error: Float[Tensor, "b n 2 j"]
    """Projection minus detection in pixels; 0 where nothing is seen."""
    norm: Float[Tensor, "b n j"]
    """Length of the error in pixels times the root of its weight; `BEHIND_PX` behind the camera."""
    surprise: Float[Tensor, "b"]
    """Squared Mahalanobis distance of the points under the shape prior; 0 without one."""
    pull: Float[Tensor, "b p"]
    """Half its gradient by the points."""


def focal_of(problem: Problem, state: State) -> Float[Tensor, "b 2"]:
    """Focal length in pixels, refined or not."""
    if "focal" in problem.refine:
        return problem.focal * state.intrinsics[:, problem.refine.index("focal"), None].exp()
    return problem.focal


def array(tensor: Tensor) -> np.ndarray:
    """A tensor on the CPU as compiled loops take it."""
    return tensor.contiguous().numpy()
