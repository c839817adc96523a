"""Bundle adjustment with the cameras eliminated as dense tensors: residuals, normal equations and steps of many scenes.

The same mathematics as `schur`, for a GPU; formulas of `projection` and `robust` broadcast over the tensors. B scenes,
N views, J keypoints; arrays of views and keypoints are planar, [B, N, component, J].
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from kronc_ns.solve.problem import Intrinsic, Problem, ShapePrior, State
from kronc_ns.solve.projection import (
    BEHIND_PX,
    NEAR,
    pixel,
    pixel_by_k1,
    pixel_by_plane,
    plane_by_point,
    plane_by_shift,
    plane_by_turn,
)
from kronc_ns.solve.schur import TINY

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
class SharedPrior:
    """The `ShapePrior` that all scenes of a batch have."""

    mean: Float[Tensor, "p"]
    precision: Float[Tensor, "p p"]
    freedom: float


@dataclass(frozen=True)
class Problems(Batched):
    """What a batch of scenes measured."""

    uv: Float[Tensor, "b n 2 j"]
    weight: Float[Tensor, "b n j"]
    focal: Float[Tensor, "b 2"]
    centre: Float[Tensor, "b n 3"]
    """Expected camera centres."""
    strength: Float[Tensor, "b n"]
    """Their inverse variance, 0 where nothing is expected."""
    redundancy: Float[Tensor, "b"]
    shape: SharedPrior | None
    refine: tuple[Intrinsic, ...]
    points_known: bool


@dataclass(frozen=True)
class States(Batched):
    """The unknowns of a batch of scenes."""

    rotation: Float[Tensor, "b n 3 3"]
    translation: Float[Tensor, "b n 3"]
    points: Float[Tensor, "b j 3"]
    intrinsics: Float[Tensor, "b 2"]
    """Logarithm of the focal length's factor, k1."""

    def scene(self, b: int, views: int) -> State:
        """The state of a scene of so many views."""
        log_growth, k1 = self.intrinsics[b].tolist()
        rotation, translation, points = (
            x.cpu().numpy() for x in (self.rotation[b, :views], self.translation[b, :views], self.points[b])
        )
        return State(rotation, translation, points, log_growth, k1)


@dataclass(frozen=True)
class Residuals(Batched):
    """Reprojection of every point into every view."""

    plane: Float[Tensor, "b n 2 j"]
    near: Float[Tensor, "b n j"]
    """1 / z."""
    error: Float[Tensor, "b n 2 j"]
    """Projection minus detection in pixels; 0 where nothing is seen."""
    length: Float[Tensor, "b n j"]
    """Length of the error in pixels times the root of its weight; `BEHIND_PX` behind the camera."""
    surprise: Float[Tensor, "b"]
    """Squared Mahalanobis distance of the points under the shape prior; 0 without one."""
    pull: Float[Tensor, "b p"]
    """Half its gradient by the points."""


def stack(problems: Sequence[Problem], states: Sequence[State], device: str) -> tuple[Problems, States]:
    """A batch of scenes with equal points, priors and unknowns, views padded by unseen ones."""
    views = max(len(problem.weight) for problem in problems)

    def padded(arrays: Sequence[np.ndarray], filling: float | np.ndarray = 0.0) -> Tensor:
        out = np.empty((len(arrays), views, *arrays[0].shape[1:]))
        out[:] = filling
        for i, array in enumerate(arrays):
            out[i, : len(array)] = array
        return torch.from_numpy(out).to(device)

    def whole(arrays: Sequence[np.ndarray]) -> Tensor:
        return torch.from_numpy(np.stack(arrays)).to(device)

    first = problems[0]
    orbits = [problem.orbit for problem in problems]
    return (
        Problems(
            uv=padded([problem.uv.swapaxes(1, 2) for problem in problems]),
            weight=padded([problem.weight for problem in problems]),
            focal=whole([np.array(problem.focal) for problem in problems]),
            centre=padded([np.zeros((1, 3)) if orbit is None else orbit.centre for orbit in orbits]),
            strength=padded([np.zeros(1) if orbit is None else 1.0 / np.square(orbit.sigma) for orbit in orbits]),
            redundancy=whole([np.array(problem.redundancy) for problem in problems]),
            shape=None if first.points_known or first.shape is None else _shared(first.shape, device),
            refine=first.refine,
            points_known=first.points_known,
        ),
        States(
            rotation=padded([state.rotation for state in states], np.eye(3)),
            translation=padded([state.translation for state in states]),
            points=whole([state.points for state in states]),
            intrinsics=whole([np.array([state.log_growth, state.k1]) for state in states]),
        ),
    )


def _shared(shape: ShapePrior, device: str) -> SharedPrior:
    return SharedPrior(
        torch.from_numpy(shape.mean).to(device), torch.from_numpy(shape.precision).to(device), shape.freedom
    )


def residuals(problem: Problems, state: States) -> Residuals:
    """Reproject all points."""
    camera = state.rotation @ state.points.mT[:, None] + state.translation[..., None]
    behind, seen = camera[:, :, 2] < NEAR, problem.weight > 0
    near = camera[:, :, 2].clamp_min(NEAR).reciprocal()
    u, v = camera[:, :, 0] * near, camera[:, :, 1] * near
    error = torch.stack(pixel(u, v, *_lens(problem, state)), dim=2) - problem.uv
    error = torch.where((seen & ~behind)[:, :, None], error, 0.0)
    length = (error.square().sum(2) * problem.weight).sqrt()
    length = torch.where(behind & seen, BEHIND_PX, length)
    surprise, pull = length.new_zeros(len(length)), length.new_zeros(len(length), 0)
    if problem.shape is not None:
        deviation = state.points.mT.flatten(1) - problem.shape.mean
        pull = deviation @ problem.shape.precision
        surprise = (pull * deviation).sum(1)
    return Residuals(torch.stack([u, v], dim=2), near, error, length, surprise, pull)


def _lens(problem: Problems, state: States) -> tuple[Tensor, Tensor, Tensor]:
    """Focal lengths and k1, each [B, 1, 1]."""
    fx, fy = (problem.focal * state.intrinsics[:, :1].exp())[:, None, None].unbind(-1)
    return fx, fy, state.intrinsics[:, 1, None, None]


@dataclass(frozen=True)
class Linearisation:
    """Normal equations of a batch, the cameras' blocks apart from the P other unknowns'."""

    camera: Float[Tensor, "b n 6 6"]
    camera_gradient: Float[Tensor, "b n 6"]
    coupling: Float[Tensor, "b n 6 p"]
    other: Float[Tensor, "b p p"]
    other_gradient: Float[Tensor, "b p"]


def linearise(
    problem: Problems,
    state: States,
    residual: Residuals,
    weight: Float[Tensor, "b n j"],
    variance: Float[Tensor, "b"],
    belief: Float[Tensor, "b"],
) -> Linearisation:
    """Gauss-Newton normal equations with IRLS weights (in addition to the detections' own).

    ``belief`` is the weight of the shape prior, ``variance`` that of expected centres.
    """
    b, n, _, j = residual.plane.shape
    u, v = residual.plane.unbind(2)
    root = (weight * problem.weight).sqrt()
    fx, fy, k1 = _lens(problem, state)
    xu, xv, yu, yv = pixel_by_plane(u, v, root * fx, root * fy, k1)

    def in_pixels(of_u: Sequence[Tensor], of_v: Sequence[Tensor]) -> Float[Tensor, "b n k l"]:
        """Rows of derivatives, along x of all points and then along y."""
        du, dv = torch.stack(list(of_u), dim=2), torch.stack(list(of_v), dim=2)
        along, down = xu[:, :, None] * du + xv[:, :, None] * dv, yu[:, :, None] * du + yv[:, :, None] * dv
        return torch.cat([along, down], dim=-1)

    u0, u1, u2, v0, v1, v2 = plane_by_turn(u, v)
    ux, uz, vy, vz = plane_by_shift(u, v, residual.near)
    none = torch.zeros_like(u)
    cameras = in_pixels((u0, u1, u2, ux, none, uz), (v0, v1, v2, none, vy, vz))  # [b, n, 6, 2j]
    off = (root[:, :, None] * residual.error).flatten(2)[..., None]  # [b, n, 2j, 1]
    camera, camera_gradient = cameras @ cameras.mT, (cameras @ off)[..., 0]
    strength = variance[:, None] * problem.strength
    camera[..., 3:, 3:] += torch.diag_embed(strength[..., None].expand(b, n, 3))
    camera_gradient[..., 3:] += strength[..., None] * orbit_error(problem, state)

    rows: list[Tensor] = []  # each [b, n, 2j] by one kind of unknown
    if not problem.points_known:
        columns = state.rotation[..., None].unbind(3)  # right, down, forward by world axis: [b, n, 3, 1]
        for column in columns:
            right, down, forward = column.unbind(2)
            du, dv = plane_by_point(u, v, residual.near, right, down, forward)
            rows.append(in_pixels([du], [dv])[:, :, 0])
    by_lens = {"focal": pixel(u, v, root * fx, root * fy, k1), "k1": pixel_by_k1(u, v, root * fx, root * fy)}
    lens = [torch.cat(by_lens[name], dim=-1) for name in problem.refine]
    points, size = 3 * j * (not problem.points_known), 3 * j * (not problem.points_known) + len(lens)
    # every point has rows of its own: a dense Jacobian [b, 2nj, p] would be mostly zeros
    coupling = cameras.new_zeros(b, n, 6, size)
    other, gradient = cameras.new_zeros(b, size, size), cameras.new_zeros(b, size)
    halves = cameras.unflatten(-1, (2, j))
    flat_off = off[..., 0].unflatten(-1, (2, j))
    for c, row in enumerate(rows):
        row = row.unflatten(-1, (2, j))
        at = slice(c * j, (c + 1) * j)
        coupling[..., at] = (halves * row[:, :, None]).sum(3)
        gradient[:, at] = (row * flat_off).sum((1, 2))
        for d, second in enumerate(rows):
            square = (row * second.unflatten(-1, (2, j))).sum((1, 2))
            other[:, at, d * j : (d + 1) * j] = torch.diag_embed(square)
        for s, column in enumerate(lens):
            cross = (row * column.unflatten(-1, (2, j))).sum((1, 2))
            other[:, at, points + s] = other[:, points + s, at] = cross
    for s, column in enumerate(lens):
        coupling[..., points + s] = (cameras @ column[..., None])[..., 0]
        gradient[:, points + s] = (column * off[..., 0]).sum((1, 2))
        for t, second in enumerate(lens):
            other[:, points + s, points + t] = (column * second).sum((1, 2))
    if problem.shape is not None:
        other[:, :points, :points] += belief[:, None, None] * problem.shape.precision
        gradient[:, :points] += belief[:, None] * residual.pull
    _fill_diagonal(camera)
    _fill_diagonal(other)
    return Linearisation(camera, camera_gradient, coupling, other, gradient)


def orbit_error(problem: Problems, state: States) -> Float[Tensor, "b n 3"]:
    """Expected minus present camera centre, in camera axes (it grows with the translation)."""
    return state.translation + (state.rotation @ problem.centre[..., None])[..., 0]


def _fill_diagonal(matrix: Tensor) -> None:
    """Keep the diagonal off zero (an unseen point, an empty view): its unknowns then stay where they are."""
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    diagonal.masked_fill_(diagonal <= TINY, 1.0)


def step(system: Linearisation, state: States, damping: Float[Tensor, "b"], refine: tuple[Intrinsic, ...]) -> States:
    """The state after a step with Marquardt's damping on all unknowns; NaN where there is none."""
    b, n = system.camera.shape[:2]
    growth = 1 + damping
    camera, other = system.camera.clone(), system.other.clone()
    camera.diagonal(dim1=-2, dim2=-1).mul_(growth[:, None, None])
    other.diagonal(dim1=-2, dim2=-1).mul_(growth[:, None])
    factor = torch.linalg.cholesky_ex(camera).L
    identity = torch.eye(6, dtype=factor.dtype, device=factor.device)
    whitener = torch.linalg.solve_triangular(factor, identity.expand_as(factor), upper=False)
    whitened = (whitener @ system.coupling).flatten(1, 2)
    gradient = (whitener @ system.camera_gradient[..., None]).flatten(1)
    size = other.shape[-1]
    change = other.new_zeros(b, size)
    if size:
        reduced = other - whitened.mT @ whitened
        lower, trouble = torch.linalg.cholesky_ex(reduced)
        rhs = (whitened.mT @ gradient[..., None])[..., 0] - system.other_gradient
        change = torch.cholesky_solve(rhs[..., None], lower)[..., 0]
        change = torch.where((trouble == 0)[:, None], change, torch.nan)
    back = (gradient + (whitened @ change[..., None])[..., 0]).view(b, n, 6, 1)
    twist = -(whitener.mT @ back)[..., 0]
    turn = torch.matrix_exp(_skew(twist[..., :3]))
    points = size - len(refine)
    intrinsics = state.intrinsics.clone()
    for s, name in enumerate(refine):
        intrinsics[:, 0 if name == "focal" else 1] += change[:, points + s]
    moved = change[:, :points].view(b, 3, -1).mT if points else torch.zeros_like(state.points)
    return States(
        rotation=turn @ state.rotation,
        translation=(turn @ state.translation[..., None])[..., 0] + twist[..., 3:],
        points=state.points + moved,
        intrinsics=intrinsics,
    )


def _skew(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    x, y, z = vector.unbind(-1)
    none = torch.zeros_like(x)
    rows = [none, -z, y, z, none, -x, -y, x, none]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))
