"""What procedural bodies carry: the cabin behind the windows, handles, mirrors, rims."""

from typing import Literal

import numpy as np
from jaxtyping import Float

from kronc_ns.synthetic.car_parts import (
    CarShape,
    Part,
    blob_part,
    flat_part,
    roof_height,
    side_rail_height,
    surface_point,
)
from kronc_ns.training.features import Features


def cabin_parts(s: CarShape) -> list[Part]:
    """Left half of what shows through the windows: floor, dashboard, seats."""
    low, w = s.belt_height - 0.36, s.width / 2
    x0, x1 = s.rear_screen_foot_x + 0.1, s.cowl_x - 0.05
    floor = np.array([[x0, 0, low], [x1, 0, low], [x1, w - 0.16, low], [x0, w - 0.16, low]])
    parts = [flat_part(floor, np.array([[0, 1, 2], [0, 2, 3]]), "inside")]
    dash = np.array([s.cowl_x - 0.32, 0.0, s.cowl_height - 0.14])
    parts.append(blob_part(dash, (0.22, w - 0.2, 0.13), 0.6, "inside"))
    for x in (s.cowl_x - 1.15, s.cowl_x - 2.0):
        room = float(roof_height(s, np.array([x - 0.05]))[0]) - 0.14 - s.belt_height
        if room < 0.1:
            continue
        back = np.array([x, 0.36, s.belt_height - 0.2])
        parts.append(blob_part(back, (0.07, 0.23, 0.15 + 0.8 * min(room, 0.35)), 0.5, "seat"))
        parts.append(blob_part(back + np.array([-0.04, 0, 0.1 + min(0.40, room)]), (0.05, 0.13, 0.10), 0.4, "seat"))
    return parts


def outside_parts(s: CarShape, features: Features, rng: np.random.Generator) -> list[Part]:
    """Handles and door mirror of the left side."""
    handle = str(rng.choice(["paint", "trim", "chrome"], p=[0.6, 0.2, 0.2]))
    parts = []
    names = ("side_front_handle",) if features.two_doors else ("side_front_handle", "side_rear_handle")
    for name in names:
        (x0, z0), (x1, z1) = features.outlines[name]
        centre = surface_point(s, "side", (x0 + x1) / 2, (z0 + z1) / 2) + np.array([0, 0.010, 0])
        parts.append(blob_part(centre, ((x0 - x1) / 2 + 0.004, 0.022, rng.uniform(0.010, 0.018)), 0.7, handle))
        recess = centre - np.array([0, 0.010, rng.uniform(0.005, 0.012)])
        parts.append(blob_part(recess, ((x0 - x1) / 2 - 0.01, 0.006, 0.026), 0.4, "inside"))
    a_x, a_z = features.outlines["side_front_door"][0]
    foot = surface_point(s, "side", a_x - rng.uniform(0.08, 0.16), a_z + 0.03)
    shell = str(rng.choice(["paint", "trim"], p=[0.75, 0.25]))
    size = np.array([0.07, 0.105, 0.068]) * rng.uniform(0.8, 1.2, 3)
    parts.append(blob_part(foot + np.array([0, 0.10, 0.07]), (size[0], size[1], size[2]), rng.uniform(0.2, 0.7), shell))
    parts.append(blob_part(foot + np.array([-0.045, 0.10, 0.07]), (0.032, 0.092, 0.056), 0.5, "trim"))
    parts.append(blob_part(foot + np.array([0, 0.01, 0.01]), (0.045, 0.05, 0.022), 0.4, "trim"))
    return parts


def roof_parts(s: CarShape, features: Features, rng: np.random.Generator) -> list[Part]:
    """Rails, a spoiler, an aerial, wipers; of the left half, so what lies in the middle is made twice."""
    parts = []
    front, rear = s.windscreen_top_x - 0.12, s.rear_screen_top_x + 0.06
    if s.height > 1.46 and rng.uniform() < 0.45:
        x = np.linspace(front, rear, 9)
        arch = rng.uniform(0.02, 0.06) * np.sqrt(1 - np.linspace(-1, 1, 9) ** 2)
        rail = np.stack([x, np.full(9, 0.36 * s.width), side_rail_height(s, x) - 0.01 + arch], 1)
        parts.append(_bar(rail, rng.uniform(0.010, 0.02), str(rng.choice(["trim", "chrome"]))))
    if s.boot_length < 0.2 and rng.uniform() < 0.4:
        size = (rng.uniform(0.08, 0.16), 0.31 * s.width, rng.uniform(0.012, 0.025))
        z = float(roof_height(s, np.array([rear]))[0]) - 0.012
        parts.append(blob_part(np.array([rear - 0.12, 0.0, z]), size, 0.5, str(rng.choice(["paint", "trim"]))))
    if rng.uniform() < 0.4:
        z = float(roof_height(s, np.array([rear]))[0])
        size = (0.07, 0.018, 0.035) if rng.uniform() < 0.5 else (0.008, 0.008, 0.25)
        parts.append(blob_part(np.array([rear + 0.08, 0.0, z]), size, 0.2, str(rng.choice(["paint_top", "trim"]))))
    parts.append(_wiper(s, "front", features, 0.12, rng.uniform(0.4, 0.65)))
    if s.boot_length < 0.2 and rng.uniform() < 0.6:
        parts.append(_wiper(s, "rear", features, 0.0, 0.4))
    return parts


def _wiper(s: CarShape, view: Literal["front", "rear"], features: Features, start_m: float, reach: float) -> Part:
    """On a screen, from y = ``start_m`` outwards by a share of its half width."""
    screen = features.outlines[f"{view}_screen"]
    low, wide = screen[:, 1].min() + 0.05, screen[:, 0].max()
    at = np.stack([np.linspace(start_m, start_m + reach * wide, 6), np.linspace(low, low + 0.05, 6)], 1)
    blade = np.array([surface_point(s, view, float(y), float(z)) for y, z in at])
    return _bar(blade + np.array([0.008 if view == "front" else -0.008, 0, 0.008]), 0.008, "inside")


def _bar(points: Float[np.ndarray, "n 3"], half_m: float, name: str) -> Part:
    """A square bar through points."""
    ring = half_m * np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]])
    if np.ptp(points[:, 0]) < np.ptp(points[:, 1]):
        ring = ring[:, [1, 0, 2]]
    a = (4 * np.arange(len(points) - 1)[:, None] + np.arange(4)).ravel()
    b = (4 * np.arange(len(points) - 1)[:, None] + np.array([1, 2, 3, 0])).ravel()
    faces = np.concatenate([np.stack([a, b, a + 4], 1), np.stack([b, b + 4, a + 4], 1)])
    return flat_part((points[:, None] + ring).reshape(-1, 3), faces, name)


def rim_parts(s: CarShape, x: float, rng: np.random.Generator) -> list[Part]:
    """Left rim on the axle at x: spokes before a dark ground, or a cover with openings."""
    centre, y = np.array([x, 0.0, s.wheel_radius]), s.width / 2 - 0.035
    outer = s.wheel_radius * 0.70
    cover = rng.uniform() < 0.25
    disc, spoke = ("rim", "inside") if cover else ("inside", "rim")
    depth = 0.020 if cover else rng.uniform(0.05, 0.09)
    hub = rng.uniform(0.05, 0.08)
    parts = [
        _revolved(centre, [(0.0, y - depth), (outer, y - depth + 0.004)], disc),
        _revolved(centre, [(0.0, y - 0.016), (hub - 0.015, y - 0.018), (hub, y - 0.03), (hub, y - depth)], "rim"),
        _revolved(
            centre,
            [(outer - rng.uniform(0.012, 0.025), y - depth), (outer - 0.01, y - 0.010), (outer, y - 0.008)],
            "rim",
        ),
    ]
    if not cover:
        parts.append(_revolved(centre, [(hub, y - depth + 0.006), (0.7 * outer, y - depth + 0.008)], "chrome"))
    count, twist = int(rng.integers(5, 13)), rng.choice([0.0, rng.uniform(-0.5, 0.5)])
    pair = rng.uniform(0.08, 0.2) if count < 8 and rng.uniform() < 0.4 else 0.0
    inner_half, outer_half = (rng.uniform(0.2, 0.5) / count, rng.uniform(0.12, 0.4) / count)
    front, top = y - 0.024, y - (0.017 if cover else 0.013)
    for k in range(count):
        for side in (-pair, pair) if pair else (0.0,):
            angle = (
                2 * np.pi * k / count + side + np.array([-1, 1, -1, 1]) * np.repeat([inner_half, outer_half], 2) * np.pi
            )
            angle[2:] += twist
            radius = np.repeat([0.45 * outer if cover else 0.8 * hub, outer - (0.03 if cover else 0.008)], 2)
            face = np.stack([radius * np.cos(angle), np.repeat([front, top], 2), radius * np.sin(angle)], 1) + centre
            if cover:
                face[:, 1] = top
            back = face - np.array([0, 0.4 * depth, 0])
            quads = np.array([[0, 1, 3, 2], [0, 2, 6, 4], [1, 5, 7, 3]])
            faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
            parts.append(flat_part(np.concatenate([face, back]), faces, spoke))
    return parts


def _revolved(centre: Float[np.ndarray, "3"], profile: list[tuple[float, float]], name: str) -> Part:
    """Surface of revolution about the axle; ``profile`` lists (radius, y)."""
    radius, y = np.array(profile).T
    angle = np.linspace(0, 2 * np.pi, 49)
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    grid = np.stack(np.broadcast_arrays(radius * cos, y, radius * sin), -1).reshape(-1, 3) + centre
    a = (np.arange(48)[:, None] * len(radius) + np.arange(len(radius) - 1)).ravel()
    b = a + len(radius)
    return flat_part(grid, np.concatenate([np.stack([a, b, a + 1], 1), np.stack([a + 1, b, b + 1], 1)]), name)
