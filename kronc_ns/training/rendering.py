"""Pictures of cars by casting rays: paint, glass one can see into, lamps, shadows, surroundings.

Rays are cast by embree, light is added up by `shading`. World axes as everywhere: x forward, y left, z up, ground at
z = 0, metres.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from kronc_ns.geometry.poses import unit
from kronc_ns.training.appearance import Look
from kronc_ns.training.cameras import SIZE, Shot
from kronc_ns.training.lighting import Surroundings
from kronc_ns.training.shading import GLASS, GLOSS, shade, shade_ground
from kronc_ns.training.shards import Picture
from kronc_ns.training.stage import SHADOW_M, SURFACE_M, Stage

_AROUND_M = 0.015  # a keypoint is visible where one sees the surface so far beside it: outlines
_FAINT = 0.08  # share of the sky whose lack no longer shows on the backdrop of a cut-out
_PANES = 2  # windows that one looks through


def render(stage: Stage, look: Look, around: Surroundings, shot: Shot) -> Picture:
    """One picture with the car's mask and keypoints; edges are smoothed by casting four more rays a pixel."""
    width, height = SIZE
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 2)
    light = _packed_light(around)
    colour, surface = _trace(stage, look, around, light, shot, pixels)
    exposure = _exposure(colour, surface, around)
    shown = _displayed(colour, surface, around, exposure)
    kind = surface.reshape(height, width)
    edge = np.zeros((height, width), dtype=bool)
    edge[:, 1:] |= kind[:, 1:] != kind[:, :-1]
    edge[1:] |= kind[1:] != kind[:-1]
    edge[:, :-1] |= edge[:, 1:]
    edge[:-1] |= edge[1:]
    at = np.flatnonzero(edge)
    if len(at):
        offsets = np.array([[-0.375, -0.125], [0.125, -0.375], [0.375, 0.125], [-0.125, 0.375]])
        fine = (pixels[at, None] + offsets).reshape(-1, 2)
        again, which = _trace(stage, look, around, light, shot, fine)
        shown[at] = _displayed(again, which, around, exposure).reshape(-1, 4, 3).mean(1)
    rgb = np.round(255 * shown).astype(np.uint8).reshape(height, width, 3)
    mask = np.where(kind >= 0, 255, 0).astype(np.uint8)
    return Picture(rgb, mask, keypoints_seen(stage, shot), stage.body.name)


def keypoints_seen(stage: Stage, shot: Shot) -> Float[np.ndarray, "66 3"]:
    """u, v and state (0: no such point, 1: visible, 2: hidden or outside) of the body's keypoints."""
    present = stage.body.present
    points = np.where(present[:, None], stage.body.keypoints, 0.0)
    uv, depth = shot.project(points)
    eye = shot.c2w[:, 3]
    way = points - eye
    distance = np.linalg.norm(way, axis=1)
    beside = _AROUND_M * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]]) @ shot.c2w[:, :2].T
    to = unit(way[:, None] + beside)
    found = stage.hit(np.broadcast_to(eye, (to.size // 3, 3)), to.reshape(-1, 3))
    before = distance[:, None] - np.where(found["primID"] < 0, np.inf, found["tfar"]).reshape(-1, len(beside))
    free = (before < stage.recess[:, None]).any(1)
    inside = (depth > 0.05) & (uv > 0).all(1) & (uv < SIZE).all(1)
    state = np.where(present, np.where(free & inside, 1.0, 2.0), 0.0)
    return np.column_stack([np.where(depth[:, None] > 0.05, uv, -1e3), state])


def _trace(
    stage: Stage, look: Look, around: Surroundings, light: tuple[np.ndarray, ...], shot: Shot, pixels: np.ndarray
) -> tuple[Float[np.ndarray, "n 3"], np.ndarray]:
    """Radiance along the rays of pixels (beside a car that was cut out: the share of the backdrop's), and the surface
    of the car that each meets (-1: none)."""
    direction = shot.rays(pixels)
    start = np.broadcast_to(shot.c2w[:, 3], direction.shape)
    first = stage.hit(start, direction)
    face = first["primID"]
    surface = np.where(face >= 0, stage.body.mesh.surface[face], -1)
    colour = np.zeros((len(pixels), 3))
    active, found, origin = np.arange(len(pixels)), first, start
    share = np.ones(len(pixels))
    for pane in range(_PANES + 1):
        on = found["primID"] >= 0
        if (~on).any():
            miss = active[~on]
            if pane == 0 and around.backdrop is not None:
                behind = _soft_shadow(stage, around, origin[~on], direction[miss])
            else:
                behind = _surroundings(stage, around, light, origin[~on], direction[miss])
            colour[miss] += share[miss, None] * behind
        if not on.any():
            break
        active, origin = active[on], origin[on]
        found = {name: values[on] for name, values in found.items()}
        at, radiance = _on_car(stage, look, light, found, origin, direction[active], shot.focal_px)
        hit_surface = stage.body.mesh.surface[found["primID"]]
        clear = (look.kind[hit_surface] == GLASS) & (look.tint > 0.02) & (pane < _PANES)
        colour[active] += share[active, None] * radiance
        active, origin = active[clear], at[clear] + 1e-3 * direction[active[clear]]
        if not len(active):
            break
        share[active] *= look.tint
        found = stage.hit(origin, direction[active])
    return colour, surface


def _on_car(
    stage: Stage,
    look: Look,
    light: tuple[np.ndarray, ...],
    found: dict[str, np.ndarray],
    start: Float[np.ndarray, "n 3"],
    direction: Float[np.ndarray, "n 3"],
    focal_px: float,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Where rays meet the car, and the radiance that comes back."""
    face = found["primID"].astype(np.int64)
    at = start + found["tfar"][:, None] * direction
    weight = np.column_stack([1 - found["u"] - found["v"], found["u"], found["v"]])
    normal = stage.face_normal[face]
    facing = np.where((normal * direction).sum(1) > 0, -1.0, 1.0)
    sunlit = np.zeros(len(face))
    if light[5].any():
        turned = np.flatnonzero(facing * (normal @ light[4]) > 0)
        off = at[turned] + 2 * SURFACE_M * (facing[:, None] * normal)[turned]
        sunlit[turned] = ~stage.blocked(off, np.broadcast_to(light[4], off.shape))
    paint = (
        look.kind,
        look.rgb,
        stage.texels,
        stage.texture_at,
        stage.decals,
        stage.decal_texels,
        GLOSS,
        look.flake,
        look.dirt,
        look.dirt_rgb,
    )
    out = np.empty((len(face), 3))
    footprint = found["tfar"] / focal_px
    shade(face, at, direction, footprint, stage.faces[face], weight, sunlit, stage.mesh, paint, light, out)
    return at, out


def _surroundings(
    stage: Stage,
    around: Surroundings,
    light: tuple[np.ndarray, ...],
    start: Float[np.ndarray, "n 3"],
    direction: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n 3"]:
    """Radiance along rays that miss the car: the ground near it, else the panorama."""
    out = _panorama(around.sharp, direction)
    falling, distance, place = _on_ground(start, direction)
    radius = np.linalg.norm(place, axis=1)
    on = np.flatnonzero(falling & (radius < around.ground_radius_m))
    if not len(on):
        return out
    place, near = place[on], radius[on] < 1.4 * SHADOW_M
    shadow, dark = np.ones(len(on)), np.ones(len(on))
    if near.any():
        p = place[near]
        dark[near] = 1 - around.shadow * (1 - stage.sky_above(p))
        if light[5].any():
            off = np.column_stack([p, np.full(len(p), 0.003)])
            hidden = stage.blocked(off, np.broadcast_to(light[4], off.shape))
            shadow[near] = 1 - around.shadow * hidden
    ground = np.empty((len(on), 3))
    shade_ground(place, distance[on], shadow, dark, around.ground, around.ground_m, light, ground)
    out[on] = ground
    return out


def _on_ground(
    start: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"]
) -> tuple[Bool[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n 2"]]:
    """Which rays fall onto the plane z = 0, how far off, and where."""
    falling = direction[:, 2] < -1e-6
    distance = np.where(falling, start[:, 2] / np.where(falling, -direction[:, 2], 1.0), np.inf)
    return falling, distance, start[:, :2] + np.where(falling, distance, 0.0)[:, None] * direction[:, :2]


def _soft_shadow(
    stage: Stage, around: Surroundings, start: Float[np.ndarray, "n 3"], direction: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """What the contact shadow leaves of a backdrop."""
    falling, _, place = _on_ground(start, direction)
    hidden = np.where(falling, np.maximum(1 - _FAINT - stage.sky_above(place), 0) / (1 - _FAINT), 0.0)
    share = 1 - around.shadow * hidden
    return np.repeat(share[:, None], 3, axis=1)


def _panorama(image: Float32[np.ndarray, "h w 3"], direction: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Bilinear look-up of unit directions."""
    height, width = image.shape[:2]
    column = (np.arctan2(direction[:, 1], direction[:, 0]) / (2 * np.pi) + 0.5) * width - 0.5
    row = np.arccos(np.clip(direction[:, 2], -1, 1)) / np.pi * height - 0.5
    shape = (-1, 480) if len(direction) % 480 == 0 else (1, -1) if len(direction) < 32_000 else None
    if shape is None:  # OpenCV takes no longer rows
        half = len(direction) // 2
        return np.concatenate([_panorama(image, direction[:half]), _panorama(image, direction[half:])])
    found = cv2.remap(
        image,
        column.astype(np.float32).reshape(shape),
        row.astype(np.float32).reshape(shape),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )
    return found.reshape(-1, 3).astype(np.float64)


def _exposure(colour: np.ndarray, surface: np.ndarray, around: Surroundings) -> float:
    """As a camera meters: the scene's mean comes out as a grey."""
    on_car = surface >= 0
    level = np.clip(colour, 0, 6).mean()
    if around.backdrop is not None and on_car.any():
        level = np.clip(colour[on_car], 0, 6).mean()
        # the light of a studio, whatever the paint
        level = 0.5 * level + 0.5 * 0.35
    return around.exposure**2.2 / max(level, 1e-3) * 1.6


def _displayed(
    colour: np.ndarray, surface: np.ndarray, around: Surroundings, exposure: float
) -> Float[np.ndarray, "n 3"]:
    """Values 0 to 1 for a display, with a shoulder where film and sensors clip."""
    linear = colour * exposure
    shown = np.clip(linear / (1 + 0.25 * linear) * 1.15, 0, 1) ** (1 / 2.2)
    if around.backdrop is not None:
        shown = np.where((surface >= 0)[:, None], shown, around.backdrop * colour)
    return shown


def _packed_light(around: Surroundings) -> tuple[np.ndarray, ...]:
    mean = around.ground.mean((0, 1))
    up = around.diffuse[0].mean(0)
    bounced = mean * (up + max(float(around.sun[2]), 0.0) * around.sun_rgb)
    return (
        around.sharp,
        around.glossy,
        around.rough,
        around.diffuse,
        around.sun.astype(np.float64),
        around.sun_rgb.astype(np.float64),
        np.concatenate([0.8 * bounced, mean]).astype(np.float64),
    )
