"""Where the second-order solver may start: given poses, circles, or a car template found in every view by itself."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from kronc_ns.frame import rough_frame
from kronc_ns.geometry.camera import rays
from kronc_ns.geometry.poses import invert
from kronc_ns.init import Direction, circular_poses, triangulate
from kronc_ns.keypoints.schema import KeypointSchema
from kronc_ns.keypoints.template import car_template
from kronc_ns.options import KroncConfig
from kronc_ns.scene import Scene
from kronc_ns.solve.resection import AWAY, locate

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
"""Mean cost of a view's detections (see `locate`) from which on its pose says nothing."""
_SWAP_GAIN = 0.7  # a view is taken for left-right swapped where that lowers its cost below this share


@dataclass(frozen=True)
class Start:
    """Where the solver may start."""

    name: str
    scene: Scene
    """Keypoints with left and right put right, as far as that is known."""
    c2w: Float[Tensor, "n 3 4"]
    points: Float[Tensor, "j 3"]
    used: Bool[Tensor, "n"]
    """Views that take part."""
    swapped: Bool[Tensor, "n"]
    """Views whose detections had left and right confused."""


def usable_views(scene: Scene) -> Bool[Tensor, "n"]:
    """Views with enough keypoints to be solved."""
    return scene.visibility.sum(1) >= MIN_POINTS


def start_from_poses(name: str, scene: Scene, c2w: Float[Tensor, "n 3 4"]) -> Start:
    """Start at given poses; carried into the car's frame where there is a template."""
    used = usable_views(scene)
    m = scene.visibility * used[:, None]
    points = triangulate(c2w, rays(scene.uv, scene.camera), m)
    template = car_template(scene.schema)
    if template is not None:
        known = m.sum(0) >= 2
        frame = rough_frame(torch.where(known[:, None], points, math.nan), template)
        c2w = frame.apply_to_poses(c2w)
        points = torch.where(known[:, None], frame.apply(points), template.mean)
    return Start(name, scene, c2w, points, used, torch.zeros_like(used))


def start_from_template(scene: Scene) -> Start:
    """Start at the template's pose in each view by itself; left and right are put right where that fits better."""
    template = car_template(scene.schema)
    assert template is not None
    used = usable_views(scene)
    c2w, cost, swapped = locate_views(scene, template.mean, used, None)
    keypoints = torch.where(swapped[:, None, None], mirrored(scene.keypoints, scene.schema), scene.keypoints)
    return Start(
        "template",
        replace(scene, keypoints=keypoints),
        c2w,
        template.mean.clone(),
        used & (cost < LOST),
        swapped,
    )


def circles(scene: Scene, config: KroncConfig) -> list[Start]:
    """Starts at level circles: as the options say and, with ``init="auto"``, both ways and other shares of a lap."""
    asked: tuple[Direction, float] = (config.direction, config.laps)
    kinds = (asked, *(kind for kind in _CIRCLES if kind != asked)) if config.init == "auto" else (asked,)
    return [
        start_from_poses(
            "circular" if config.init == "circular" else f"circular ({way}, {laps:g} lap{'s' if laps > 1 else ''})",
            scene,
            circular_poses(len(scene), config.radius_m, way, laps),
        )
        for way, laps in kinds
    ]


def mirrored(keypoints: Float[Tensor, "n j 3"], schema: KeypointSchema) -> Float[Tensor, "n j 3"]:
    """Detections with left and right exchanged."""
    return keypoints[:, torch.tensor(schema.flip)]


def locate_views(
    scene: Scene, points: Float[Tensor, "j 3"], chosen: Bool[Tensor, "n"], sigma_px: float | None
) -> tuple[Float[Tensor, "n 3 4"], Float[Tensor, "n"], Bool[Tensor, "n"]]:
    """Pose, cost and whether left and right are swapped, of the chosen views by themselves (others: NaN, inf, no)."""
    template, camera = car_template(scene.schema), scene.camera
    c2w = torch.full((len(scene), 3, 4), math.nan, dtype=torch.float64)
    cost = torch.full((len(scene),), math.inf, dtype=torch.float64)
    swapped = torch.zeros(len(scene), dtype=torch.bool)
    index = chosen.nonzero()[:, 0]
    if not len(index):
        return c2w, cost, swapped
    has_sides = any(j != f for j, f in enumerate(scene.schema.flip))
    variants = [scene.keypoints[index]]
    if has_sides:
        variants.append(mirrored(scene.keypoints[index], scene.schema))
    detected = torch.cat(variants)
    m = detected[..., 2] > 0
    uv = camera.undistort(detected[..., :2]) - torch.tensor([camera.cx, camera.cy], dtype=torch.float64)
    if sigma_px is None:
        spread = torch.where(m[..., None], uv, -math.inf).amax(1) - torch.where(m[..., None], uv, math.inf).amin(1)
        tolerance = _TEMPLATE_TOLERANCE * spread.amax(1)
    else:
        tolerance = torch.full((len(detected),), TOLERANCE_SIGMAS * sigma_px, dtype=torch.float64)
    focal = torch.tensor([camera.fx, camera.fy], dtype=torch.float64)
    found = locate(
        points.expand(len(detected), -1, -1),
        uv.transpose(1, 2).contiguous(),
        m.to(torch.float64),
        focal.expand(len(detected), 2),
        tolerance,
        None if template is None else template.normals,
        exact=sigma_px is not None,
    )
    poses, costs = invert(found.w2c).unflatten(0, (len(variants), -1)), found.cost.view(len(variants), -1)
    flipped = costs[-1] < _SWAP_GAIN * costs[0]
    c2w[index] = torch.where(flipped[:, None, None], poses[-1], poses[0])
    cost[index] = torch.where(flipped, costs[-1], costs[0])
    swapped[index] = flipped
    return c2w, cost, swapped


def in_front(start: Start) -> Bool[Tensor, "n j"]:
    """Whether each point lies before each camera."""
    return ((start.points - start.c2w[:, None, :, 3]) * start.c2w[:, None, :, 2]).sum(-1) > 0


def far_side(start: Start) -> Bool[Tensor, "n j"]:
    """Whether each point looks away from each camera; never, where the schema has no template."""
    template = car_template(start.scene.schema)
    if template is None:
        return torch.zeros(len(start.scene), len(start.scene.schema), dtype=torch.bool)
    ray = start.c2w[:, None, :, 3] - start.points
    return (ray * template.normals).sum(-1) < AWAY * ray.norm(dim=-1)
