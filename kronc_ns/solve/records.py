"""A problem, an estimate and the system between them, as compiled loops take them.

The K detections of a scene stand in a row, view by view: those of view n are ``first[n]:first[n + 1]``. All arrays are
contiguous: other strides would be compiled anew.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kronc_ns.solve.problem import Problem, State

Array = NDArray[Any]


class Measured(NamedTuple):
    """A `Problem` as compiled loops take it: K detections in a row, priors of length 0 where there are none."""

    first: Array
    """[N + 1]"""
    joint: Array
    """[K] which point"""
    uv: Array
    """[2, K]"""
    own: Array
    """[K] weight"""
    focal: Array
    """[2]"""
    lens: Array
    """[N] which of G lenses"""
    mean: Array
    """[3J] of the shape prior"""
    precision: Array
    """[3J, 3J]"""
    freedom: float
    centre: Array
    """[N, 3] expected camera centres"""
    strength: Array
    """[N] their inverse variance"""
    points_known: bool
    with_focal: bool
    with_k1: bool


class Estimate(NamedTuple):
    """The unknowns, and what follows from them."""

    rotation: Array
    """[N, 3, 3] world to camera"""
    translation: Array
    """[N, 3]"""
    points: Array
    """[J, 3]"""
    intrinsics: Array
    """[G, 2]: logarithm of the focal length's factor, k1"""
    seen: Array
    """[3, K]: place in the image plane, 1 / z"""
    error: Array
    """[2, K]: projection minus detection in pixels; 0 behind the camera"""
    length: Array
    """[K]: its weighted length; `BEHIND_PX` behind the camera"""
    pull: Array
    """[3J] half the gradient of the surprise"""
    surprise: Array
    """[1]: squared Mahalanobis distance of the points under the shape prior"""


class System(NamedTuple):
    """Room for the reduced system, and what is needed to get back to the cameras."""

    weight: Array
    """[K] IRLS weights times the detections' own"""
    order: Array
    """[K] scratch"""
    whitener: Array
    """[N, 6, 6]: inverse Cholesky factors of the cameras' blocks"""
    gradient: Array
    """[N, 6]: the cameras' gradients, times those"""
    coupling: Array
    """Cameras against the other unknowns that they see, times those, view by view: six rows of its points' x, y and z
    (none if they are known) and its lens's refined intrinsics"""
    matrix: Array
    """[P, P], lower triangle"""
    rhs: Array
    """[P]; the change of the unknowns, once solved"""


def measured(problem: Problem) -> Measured:
    """A problem with its detections in a row, contiguous as all arrays: other strides would be compiled anew."""
    view, joint = np.nonzero(problem.weight > 0)
    views = len(problem.weight)
    first = np.zeros(views + 1, np.int64)
    np.cumsum(np.bincount(view, minlength=views), out=first[1:])
    shape, orbit = problem.shape, problem.orbit
    return Measured(
        first,
        np.ascontiguousarray(joint),
        np.ascontiguousarray(problem.uv[view, joint].T),
        problem.weight[view, joint],
        np.array(problem.focal),
        np.zeros(views, np.int64) if problem.lens is None else problem.lens.astype(np.int64),
        np.empty(0) if shape is None else np.ascontiguousarray(shape.mean),
        np.empty((0, 0)) if shape is None else np.ascontiguousarray(shape.precision),
        1.0 if shape is None else shape.freedom,
        np.empty((0, 3)) if orbit is None else np.ascontiguousarray(orbit.centre),
        np.empty(0) if orbit is None else 1.0 / np.square(orbit.sigma),
        problem.points_known,
        "focal" in problem.refine,
        "k1" in problem.refine,
    )


def estimate(data: Measured, state: State) -> Estimate:
    """Room for an estimate, at a state."""
    count = len(data.joint)
    return Estimate(
        np.array(state.rotation, order="C"),
        np.array(state.translation, order="C"),
        np.array(state.points, order="C"),
        _intrinsics(data, state),
        np.empty((3, count)),
        np.empty((2, count)),
        np.empty(count),
        np.zeros(state.points.size),
        np.zeros(1),
    )


def system(data: Measured, views: int, joints: int) -> System:
    """Room for the system of a problem."""
    lenses, refined = int(data.lens.max(initial=0)) + 1, data.with_focal + data.with_k1
    size = (0 if data.points_known else 3 * joints) + lenses * refined
    coupled = (0 if data.points_known else 3 * len(data.joint)) + views * refined
    return System(
        np.empty(len(data.joint)),
        np.empty(len(data.joint)),
        np.empty((views, 6, 6)),
        np.empty((views, 6)),
        np.empty(6 * coupled),
        np.empty((size, size)),
        np.empty(size),
    )


def _intrinsics(data: Measured, state: State) -> Array:
    """Of every lens; a single number is that of all."""
    values = np.empty((int(data.lens.max(initial=0)) + 1, 2))
    values[:, 0], values[:, 1] = state.log_growth, state.k1
    return values
