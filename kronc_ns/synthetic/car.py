"""A procedural car of our own: where its features lie, how they are painted, and its 66 keypoints.

A feature (lamp, window, door, plate) is a polygon in one of four orthographic views. The same polygon is painted on
the view's texture and, cast onto the mesh along the view direction, gives the keypoints: a point always sits on what
is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Float64, Int

from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.synthetic.car_paint import (
    BLACK,
    PLASTIC,
    RUBBER,
    SILVER,
    Layer,
    Rgb,
    paint_front,
    paint_plate,
    paint_rear,
    paint_side,
    paint_top,
    paint_under,
    rectangle,
)
from kronc_ns.synthetic.car_parts import (
    CarShape,
    Part,
    blob_part,
    body_part,
    cabin_half_width,
    deck_height,
    plate_part,
    side_rail_height,
    surface_point,
    tail_height,
    wheel_parts,
)


@dataclass(frozen=True)
class Material:
    """What a face looks like where no layer covers it."""

    rgb: Rgb
    """Base colour."""
    gloss: float
    """0 matte to 1 mirror-like."""
    layers: tuple[str, ...] = ()
    """Names of the layers painted over it, first to last."""


@dataclass(frozen=True)
class CarModel:
    """A car ready to be rendered, with exact keypoints."""

    shape: CarShape
    """The dimensions it was built from."""
    mesh: trimesh.Trimesh
    """All triangles, with smooth vertex normals; metres, x forward, y left, z up."""
    face_material: Int[np.ndarray, "f"]
    """Index into `materials`."""
    materials: tuple[Material, ...]
    """Materials of the faces."""
    layers: dict[str, Layer]
    """Projected textures by name."""
    keypoints: Float64[np.ndarray, "66 3"]
    """Points on the mesh in the ApolloCar3D order."""


def _bent(points: list[tuple[float, float]], sag: float, half_width: float) -> np.ndarray:
    """Edges of a symmetric polygon subdivided and lowered by sag (y / half_width)^2, as crowned panels are."""
    ring = np.array([*points, points[0]], dtype=float)
    dense = np.concatenate([np.linspace(a, b, 12, endpoint=False) for a, b in pairwise(ring)])
    dense[:, 1] -= sag * (dense[:, 0] / half_width) ** 2
    return dense


def features(s: CarShape) -> dict[str, np.ndarray]:
    """Feature outlines of the left half: "side_*" as (x, z), "front_*" and "rear_*" as (y, z), metres.

    Lamps list inner top, inner bottom, outer bottom, outer top; screens and plates start at the lower right corner and
    run over lower left and upper left to upper right; handles list front and rear end, wheels the centre and the
    bumper corner beside the arch.
    """
    w, sill, tail, hood = s.width / 2, s.clearance + 0.10, tail_height(s), s.nose_height
    a_x = min(s.cowl_x - 0.22, s.front_axle_x - s.arch_radius - 0.06)
    c_x, arch = s.rear_axle_x + 0.06, s.rear_axle_x + s.arch_radius
    r, front_arch, rear_arch = s.wheel_radius, s.front_axle_x + s.arch_radius, s.rear_axle_x - s.arch_radius
    b_x = a_x - 0.55 * (a_x - arch) - 0.04
    x = np.linspace(s.cowl_x, s.rear_screen_foot_x + 0.12, 120)
    window_top = side_rail_height(s, x) - 0.105
    sash = deck_height(s, x) + 0.012
    x, window_top, sash = (v[window_top > sash + 0.03] for v in (x, window_top, sash))
    if len(x) == 0:
        raise ValueError(f"no room for side windows: height {s.height} m over belt_height {s.belt_height} m")
    belt_a, belt_b, belt_c = deck_height(s, np.array([a_x, b_x, c_x])) - 0.012
    b_top = (b_x - 0.05, np.interp(0.05 - b_x, -x, window_top) + 0.02)
    screens = {"front_screen": ((s.cowl_x - 0.15, s.cowl_height + 0.03), (s.windscreen_top_x, s.height - 0.085)),
               "rear_screen": ((s.rear_screen_foot_x + 0.1, s.boot_height + 0.045),
                               (s.rear_screen_top_x, s.height - 0.115))}  # fmt: skip
    outlines = {
        "side_windows": np.concatenate([np.stack([x, window_top], 1), np.stack([x, sash], 1)[::-1]]),
        "side_front_door": [(a_x, belt_a), (a_x + 0.03, sill + 0.28), (a_x, sill), (b_x, sill), (b_x, belt_b), b_top],
        "side_rear_door": [(c_x - 0.12, belt_c), (c_x - 0.02, 0.80 * belt_c), (arch - 0.02, r + 0.33),
                           (arch + 0.07, r + 0.10), (arch + 0.09, sill), (b_x, sill), (b_x, belt_b), b_top],
        "side_front_handle": [(b_x + 0.24, belt_b - 0.13), (b_x + 0.06, belt_b - 0.13)],
        "side_rear_handle": [(c_x + 0.20, belt_c - 0.13), (c_x + 0.02, belt_c - 0.13)],
        "side_front_wheel": [(s.front_axle_x, r), (front_arch + 0.02, s.clearance + 0.09)],
        "side_rear_wheel": [(s.rear_axle_x, r), (rear_arch - 0.02, s.clearance + 0.10)],
        "front_lamp": [(0.50 * w, hood - 0.095), (0.52 * w, hood - 0.20), (0.85 * w, hood - 0.17),
                       (0.83 * w, hood - 0.065)],
        "front_fog": [(0.58 * w, 0.455), (0.60 * w, 0.36), (0.80 * w, 0.37), (0.81 * w, 0.45)],
        "front_plate": rectangle(0.26, 0.405, 0.515),
        "rear_lamp": [(0.50 * w, tail), (0.53 * w, tail - 0.15), (0.83 * w, tail - 0.165), (0.80 * w, tail + 0.005)],
        "rear_boot": [(0.55 * w, 0.60)],
        "rear_bumper": [(0.82 * w, 0.47)],
        "rear_plate": rectangle(0.26, tail - 0.13, tail - 0.02),
    }  # fmt: skip
    for name, (foot, head) in screens.items():
        wide, narrow = (cabin_half_width(s, *np.array(point)[:, None])[0] - 0.10 for point in (foot, head))
        corners = [(-wide, foot[1]), (wide, foot[1]), (narrow, head[1]), (-narrow, head[1])]
        outlines[name] = _bent(corners, 0.045, w)
    return {name: np.array(points, dtype=float) for name, points in outlines.items()}


KEYPOINTS: dict[int, tuple[str, int]] = {
    0: ("front_lamp", 0), 1: ("front_lamp", 1), 2: ("front_lamp", 3), 3: ("front_lamp", 2), 4: ("front_fog", 3),
    5: ("front_fog", 2), 6: ("side_front_wheel", 1), 7: ("side_front_wheel", 0), 8: ("front_screen", 24),
    9: ("side_front_door", 0), 10: ("side_front_door", 2), 11: ("side_front_door", 5), 12: ("side_front_door", 4),
    13: ("side_front_handle", 0), 14: ("side_front_handle", 1), 15: ("side_front_door", 3), 16: ("side_rear_door", 0),
    17: ("side_rear_handle", 0), 18: ("side_rear_handle", 1), 19: ("side_rear_door", 4), 20: ("side_rear_wheel", 0),
    21: ("side_rear_wheel", 1), 22: ("rear_lamp", 3), 23: ("rear_lamp", 2), 24: ("rear_screen", 24),
    25: ("rear_lamp", 0), 26: ("rear_lamp", 1), 27: ("rear_boot", 0), 28: ("rear_bumper", 0), 59: ("front_plate", 2),
    61: ("front_plate", 1), 62: ("rear_plate", 2), 65: ("rear_plate", 1),
}  # fmt: skip
"""Keypoints of the left half: index -> (feature, vertex of its outline)."""

MIRROR = np.array(APOLLOCAR3D_66.flip)
"""Mirror partner of each keypoint."""


def _keypoints(mesh: trimesh.Trimesh, outlines: dict[str, np.ndarray]) -> Float64[np.ndarray, "66 3"]:
    """Casts the left keypoints onto the mesh along their view direction and mirrors them; metres."""
    index = np.array(list(KEYPOINTS))
    views = np.array([name.split("_")[0] for name, _ in KEYPOINTS.values()])
    at = np.array([outlines[name][vertex] for name, vertex in KEYPOINTS.values()])
    side = views == "side"
    start = np.where(side[:, None], np.stack([at[:, 0], 0 * at[:, 0] + 5, at[:, 1]], 1),
                     np.stack([np.where(views == "front", 5.0, -5.0), at[:, 0], at[:, 1]], 1))  # fmt: skip
    direction = np.where(side[:, None], [0.0, -1, 0], -np.sign(start[:, :1]) * [1.0, 0, 0])
    located, ray, _ = mesh.ray.intersects_location(start, direction, multiple_hits=False)
    missed = [KEYPOINTS[i] for i in np.delete(index, ray)]
    if missed:
        raise ValueError(f"features {missed} lie outside the body: expected dimensions of a plausible car")
    points = np.empty((len(MIRROR), 3))
    points[index[ray]] = located
    points[MIRROR[index[ray]]] = located * (1, -1, 1)
    return points


@lru_cache(maxsize=4)
def build_car(shape: CarShape = CarShape(), paint_rgb: Rgb = (36, 92, 168)) -> CarModel:  # noqa: B008
    """Builds geometry, textures and keypoints of a car with the given dimensions and paint; kept for the next call."""
    outlines = features(shape)
    left = [body_part(shape)]
    for x in (shape.front_axle_x, shape.rear_axle_x):
        left += wheel_parts(shape, x)
    left += _handles_and_mirror(shape, outlines)
    parts = left + [part.mirrored() for part in left]
    ends: tuple[tuple[Literal["front", "rear"], int], ...] = (("front", 1), ("rear", -1))
    for view, facing in ends:
        plate = outlines[f"{view}_plate"]
        outermost = max(abs(surface_point(shape, view, 0.0, z)[0]) for z in plate[:, 1])
        centre = np.array([facing * (outermost - 0.012), 0, plate[:, 1].mean()])
        parts.append(plate_part(centre, 0.263, np.ptp(plate[:, 1]) / 2 + 0.003))
    body_layers = ("left", "right", "front", "rear", "top", "under")
    materials = {"body": Material(paint_rgb, 0.55, body_layers), "wheel": Material(SILVER, 0.5, ("left", "right")),
                 "tyre": Material(RUBBER, 0.05, ("left", "right")), "dark": Material(BLACK, 0.0),
                 "paint": Material(paint_rgb, 0.55), "trim": Material(PLASTIC, 0.3),
                 "plate": Material(BLACK, 0.2, ("front_plate", "rear_plate"))}  # fmt: skip
    layers = {"left": paint_side(shape, outlines, 1), "right": paint_side(shape, outlines, -1),
              "front": paint_front(shape, outlines), "rear": paint_rear(shape, outlines), "top": paint_top(shape),
              "under": paint_under(shape),
              "front_plate": paint_plate(shape, outlines["front_plate"], 1),
              "rear_plate": paint_plate(shape, outlines["rear_plate"], -1)}  # fmt: skip
    mesh, face_material = _joined(parts, list(materials))
    return CarModel(shape, mesh, face_material, tuple(materials.values()), layers, _keypoints(mesh, outlines))


def _handles_and_mirror(s: CarShape, outlines: dict[str, np.ndarray]) -> list[Part]:
    """Door handles and the door mirror of the left side."""
    parts = []
    for name in ("side_front_handle", "side_rear_handle"):
        (x0, z0), (x1, z1) = outlines[name]
        centre = surface_point(s, "side", (x0 + x1) / 2, (z0 + z1) / 2)
        parts.append(blob_part(centre + np.array([0, 0.008, 0]), ((x0 - x1) / 2 + 0.008, 0.022, 0.016), 0.7, "trim"))
    a_x, a_z = outlines["side_front_door"][0]
    foot = surface_point(s, "side", a_x - 0.12, a_z + 0.03)
    parts.append(blob_part(foot + np.array([0, 0.10, 0.07]), (0.07, 0.105, 0.068), 0.45, "paint"))
    parts.append(blob_part(foot + np.array([-0.045, 0.10, 0.07]), (0.032, 0.092, 0.056), 0.5, "trim"))
    parts.append(blob_part(foot + np.array([0, 0.01, 0.01]), (0.045, 0.05, 0.022), 0.4, "trim"))
    return parts


def _joined(parts: list[Part], order: list[str]) -> tuple[trimesh.Trimesh, np.ndarray]:
    """One mesh of all parts and the material index of each face."""
    offsets = np.cumsum([0, *(len(p.vertices) for p in parts[:-1])])
    mesh = trimesh.Trimesh(
        vertices=np.concatenate([p.vertices for p in parts]),
        faces=np.concatenate([p.faces + o for p, o in zip(parts, offsets, strict=True)]),
        vertex_normals=np.concatenate([p.normals for p in parts]),
        process=False,
    )
    return mesh, np.concatenate([np.full(len(p.faces), order.index(p.material)) for p in parts])
