"""The covariance at the minimum of a bundle adjustment whose noise is not what the weights say (Huber, 1967)."""

from typing import Any

import numpy as np
from jaxtyping import Float

from kronc_ns.solve.compiled import compiled
from kronc_ns.solve.elimination import Reduced, columns_of, reduce, sighting
from kronc_ns.solve.sightings import Sightings, Unknowns


def sandwich(data: Sightings, now: Unknowns) -> tuple[Float[np.ndarray, "f f"], Float[np.ndarray, "f f"]]:
    """What the covariance at a minimum is made of (Huber, 1967): the reduced system with the loss's own curvature, and
    the summed outer products of what each point pulls the reduced unknowns by.

    The sightings of one point may err together. The curvature of Cauchy's loss is, on average over directions, its IRLS
    weight squared: with the weight itself covariances would come out too small.
    """
    room, scores = Reduced.of(data), np.zeros((data.unknowns, data.unknowns))
    reduce(data, now, 0.0, True, room)
    _scores(data, now, room, scores)
    return room.matrix[0], scores


@compiled
def _scores(data: Any, now: Any, room: Any, out: Any) -> None:
    """Outer products of the points' pulls on the reduced unknowns."""
    intrinsics = int(data.with_focal) + int(data.with_k1)
    width, most = 6 + intrinsics, 1
    for p in range(len(data.first) - 1):
        most = max(most, data.first[p + 1] - data.first[p])
    camera, point, off = np.empty((2, 8)), np.empty((2, 3)), np.empty(3)
    pulls, columns = np.empty((most, 8)), np.empty((most, 8), np.int64)
    shift = np.empty(3)
    for p in range(len(data.first) - 1):
        begin, end = data.first[p], data.first[p + 1]
        inverse, pull = room.inverse[p], room.pull[p]
        for c in range(3):
            shift[c] = inverse[c, 0] * pull[0] + inverse[c, 1] * pull[1] + inverse[c, 2] * pull[2]
        for o in range(begin, end):
            weight = sighting(data, now, p, o, camera, point, off)
            columns_of(data, o, intrinsics, columns[o - begin])
            for k in range(width):
                own = weight * (camera[0, k] * off[0] + camera[1, k] * off[1]) if weight > 0.0 else 0.0
                w = room.mixed[o]
                pulls[o - begin, k] = own - (w[0, k] * shift[0] + w[1, k] * shift[1] + w[2, k] * shift[2])
        for i in range(end - begin):
            for j in range(end - begin):
                for k in range(width):
                    row, own = out[columns[i, k]], pulls[i, k]
                    for m in range(width):
                        row[columns[j, m]] += own * pulls[j, m]
