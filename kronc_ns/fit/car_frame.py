"""The world a solution stands in: the car's own axes and metres."""

import math

import numpy as np
from jaxtyping import Float

from kronc_ns.geometry.alignment import Similarity, umeyama
from kronc_ns.geometry.poses import unit
from kronc_ns.geometry.rotations import skew, so3_exp
from kronc_ns.keypoints.schema import KeypointSchema
from kronc_ns.keypoints.template import CarTemplate

_OFF_M = 0.3  # points farther from the template than this say little about the frame


def rough_frame(points: Float[np.ndarray, "j 3"], template: CarTemplate) -> Similarity:
    """Similarity that brings points (NaN where unknown) near the template's mean; outliers count little."""
    known = np.isfinite(points).all(-1)
    source, mean = points[known], template.mean[known]
    similarity = umeyama(source, mean)
    for _ in range(2):
        off = np.linalg.norm(similarity.apply(source) - mean, axis=-1)
        similarity = umeyama(source, mean, 1 / (1 + (off / _OFF_M) ** 2))
    return similarity


def template_frame(points: Float[np.ndarray, "j 3"], template: CarTemplate) -> Similarity:
    """Similarity that carries points (NaN where unknown) into the car's frame: metres, ground at z = 0.

    It makes the carried points as likely as it can under the template's shapes: Gauss-Newton on the Mahalanobis
    distance, from `rough_frame`.
    """
    similarity = rough_frame(points, template)
    known = np.isfinite(points).all(-1)
    source, mean = points[known], template.mean[known]
    index = np.flatnonzero(known.repeat(3))
    precision = np.linalg.inv(template.covariance()[np.ix_(index, index)])
    for _ in range(10):
        carried = similarity.apply(source)
        shift = np.broadcast_to(np.eye(3), (len(source), 3, 3))
        jacobian = np.concatenate([shift, -skew(carried), carried[..., None]], axis=-1).reshape(-1, 7)
        weighted = jacobian.T @ precision
        step = np.linalg.solve(weighted @ jacobian, weighted @ (mean - carried).ravel())
        growth, turn = math.exp(step[6]), so3_exp(step[3:6])
        similarity = Similarity(
            growth * similarity.scale,
            turn @ similarity.rotation,
            growth * turn @ similarity.translation + step[:3],
        )
    return similarity


def standing(
    schema: KeypointSchema, points: Float[np.ndarray, "j 3"], c2w: Float[np.ndarray, "n 3 4"], radius: float
) -> Similarity:
    """Frame of an object without a template: upright about its centre, cameras at mean distance ``radius``."""
    rotation = car_axes(schema, points, -c2w[..., 1].mean(0))
    turned = points[np.isfinite(points).all(-1)] @ rotation.T
    centre = rotation.T @ ((turned.min(0) + turned.max(0)) / 2)
    scale = radius / float(np.linalg.norm(c2w[..., 3] - centre, axis=-1).mean())
    return Similarity(scale, rotation, -scale * rotation @ centre)


def car_axes(
    schema: KeypointSchema, points: Float[np.ndarray, "j 3"], camera_up: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """Rotation whose rows are the car's forward, left and up directions in the solver's world.

    Left comes from the mirror pairs, forward from the wheel bases; with an unknown schema up is the cameras' mean
    up and the heading is arbitrary. NaN points are ignored.
    """
    up = unit(camera_up)
    pairs = np.array(schema.mirror_pairs, dtype=int).reshape(-1, 2)
    across = points[pairs[:, 0]] - points[pairs[:, 1]]
    across = across[np.isfinite(across).all(-1)]
    left = unit(unit(across).mean(0)) if len(across) else unit(np.cross(up, np.eye(3)[np.abs(up).argmin()]))
    forward = np.cross(left, up)
    if schema.wheels:
        left_front, right_front, left_rear, right_rear = points[list(schema.wheels)]
        bases = np.stack([left_front - left_rear, right_front - right_rear])
        bases = bases[np.isfinite(bases).all(-1)]
        if len(bases):
            forward = bases.mean(0)
    forward = unit(forward - (forward @ left) * left)
    return np.stack([forward, left, np.cross(forward, left)])
