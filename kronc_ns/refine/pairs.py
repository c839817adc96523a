"""Which views are compared, and how far from the epipolar line a match may lie."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from kronc_ns.geometry.poses import unit
from kronc_ns.geometry.rotations import skew
from kronc_ns.solve import bundle
from kronc_ns.solve.sightings import Sightings, Unknowns, gauge_of

_NEAREST = 8  # of a view: those seen from the nearest directions ...
_WITHIN_DEG = 45.0  # ... but for these angles, past which features look different
_SPARSE, _SPARSE_DEG = 8, 70.0  # with so few views there are none nearer
_FAR = 1e3  # times the distance of the car is as good as infinity
_LOOSE_RAD, _LOOSE_SHARE = 0.2, 0.2  # nobody's pose is off by more: rotation, centre as a share of the distance
_UNKNOWN_PX = 20.0


@dataclass(frozen=True)
class Bands:
    """Half widths, one standard deviation in pixels, across the epipolar lines of pairs of views."""

    at_car: Float[np.ndarray, "p"]
    far: Float[np.ndarray, "p"]
    """Of what is infinitely far."""


def view_angles(centre: Float[np.ndarray, "n 3"], middle: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n n"]:
    """Degrees between the directions from which any two views see the middle of the car."""
    direction = unit(centre - middle)
    return np.degrees(np.arccos(np.clip(direction @ direction.T, -1.0, 1.0)))


def choose_pairs(angles: Float[np.ndarray, "n n"], most: int = _NEAREST) -> Int[np.ndarray, "p 2"]:
    """Pairs (i < j) of each view and its nearest, each once, in order."""
    within = _SPARSE_DEG if len(angles) <= _SPARSE else _WITHIN_DEG
    apart = np.where(np.eye(len(angles), dtype=bool), np.inf, angles)
    nearest = np.argsort(apart, axis=1, kind="stable")[:, :most]
    view = np.broadcast_to(np.arange(len(angles))[:, None], nearest.shape)
    near = np.take_along_axis(apart, nearest, axis=1) <= within
    pairs = np.sort(np.stack([view[near], nearest[near]], axis=1), axis=1)
    return np.unique(pairs, axis=0)


def with_next(pairs: Int[np.ndarray, "p 2"], views: int) -> Int[np.ndarray, "q 2"]:
    """With the pairs of photos taken one after the other, which are neighbours wherever poses have them."""
    first = np.arange(views)
    following = np.sort(np.stack([first, (first + 1) % views], axis=1), axis=1)
    return np.unique(np.concatenate([pairs, following[following[:, 0] < following[:, 1]]]), axis=0)


def joint_covariance(data: Sightings, now: Unknowns, distance: Float[np.ndarray, "n"]) -> Float[np.ndarray, "f f"]:
    """Of all reduced unknowns together, in some gauge; views that nothing is known of get what can be believed.

    ``distance`` is that of each camera from the car.
    """
    matrix = bundle.normal_matrix(data, now)
    gauge = np.linalg.qr(gauge_of(now, len(matrix)))[0]
    matrix += np.trace(matrix) / len(matrix) * (gauge @ gauge.T)
    loose = np.repeat([[_LOOSE_RAD, _LOOSE_SHARE]], len(distance), axis=0) * np.stack(
        [np.ones_like(distance), distance], axis=1
    )
    views = np.arange(6 * len(distance))
    matrix[views, views] += np.repeat(loose, 3, axis=1).ravel() ** -2.0
    return np.linalg.inv(matrix)


def epipolar_bands(
    pairs: Int[np.ndarray, "p 2"],
    now: Unknowns,
    covariance: Float[np.ndarray, "f f"],
    middle: Float[np.ndarray, "3"],
    focal: float,
) -> Bands:
    """What the joint covariance of each pair lets a ray of the first view miss in the second, across its line.

    A view's own covariance would not do: most of it is common to neighbours and moves nothing between them.
    """
    i, j = pairs.T
    centre = -np.einsum("nji,nj->ni", now.rotation, now.translation)
    ahead, back = middle - centre[i], middle - centre[j]
    at_car = _across(pairs, now, covariance, centre[i] + ahead, focal)
    far = _across(pairs, now, covariance, centre[i] + _FAR * ahead, focal)
    turned = _across(pairs, now, covariance, centre[j] + _FAR * back, focal)
    far = np.where(np.isfinite(far), far, np.where(np.isfinite(turned), turned, at_car))
    return Bands(*(np.where(np.isfinite(band), band, _UNKNOWN_PX) for band in (at_car, far)))


def _across(
    pairs: Int[np.ndarray, "p 2"],
    now: Unknowns,
    covariance: Float[np.ndarray, "f f"],
    world: Float[np.ndarray, "p 3"],
    focal: float,
) -> Float[np.ndarray, "p"]:
    """Standard deviation of each world point across the line; inf where either view has it beside or behind it."""
    i, j = pairs.T
    r, t = now.rotation, now.translation
    in_i = np.einsum("pij,pj->pi", r[i], world) + t[i]
    in_j = np.einsum("pij,pj->pi", r[j], world) + t[j]
    length = np.linalg.norm(in_j, axis=1)
    visible = (in_i[:, 2] > 0.1 * np.linalg.norm(in_i, axis=1)) & (in_j[:, 2] > 0.1 * length)
    z = np.where(visible, in_j[:, 2], 1.0)
    by_point = np.zeros((len(pairs), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = focal / z
    by_point[:, :, 2] = -focal * in_j[:, :2] / z[:, None] ** 2
    identity = np.broadcast_to(np.eye(3), (len(pairs), 3, 3))
    by_j = by_point @ np.concatenate([-skew(in_j), identity], axis=2)
    by_i = -by_point @ r[j] @ r[i].transpose(0, 2, 1) @ np.concatenate([-skew(in_i), identity], axis=2)
    by_both = np.concatenate([by_i, by_j], axis=2)
    columns = np.concatenate([6 * i[:, None] + np.arange(6), 6 * j[:, None] + np.arange(6)], axis=1)
    joint = covariance[columns[:, :, None], columns[:, None, :]]
    spread = by_both @ joint @ by_both.transpose(0, 2, 1)
    centre_i = -np.einsum("pji,pj->pi", r[i], t[i])
    along = np.einsum("pij,pj->pi", by_point @ r[j], world - centre_i)
    across = unit(np.stack([-along[:, 1], along[:, 0]], axis=1))
    variance = np.einsum("pi,pij,pj->p", across, spread, across)
    return np.where(visible, np.sqrt(np.maximum(variance, 0.0)), np.inf)
