"""Detected and solved keypoints over the images of a few views, as data for SVG."""

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from PIL import Image

from kronc_ns.geometry.camera import Camera
from kronc_ns.geometry.poses import invert
from kronc_ns.scene import Scene
from kronc_ns.show.report.templates import render, source
from kronc_ns.solution import Solution, ViewStatus

_EACH = 3
"""Views of each kind that are shown."""
_LONGER_SIDE_PX = 900
_QUALITY = 82
_MARGIN = 0.3
"""Room around the keypoints, as a share of their own extent."""

Box = tuple[int, int, int, int]
"""Left, top, right and bottom in pixels."""


@dataclass(frozen=True)
class Mark:
    """A detection (u, v), and the solved point's place in the image where there is one; in pixels."""

    name: str
    u: float
    v: float
    solved: tuple[float, float] | None
    error_px: float | None
    kind: Literal["explained", "odd", "lone"]
    """Met by a solved point, missed by it, or of a keypoint (or view) that was not solved."""


@dataclass(frozen=True)
class Overlay:
    """What is drawn of one view."""

    kind: str
    name: str
    caption: str
    box: Box
    """The part of the image that is shown."""
    image: str
    """That part as JPEG in a data URI; empty where there is no image."""
    marks: Sequence[Mark]
    skeleton: Sequence[tuple[float, float, float, float]]
    """Lines (u, v, u, v) between solved points that are seen in the view."""


def choose_views(solution: Solution) -> list[tuple[str, int]]:
    """(kind, index) of the solved views with the largest and the median error, and of views that were not solved."""
    views = solution.views
    solved = [i for i, view in enumerate(views) if view.status is ViewStatus.SOLVED]
    ranked = sorted(solved, key=lambda i: (-(views[i].rmse_px or 0.0), i))
    worst, rest = ranked[:_EACH], ranked[_EACH:]
    first = max(0, min(len(ranked) // 2 - _EACH // 2 - len(worst), len(rest) - _EACH))
    others = [i for i in range(len(views)) if views[i].status is not ViewStatus.SOLVED]
    others = sorted(others, key=lambda i: (-views[i].visible, i))[:_EACH]
    return [
        *(("worst", i) for i in worst),
        *(("median", i) for i in rest[first : first + _EACH]),
        *((views[i].status.value, i) for i in others),
    ]


def overlay(
    kind: str, i: int, scene: Scene, solution: Solution, inlier: Bool[np.ndarray, "n j"], folder: Path
) -> Overlay:
    """View ``i`` of a solution that lies in ``folder``."""
    view, keypoints = solution.views[i], scene.keypoints[i]
    camera = solution.camera_of(i)
    projected = _projected(solution.points, solution.c2w[i], camera)
    seen = keypoints[:, 2] > 0
    met = seen & np.isfinite(projected).all(1)
    error = np.linalg.norm(projected - keypoints[:, :2], axis=1)
    marks = [
        Mark(
            name=scene.schema.keypoints[j],
            u=float(keypoints[j, 0]),
            v=float(keypoints[j, 1]),
            solved=(float(projected[j, 0]), float(projected[j, 1])) if met[j] else None,
            error_px=float(error[j]) if met[j] else None,
            kind="lone" if not met[j] else "explained" if inlier[i, j] else "odd",
        )
        for j in np.flatnonzero(seen)
    ]
    lines = [(*projected[a].tolist(), *projected[b].tolist()) for a, b in scene.schema.skeleton if met[a] and met[b]]
    caption = f"{view.inliers} of {view.visible} keypoints explained"
    if view.rmse_px is not None:
        caption = f"RMSE {view.rmse_px:.2f} px, {caption}"
    box = _around(np.concatenate([keypoints[seen, :2], projected[inlier[i]]]), camera)
    return Overlay(
        kind, view.name, view.reason or caption, box, _picture(folder / scene.names[i], box, camera), marks, lines
    )


def overlay_svg(shown: Overlay) -> str:
    """The overlay as an SVG file of its own."""
    return render("overlay.svg", view=shown, own_style=source("overlay.css"))


def _around(uv: Float[np.ndarray, "m 2"], camera: Camera) -> Box:
    """The smallest part of the image, of its proportions, that holds the pixels with a margin."""
    size = np.array([camera.width, camera.height])
    if not len(uv):
        return (0, 0, camera.width, camera.height)
    low, high = uv.min(0), uv.max(0)
    share = min(1.0, float(((high - low) * (1 + 2 * _MARGIN) / size).max()))
    part = np.maximum(np.round(share * size), 1)
    corner = np.clip(np.round((low + high - part) / 2), 0, size - part)
    left, top, right, bottom = (int(x) for x in (*corner, *(corner + part)))
    return (left, top, right, bottom)


def _projected(
    points: Float[np.ndarray, "j 3"], c2w: Float[np.ndarray, "3 4"], camera: Camera
) -> Float[np.ndarray, "j 2"]:
    """Pixels of the points in the image as taken, lens distortion included; NaN behind the camera or where unknown."""
    import cv2

    pixels = np.full((len(points), 2), np.nan)
    w2c = invert(c2w)
    z = points @ w2c[2, :3] + w2c[2, 3]
    front = z > 0
    if front.any():
        rotation, _ = cv2.Rodrigues(w2c[:, :3])
        found, _ = cv2.projectPoints(points[front], rotation, w2c[:, 3], camera.matrix, np.array(camera.distortion))
        pixels[front] = found[:, 0]
    return pixels


def load_image(path: Path, longer_side_px: int, part: tuple[float, ...] = (0, 0, 1, 1)) -> Image.Image | None:
    """An image on white, no larger than asked; None where there is none that can be read.

    ``part`` is what to cut out: left, top, right and bottom as shares of width and height.
    """
    try:
        with Image.open(path) as file:
            if part == (0, 0, 1, 1):
                file.thumbnail((longer_side_px, longer_side_px))  # lets JPEG skip most of its work
            image = file.convert("RGBA")
    except (OSError, ValueError):
        return None
    image = image.crop([round(x * size) for x, size in zip(part, image.size * 2, strict=True)])
    image.thumbnail((longer_side_px, longer_side_px))
    return Image.alpha_composite(Image.new("RGBA", image.size, "white"), image).convert("RGB")


def _picture(path: Path, box: Box, camera: Camera) -> str:
    part = tuple(x / size for x, size in zip(box, (camera.width, camera.height) * 2, strict=True))
    image = load_image(path, _LONGER_SIDE_PX, part)
    if image is None:
        return ""
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=_QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")
