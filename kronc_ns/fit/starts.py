"""Where the second-order solver may start: given poses, circles, or a car template found in every view by itself."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from kronc_ns.fit.car_frame import rough_frame
from kronc_ns.fit.options import Direction, KroncConfig
from kronc_ns.geometry.camera import lengths, rays, reproject
from kronc_ns.geometry.poses import invert, look_at
from kronc_ns.geometry.triangulation import triangulate
from kronc_ns.keypoints.template import car_template
from kronc_ns.scene import Scene
from kronc_ns.solve.resection import AWAY, Views, locate

MIN_POINTS = 4
"""A view with fewer keypoints cannot be placed by them alone (three points have up to four poses)."""
_CIRCLES: tuple[tuple[Direction, float], ...] = (
    ("ccw", 1.0), ("cw", 1.0), ("ccw", 0.5), ("cw", 0.5), ("ccw", 1.5), ("cw", 1.5), ("ccw", 0.25), ("cw", 0.25),
    ("ccw", 0.75), ("cw", 0.75), ("ccw", 1.25), ("cw", 1.25), ("ccw", 2.0), ("cw", 2.0),
)  # fmt: skip
_TEMPLATE_TOLERANCE = 0.03  # of the car's extent in the image: about 13 cm on the car
TOLERANCE_SIGMAS = 3.0
"""What a detection may be off its solved point, in standard deviations, to count as met by half."""
LOST = 0.8
"""Mean cost of a view's detections (see `solve.resection`) from which on its pose says nothing."""
SWAP_GAIN = 0.7
"""A view is taken for left-right swapped where that lowers its cost below this share."""

Kind = Literal["given", "template", "circular"]


@dataclass(frozen=True)
class Hypothesis:
    """Where cameras and points may be: what the solver starts from, and what it finds."""

    kind: Kind
    name: str
    scene: Scene
    """Keypoints with left and right put right, as far as that is known."""
    c2w: Float[np.ndarray, "n 3 4"]
    points: Float[np.ndarray, "j 3"]
    used: Bool[np.ndarray, "n"]
    """Views that take part."""
    swapped: Bool[np.ndarray, "n"]
    """Views whose detections had left and right confused."""

    @cached_property
    def off_px(self) -> Float[np.ndarray, "n j 2"]:
        """Every point's projection less its detection; inf behind a camera, NaN where either has no place."""
        return reproject(self.points, self.c2w, self.scene.camera) - self.scene.uv

    @cached_property
    def error_px(self) -> Float[np.ndarray, "n j"]:
        """Distance of every detection from its point; inf behind a camera and where either has no place."""
        error = lengths(self.off_px)
        return np.where(np.isnan(error), np.inf, error)

    @cached_property
    def far_side(self) -> Bool[np.ndarray, "n j"]:
        """Whether each point looks away from each camera; never, where the schema has no template."""
        centre, points, outward = self.c2w[..., 3], self.points, normals(self.scene)
        facing = centre @ outward.T - (points * outward).sum(1)
        distance = (centre**2).sum(1)[:, None] - 2 * centre @ points.T + (points**2).sum(1)
        return facing < AWAY * np.sqrt(np.maximum(distance, 0.0))


def normals(scene: Scene) -> Float[np.ndarray, "j 3"]:
    """Outward normals of the surface at the points; zero where the schema has no template."""
    template = car_template(scene.schema)
    return np.zeros((len(scene.schema), 3)) if template is None else template.normals


def usable_views(scene: Scene) -> Bool[np.ndarray, "n"]:
    """Views with enough keypoints to be solved."""
    return scene.visible >= MIN_POINTS


def circular_poses(
    views: int, radius_m: float = 4.0, direction: Direction = "ccw", laps: float = 1.0
) -> Float[np.ndarray, "n 3 4"]:
    """The paper's coarse trajectory (section 5.2): a level circle about the z axis, all cameras facing it, no tilt.

    View i stands at azimuth ``360 * laps * i / views`` degrees, counterclockwise seen from above by default.
    OpenCV c2w.
    """
    azimuth = np.arange(views) * (2 * math.pi * laps / views)
    if direction == "cw":
        azimuth = -azimuth
    centres = radius_m * np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(views)], axis=1)
    return look_at(centres, np.zeros_like(centres), np.array([0.0, 0.0, 1.0]))


def start_from_poses(kind: Kind, name: str, scene: Scene, c2w: Float[np.ndarray, "n 3 4"]) -> Hypothesis:
    """Start at given poses; carried into the car's frame where there is a template."""
    used = usable_views(scene)
    m = scene.visibility * used[:, None]
    points = triangulate(c2w, rays(scene.uv, scene.camera), m)
    template = car_template(scene.schema)
    if template is not None:
        known = m.sum(0) >= 2
        frame = rough_frame(np.where(known[:, None], points, math.nan), template)
        c2w = frame.apply_to_poses(c2w)
        points = np.where(known[:, None], frame.apply(points), template.mean)
    return Hypothesis(kind, name, scene, c2w, points, used, np.zeros_like(used))


def start_from_template(scene: Scene) -> Hypothesis:
    """Start at the template's pose in each view by itself; left and right are put right where that fits better."""
    template = car_template(scene.schema)
    assert template is not None
    used = usable_views(scene)
    c2w, cost, swapped = locate_views(scene, template.mean, used, None)
    scene = scene.with_sides_swapped(swapped)
    return Hypothesis("template", "template", scene, c2w, template.mean, used & (cost < LOST), swapped)


def circles(scene: Scene, config: KroncConfig) -> list[Hypothesis]:
    """Starts at level circles: as the options say and, with ``init="auto"``, both ways and other shares of a lap."""
    asked: tuple[Direction, float] = (config.direction, config.laps)
    kinds = (asked, *(kind for kind in _CIRCLES if kind != asked)) if config.init == "auto" else (asked,)
    return [
        start_from_poses(
            "circular",
            "circular" if config.init == "circular" else f"circular ({way}, {laps:g} lap{'s' if laps > 1 else ''})",
            scene,
            circular_poses(len(scene), config.radius_m, way, laps),
        )
        for way, laps in kinds
    ]


def single_views(
    scene: Scene, points: Float[np.ndarray, "j 3"], chosen: Bool[np.ndarray, "n"], sigma_px: float | None
) -> Views:
    """The chosen views, each by itself; ``sigma_px`` is the noise where the points are solved, None: guessed."""
    camera, seen = scene.camera, scene.seen[chosen]
    uv = scene.uv[chosen] - (camera.cx, camera.cy)
    if sigma_px is None:
        where = seen[..., None]
        spread = np.where(where, uv, -np.inf).max(1) - np.where(where, uv, np.inf).min(1)
        tolerance = _TEMPLATE_TOLERANCE * spread.max(1)
    else:
        tolerance = np.full(len(uv), TOLERANCE_SIGMAS * sigma_px)
    label = np.broadcast_to(np.arange(len(scene.schema)), seen.shape)
    focal = (camera.fx, camera.fy)
    return Views(uv, scene.visibility[chosen], points, label, focal, tolerance, normals(scene))


def locate_views(
    scene: Scene,
    points: Float[np.ndarray, "j 3"],
    chosen: Bool[np.ndarray, "n"],
    sigma_px: float | None,
) -> tuple[Float[np.ndarray, "n 3 4"], Float[np.ndarray, "n"], Bool[np.ndarray, "n"]]:
    """Pose, cost and whether left and right are swapped, of the chosen views by themselves (others: NaN, inf, no)."""
    c2w, cost = np.full((len(scene), 3, 4), math.nan), np.full(len(scene), math.inf)
    swapped = np.zeros(len(scene), dtype=bool)
    count = int(chosen.sum())
    if not count:
        return c2w, cost, swapped
    views = single_views(scene, points, chosen, sigma_px)
    flip = np.array(scene.schema.flip)
    variants = [views.label, flip[views.label]] if (flip != np.arange(len(flip))).any() else [views.label]
    twice = len(variants)
    both = Views(
        np.concatenate([views.uv] * twice),
        np.concatenate([views.weight] * twice),
        points,
        np.concatenate(variants),
        views.focal,
        np.concatenate([views.tolerance_px] * twice),
        views.normals,
    )
    rival = None if twice == 1 else np.roll(np.arange(twice * count), count)
    found = locate(both, sigma_px is not None, rival)
    flipped = found.cost[-count:] < SWAP_GAIN * found.cost[:count]
    index = np.flatnonzero(chosen)
    best = np.arange(count) + np.where(flipped, (twice - 1) * count, 0)
    c2w[index], cost[index], swapped[index] = invert(found.w2c[best]), found.cost[best], flipped
    return c2w, cost, swapped
