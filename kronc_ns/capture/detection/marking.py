"""Pictures of what a detector found: the car's own left orange, its right blue, large where the place is unsure."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from PIL import Image

from kronc_ns.capture.detection.pixels import on_white, shrink
from kronc_ns.capture.images import load_small
from kronc_ns.files.output import atomic_path
from kronc_ns.keypoints.schema import KeypointSchema

_LONG_SIDE = 1280
_LEFT, _RIGHT, _NEITHER = (255, 140, 0), (0, 130, 255), (60, 200, 60)
_SMALLEST_PX = 2.5
_QUALITY = 88


def write_marked(
    target: Path,
    image: Path,
    size: tuple[int, int],
    schema: KeypointSchema,
    rows: Float[np.ndarray, "j 3"],
    sigma_px: Float[np.ndarray, "j"] | None = None,
) -> None:
    """Write ``image`` with the points (u, v, confidence) on it, each with its index, as JPEG.

    ``size`` is the (width, height) that the points are in.
    """
    small, _ = shrink(np.asarray(on_white(load_small(image, _LONG_SIDE))), _LONG_SIDE)
    drawn, scale = small.copy(), small.shape[1] / size[0]
    right = {schema.flip[j] for j in schema.left}
    for j in np.flatnonzero(rows[:, 2] > 0):
        colour = _LEFT if j in schema.left else _RIGHT if j in right else _NEITHER
        radius = max(_SMALLEST_PX, scale * float(sigma_px[j]) if sigma_px is not None else 0.0)
        u, v = scale * rows[j, :2] - 0.5  # cv2 counts from pixel centres
        centre = (round(16 * u), round(16 * v))  # in sixteenths of a pixel
        cv2.circle(drawn, centre, round(16 * (radius + 1)), (0, 0, 0), 1, cv2.LINE_AA, shift=4)
        cv2.circle(drawn, centre, round(16 * radius), colour, 2, cv2.LINE_AA, shift=4)
        corner = (round(u + radius + 2), round(v - radius))
        for width, ink in ((3, (0, 0, 0)), (1, colour)):
            cv2.putText(drawn, str(j), corner, cv2.FONT_HERSHEY_SIMPLEX, 0.5, ink, width, cv2.LINE_AA)
    with atomic_path(target) as temporary:
        Image.fromarray(drawn).save(temporary, quality=_QUALITY)
