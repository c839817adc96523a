"""The world a solution stands in: the car's own axes and metres."""

import torch
from jaxtyping import Float
from torch import Tensor

from kronc_ns.geometry.alignment import Similarity, umeyama
from kronc_ns.geometry.rotations import skew, so3_exp
from kronc_ns.keypoints.schema import KeypointSchema
from kronc_ns.keypoints.template import CarTemplate

_OFF_M = 0.3  # points farther from the template than this say little about the frame


def rough_frame(points: Float[Tensor, "j 3"], template: CarTemplate) -> Similarity:
    """Similarity that brings points (NaN where unknown) near the template's mean; outliers count little."""
    known = points.isfinite().all(-1)
    source, mean = points[known], template.mean[known]
    similarity = umeyama(source, mean)
    for _ in range(2):
        off = (similarity.apply(source) - mean).norm(dim=-1)
        similarity = umeyama(source, mean, 1 / (1 + (off / _OFF_M).square()))
    return similarity


def template_frame(points: Float[Tensor, "j 3"], template: CarTemplate) -> Similarity:
    """Similarity that carries points (NaN where unknown) into the car's frame: metres, ground at z = 0.

    It makes the carried points as likely as it can under the template's shapes: Gauss-Newton on the Mahalanobis
    distance, from `rough_frame`.
    """
    similarity = rough_frame(points, template)
    known = points.isfinite().all(-1)
    source, mean = points[known], template.mean[known]
    index = (3 * known.nonzero() + torch.arange(3)).flatten()
    precision = torch.linalg.inv(template.covariance()[index][:, index])
    for _ in range(10):
        carried = similarity.apply(source)
        columns = [torch.eye(3, dtype=points.dtype).expand(len(source), 3, 3)]
        columns.append(-skew(carried))
        columns.append(carried[..., None])
        jacobian = torch.cat(columns, dim=-1).flatten(0, 1)
        weighted = jacobian.T @ precision
        step = torch.linalg.solve(weighted @ jacobian, weighted @ (mean - carried).flatten())
        growth, turn = step[6].exp(), so3_exp(step[3:6])
        similarity = Similarity(
            growth * similarity.scale,
            turn @ similarity.rotation,
            growth * turn @ similarity.translation + step[:3],
        )
    return similarity


def standing(
    schema: KeypointSchema, points: Float[Tensor, "j 3"], c2w: Float[Tensor, "n 3 4"], radius: float
) -> Similarity:
    """Frame of an object without a template: upright about its centre, cameras at mean distance ``radius``."""
    rotation = car_axes(schema, points, -c2w[..., 1].mean(0))
    turned = points[points.isfinite().all(-1)] @ rotation.T
    centre = rotation.T @ ((turned.amin(0) + turned.amax(0)) / 2)
    scale = radius / (c2w[..., 3] - centre).norm(dim=-1).mean()
    return Similarity(scale, rotation, -scale * rotation @ centre)


def car_axes(
    schema: KeypointSchema, points: Float[Tensor, "j 3"], camera_up: Float[Tensor, "3"]
) -> Float[Tensor, "3 3"]:
    """Rotation whose rows are the car's forward, left and up directions in the solver's world.

    Left comes from the mirror pairs, forward from the wheel bases; with an unknown schema up is the cameras' mean
    up and the heading is arbitrary. NaN points are ignored.
    """
    up = torch.nn.functional.normalize(camera_up, dim=0)
    pairs = torch.tensor(schema.mirror_pairs, dtype=torch.long).reshape(-1, 2)
    across = points[pairs[:, 0]] - points[pairs[:, 1]]
    across = across[across.isfinite().all(-1)]
    if len(across):
        left = torch.nn.functional.normalize(torch.nn.functional.normalize(across, dim=-1).mean(0), dim=0)
    else:
        helper = torch.eye(3, dtype=points.dtype)[int(up.abs().argmin())]
        left = torch.nn.functional.normalize(torch.linalg.cross(up, helper), dim=0)
    forward = torch.linalg.cross(left, up)
    if schema.wheels:
        left_front, right_front, left_rear, right_rear = points[list(schema.wheels)]
        bases = torch.stack([left_front - left_rear, right_front - right_rear])
        bases = bases[bases.isfinite().all(-1)]
        if len(bases):
            forward = bases.mean(0)
    forward = torch.nn.functional.normalize(forward - (forward @ left) * left, dim=0)
    return torch.stack([forward, left, torch.linalg.cross(forward, left)])
