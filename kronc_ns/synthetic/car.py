"""A procedural car of our own: where its features lie, how they are painted, and its 66 keypoints.

A feature (lamp, window, door, plate) is a polygon in one of four orthographic views. The same polygon is painted on
the view's texture and, cast onto the mesh along the view direction, gives the keypoints: a point always sits on what
is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
import trimesh

from kronc_ns.keypoints.schema import APOLLOCAR3D_66
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

METRES_PER_TEXEL = 0.0025
Rgb = tuple[int, int, int]
Outline = np.ndarray | list
BLACK, SEAM, RUBBER, PLASTIC = (12, 12, 14), (16, 16, 20), (30, 30, 32), (44, 45, 48)
GLASS, INTERIOR, SILVER, WHITE = (26, 33, 40), (52, 54, 58), (190, 194, 200), (235, 236, 232)
RED, DARK_RED, AMBER = (190, 22, 26), (120, 12, 18), (228, 132, 30)


@dataclass(frozen=True)
class Layer:
    """A texture projected along one direction onto the surfaces that face it."""

    facing: np.ndarray
    """[3] unit vector from the car to the viewer of this texture."""
    right: np.ndarray
    """[3] unit vector of increasing columns."""
    up: np.ndarray
    """[3] unit vector of decreasing rows."""
    corner: tuple[float, float]
    """Metres along `right` and `up` at the upper left corner of the image."""
    levels: tuple[np.ndarray, ...]
    """Mip levels of the image, [H,W,5] uint8: red, green, blue, alpha, gloss; all premultiplied by alpha."""
    min_cos: float
    """Applied where the surface normal has at least this cosine with `facing`."""


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
    face_material: np.ndarray
    """[F] index into `materials`."""
    materials: tuple[Material, ...]
    """Materials of the faces."""
    layers: dict[str, Layer]
    """Projected textures by name."""
    keypoints: np.ndarray
    """[66,3] float64 points on the mesh in the ApolloCar3D order."""


class _Canvas:
    """Paints features given in metres, as the viewer of a layer sees them."""

    def __init__(self, facing: tuple, right: tuple, up: tuple, corner: tuple[float, float], size: tuple[float, float]):
        shape = (round(size[1] / METRES_PER_TEXEL), round(size[0] / METRES_PER_TEXEL))
        self.rgb, self.rest = np.zeros((*shape, 3), np.uint8), np.zeros((*shape, 2), np.uint8)
        self.facing, self.right, self.up = (np.array(v, dtype=float) for v in (facing, right, up))
        self.corner = corner
        self.flip = np.array([self.right.sum(), self.up.sum()])

    def _pixels(self, points: Outline) -> np.ndarray:
        """Fixed-point pixel coordinates (4 fractional bits) of points given as (x or y, z or y) in metres."""
        pixel = (np.asarray(points, float) * self.flip - self.corner) * (1, -1) / METRES_PER_TEXEL - 0.5
        return np.round(pixel * 16).astype(np.int32)

    def fill(self, polygon: Outline, rgb: Rgb, gloss: float = 0.3) -> None:
        """A filled polygon."""
        points = [self._pixels(polygon)]
        cv2.fillPoly(self.rgb, points, rgb, cv2.LINE_AA, 4)
        cv2.fillPoly(self.rest, points, (255, round(255 * gloss)), cv2.LINE_AA, 4)

    def both(self, polygon: Outline, rgb: Rgb, gloss: float = 0.3) -> None:
        """A filled polygon and its mirror image across the first coordinate."""
        self.fill(polygon, rgb, gloss)
        self.fill(np.asarray(polygon) * (-1, 1), rgb, gloss)

    def line(self, points: Outline, rgb: Rgb, width: float, closed: bool = False) -> None:
        """A polyline of a width in metres."""
        pixels, thick = [self._pixels(points)], max(1, round(width / METRES_PER_TEXEL))
        cv2.polylines(self.rgb, pixels, closed, rgb, thick, cv2.LINE_AA, 4)
        cv2.polylines(self.rest, pixels, closed, (255, 40), thick, cv2.LINE_AA, 4)

    def disc(self, centre: tuple[float, float], radius: float, rgb: Rgb, gloss: float = 0.3) -> None:
        """A filled circle."""
        self.fill(_arc(centre, radius, 0.0, 360.0), rgb, gloss)

    def text(self, text: str, left_foot: tuple[float, float], height: float, rgb: Rgb) -> None:
        """Text that reads correctly from outside; `left_foot` is the reader's lower left corner."""
        at = tuple(int(v) for v in self._pixels(np.array(left_foot)) // 16)
        scale, thick = height / METRES_PER_TEXEL / 22, max(1, round(height / METRES_PER_TEXEL / 7))
        cv2.putText(self.rgb, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, rgb, thick, cv2.LINE_AA)
        cv2.putText(self.rest, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 40), thick, cv2.LINE_AA)

    def layer(self, min_cos: float) -> Layer:
        """The finished texture. Colour outside the features is zero, so antialiased edges come out premultiplied."""
        image = np.dstack([self.rgb, self.rest])
        return Layer(self.facing, self.right, self.up, self.corner, mip_levels(image), min_cos)


def mip_levels(image: np.ndarray) -> tuple[np.ndarray, ...]:
    """The image [H,W,C] and its successive halvings, each the mean over 2 x 2 texels."""
    levels = [image]
    while min(levels[-1].shape[:2]) > 8:
        height, width = (n // 2 * 2 for n in levels[-1].shape[:2])
        rows = levels[-1][:height:2, :width].astype(np.uint16) + levels[-1][1:height:2, :width]
        levels.append(((rows[:, ::2] + rows[:, 1::2] + 2) // 4).astype(np.uint8))
    return tuple(levels)


def _arc(centre: tuple[float, float], radius: float, start_deg: float, stop_deg: float) -> np.ndarray:
    """Points [48,2] on a circular arc."""
    angle = np.radians(np.linspace(start_deg, stop_deg, 48))
    return np.array(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], 1)


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
        "front_plate": _rectangle(0.26, 0.405, 0.515),
        "rear_lamp": [(0.50 * w, tail), (0.53 * w, tail - 0.15), (0.83 * w, tail - 0.165), (0.80 * w, tail + 0.005)],
        "rear_boot": [(0.55 * w, 0.60)],
        "rear_bumper": [(0.82 * w, 0.47)],
        "rear_plate": _rectangle(0.26, tail - 0.13, tail - 0.02),
    }  # fmt: skip
    for name, (foot, head) in screens.items():
        wide, narrow = (cabin_half_width(s, *np.array(point)[:, None])[0] - 0.10 for point in (foot, head))
        corners = [(-wide, foot[1]), (wide, foot[1]), (narrow, head[1]), (-narrow, head[1])]
        outlines[name] = _bent(corners, 0.045, w)
    return {name: np.array(points, dtype=float) for name, points in outlines.items()}


def _rectangle(half_width: float, low: float, high: float) -> list[tuple[float, float]]:
    """Corners from the lower right over lower left and upper left to the upper right (negative y is right)."""
    return [(-half_width, low), (half_width, low), (half_width, high), (-half_width, high)]


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


def _keypoints(mesh: trimesh.Trimesh, outlines: dict[str, np.ndarray]) -> np.ndarray:
    """Casts the left keypoints onto the mesh along their view direction and mirrors them: [66,3] metres."""
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


def _paint_side(s: CarShape, outlines: dict[str, np.ndarray], side: int) -> Layer:
    """Doors, windows, wheels and trim of the left (side = 1) or right (side = -1) flank."""
    half = s.length / 2 + 0.1
    c = _Canvas((0, side, 0), (-side, 0, 0), (0, 0, 1), (-half, s.height + 0.05), (2 * half, s.height + 0.05))
    front, rear, r = s.front_axle_x, s.rear_axle_x, s.wheel_radius
    flank = [(front - s.arch_radius, s.clearance - 0.1), (rear + s.arch_radius, s.clearance - 0.1),
             (rear + s.arch_radius, s.clearance + 0.085), (front - s.arch_radius, s.clearance + 0.085)]  # fmt: skip
    c.fill(flank, PLASTIC)
    for x in (front, rear):
        c.disc((x, r), s.arch_radius + 0.035, PLASTIC)
        _paint_wheel(c, (x, r), r)
    windows, door_a, door_b = (outlines[f"side_{name}"] for name in ("windows", "front_door", "rear_door"))
    centre = windows.mean(0)
    c.fill(centre + (windows - centre) * (1.02, 1.06), BLACK, 0.5)
    c.fill(windows, GLASS, 1.0)
    for x in (door_a[4, 0] + 0.12, door_b[0, 0] + 0.28):
        seat = np.array([(0.02, -0.02), (-0.16, -0.02), (-0.22, 0.17), (-0.17, 0.28), (-0.09, 0.28), (-0.06, 0.17)])
        c.fill(np.array([x, deck_height(s, np.array([x]))[0] + 0.03]) + seat * (1, 0.85), INTERIOR, 1.0)
    pillar = np.array([(0.045, 0.02), (-0.045, 0.02), (-0.04, -0.02), (0.04, -0.02)])
    c.fill(door_a[[4, 4, 5, 5]] + pillar, BLACK, 0.6)
    c.line(door_b[[0, 0]] + np.array([(0.06, 0.02), (0.02, 0.40)]), BLACK, 0.03)
    for door in (door_a, door_b):
        c.line(door[:5] if door is door_a else door[:7], SEAM, 0.012)
    sash = windows[len(windows) // 2 :]
    c.line(sash - (0, 0.006), SILVER, 0.012)
    strip = np.array([(front - s.arch_radius - 0.05, r + 0.14), (rear + s.arch_radius + 0.1, r + 0.14)])
    c.line(strip, PLASTIC, 0.035)
    c.line(strip + np.array([0, 0.012]), SILVER, 0.008)
    c.fill(_arc((front - 0.06, s.nose_height + 0.06), 0.022, 0.0, 360.0), AMBER, 0.6)
    for name, x in (("front", s.length / 2 - 0.26), ("rear", -s.length / 2 + 0.24)):
        arch_x = front + s.arch_radius if name == "front" else rear - s.arch_radius
        c.line([(x, 0.60 * s.belt_height), (arch_x, 0.60 * s.belt_height)], SEAM, 0.010)
    if side < 0:
        c.line(_rounded(rear - 0.20, s.belt_height - 0.12, 0.08, 0.07), SEAM, 0.010, closed=True)
        c.text("66", (door_b[5, 0] - 0.38, s.belt_height - 0.42), 0.16, WHITE)
    else:
        c.text("KRONC", (door_a[1, 0] - 0.22, s.belt_height - 0.36), 0.11, WHITE)
    return c.layer(0.35)


def _rounded(x: float, z: float, half_width: float, half_height: float) -> np.ndarray:
    """Outline of a rounded rectangle centred on (x, z)."""
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    curve = np.stack([np.cos(angle), np.sin(angle)], 1)
    return np.array([x, z]) + np.sign(curve) * np.abs(curve) ** 0.4 * (half_width, half_height)


def _paint_wheel(c: _Canvas, centre: tuple[float, float], radius: float) -> None:
    """Tyre side wall with lettering, alloy rim with five double spokes, hub."""
    rim = 0.70 * radius
    c.disc(centre, radius, RUBBER, 0.1)
    for start in (20.0, 200.0):
        c.line(_arc(centre, 0.86 * radius, start, start + 40), (120, 120, 120), 0.014)
    c.disc(centre, rim + 0.004, SILVER, 0.6)
    c.disc(centre, rim - 0.022, BLACK, 0.2)
    c.disc(centre, 0.5 * rim, (64, 58, 56), 0.3)
    for k in range(5):
        for offset in (-11, 11):
            a = np.radians(90 + 72 * k + offset)
            along, across = np.array([np.cos(a), np.sin(a)]), np.array([-np.sin(a), np.cos(a)])
            foot, tip = np.array(centre) + 0.03 * along, np.array(centre) + (rim - 0.01) * along
            spoke = [foot + 0.022 * across, foot - 0.022 * across, tip - 0.015 * across, tip + 0.015 * across]
            c.fill(np.array(spoke), SILVER, 0.6)
    c.disc(centre, 0.065, SILVER, 0.6)
    c.disc(centre, 0.030, PLASTIC, 0.6)


def _paint_front(s: CarShape, outlines: dict[str, np.ndarray]) -> Layer:
    """Windscreen, head and fog lamps, grilles, badge."""
    w, hood = s.width / 2, s.nose_height
    c = _Canvas((1, 0, 0), (0, 1, 0), (0, 0, 1), (-w - 0.1, s.height + 0.05), (2 * w + 0.2, s.height + 0.05))
    screen, lamp, fog = (outlines[f"front_{name}"] for name in ("screen", "lamp", "fog"))
    _paint_screen(c, screen)
    low, wide = screen[:, 1].min(), screen[12, 0]
    for y in (-0.05, 0.55 * wide):
        c.line([(y, low + 0.03), (y + 0.50 * wide, low + 0.10)], BLACK, 0.020)
    c.fill([(-0.42 * w, hood - 0.2), (0.42 * w, hood - 0.2), (0.46 * w, hood - 0.11), (-0.46 * w, hood - 0.11)], BLACK)
    for z in (hood - 0.175, hood - 0.14):
        c.line([(-0.43 * w, z), (0.43 * w, z)], SILVER, 0.010)
    c.disc((0.0, hood - 0.155), 0.055, SILVER, 0.8)
    c.disc((0.0, hood - 0.155), 0.040, (20, 40, 90), 0.8)
    c.fill([(-0.50 * w, 0.24), (0.50 * w, 0.24), (0.44 * w, 0.375), (-0.44 * w, 0.375)], BLACK)
    for y in np.linspace(-0.44, 0.44, 15) * w:
        c.line([(y, 0.25), (y, 0.365)], (70, 71, 75), 0.010)
    c.line([(-0.48 * w, 0.31), (0.48 * w, 0.31)], (70, 71, 75), 0.012)
    c.both(lamp.mean(0) + (lamp - lamp.mean(0)) * 1.05, BLACK, 0.7)
    c.both(lamp, (206, 214, 222), 1.0)
    c.both(fog + np.array([(-0.02, 0.02), (-0.02, -0.02), (0.01, -0.015), (0.01, 0.015)]), BLACK)
    c.both(fog[[2, 3]].mean(0) + (fog - fog[[2, 3]].mean(0)) * (0.42, 1.0), (196, 200, 204), 0.9)
    middle = lamp.mean(0)
    for sign in (-1, 1):
        for dy, radius in ((-0.045, 0.040), (0.055, 0.034)):
            c.disc((sign * (middle[0] + dy), middle[1]), radius, (70, 78, 88), 1.0)
            c.disc((sign * (middle[0] + dy), middle[1]), 0.6 * radius, (245, 247, 250), 1.0)
        c.line((lamp[[1, 2]] + (0, 0.018)) * (sign, 1), AMBER, 0.020)
        c.line([(sign * 0.50 * w, 0.545), (sign * 0.90 * w, 0.56)], SEAM, 0.010)
    return c.layer(0.12)


def _paint_screen(c: _Canvas, screen: np.ndarray) -> None:
    """Windscreen or rear screen: black frit edge, glass, head rests behind it."""
    centre = screen.mean(0)
    c.fill(screen, BLACK, 0.8)
    c.fill(centre + (screen - centre) * (0.95, 0.88), GLASS, 1.0)
    low, high, wide = screen[:, 1].min(), screen[:, 1].max(), screen[12, 0]
    for y in (-0.48 * wide, 0.48 * wide):
        z = low + 0.52 * (high - low)
        c.fill(_rounded(y, z - 0.06, 0.17, 0.07), INTERIOR, 1.0)
        c.fill(_rounded(y, z + 0.05, 0.09, 0.05), INTERIOR, 1.0)


def _paint_rear(s: CarShape, outlines: dict[str, np.ndarray]) -> Layer:
    """Rear screen, tail lamps, boot lid seam, bumper with reflectors."""
    w, tail = s.width / 2, tail_height(s)
    c = _Canvas((-1, 0, 0), (0, -1, 0), (0, 0, 1), (-w - 0.1, s.height + 0.05), (2 * w + 0.2, s.height + 0.05))
    screen, lamp, boot, corner = (outlines[f"rear_{name}"] for name in ("screen", "lamp", "boot", "bumper"))
    _paint_screen(c, screen)
    for z in np.linspace(0.25, 0.75, 6):
        row = screen[:, 1].min() + z * np.ptp(screen[:, 1])
        c.line([(-0.52, row), (0.52, row)], (44, 40, 38), 0.005)
    c.line([(0, screen[:, 1].min() + 0.02), (0.28, screen[:, 1].min() + 0.08)], BLACK, 0.022)
    y, z = boot[0]
    c.line([(-lamp[1, 0], lamp[1, 1]), (-y, z), (y, z), (lamp[1, 0], lamp[1, 1])], SEAM, 0.014)
    c.line([(lamp[0, 0], tail), (lamp[0, 0] - 0.02, s.boot_height)], SEAM, 0.010)
    c.line([(-lamp[0, 0], tail), (-lamp[0, 0] + 0.02, s.boot_height)], SEAM, 0.010)
    c.fill(_rectangle(0.30, tail - 0.15, tail), PLASTIC)
    c.disc((0.0, tail - 0.205), 0.035, SILVER, 0.8)
    c.text("K66", (0.28 * w, tail - 0.26), 0.05, SILVER)
    c.both(lamp.mean(0) + (lamp - lamp.mean(0)) * 1.05, BLACK, 0.7)
    c.both(lamp, RED, 0.9)
    band = np.array([lamp[0] * 0.55 + lamp[1] * 0.45, lamp[1], lamp[2], lamp[3] * 0.55 + lamp[2] * 0.45])
    c.both(band, DARK_RED, 0.9)
    c.both(band.mean(0) + (band - band.mean(0)) * (0.8, 0.5), (232, 228, 224), 0.9)
    c.fill([(-0.62 * w, 0.22), (0.62 * w, 0.22), (0.56 * w, 0.33), (-0.56 * w, 0.33)], PLASTIC)
    c.line([(-0.75 * w, 0.40), (0.75 * w, 0.40)], SEAM, 0.012)
    reflector = np.array([(0, 0), (0.20, 0), (0.20, 0.045), (0.01, 0.045)])
    for sign in (-1, 1):
        c.line([(sign * 0.56 * w, z), (sign * 0.92 * w, 0.58)], SEAM, 0.010)
        c.fill((corner - reflector) * (sign, 1), DARK_RED, 0.8)
        c.disc((sign * 0.42 * w, 0.24), 0.035, SILVER, 0.8)
    return c.layer(0.12)


def _paint_top(s: CarShape) -> Layer:
    """Bonnet seams and cowl strip, sun roof, aerial, roof rails; seen from above with the front of the car upwards."""
    half, w = s.length / 2 + 0.1, s.width / 2
    c = _Canvas((0, 0, 1), (0, -1, 0), (1, 0, 0), (-w - 0.1, half), (2 * w + 0.2, 2 * half))
    nose, cowl = s.length / 2, s.cowl_x
    for sign in (-1, 1):
        seam = np.array([(0.50 * w, nose - 0.13), (0.74 * w, nose - 0.42), (0.80 * w, cowl - 0.16)])
        c.line(seam * (sign, 1), SEAM, 0.012)
        c.line([(sign * 0.25 * w, nose - 0.25), (sign * 0.42 * w, cowl - 0.10)], (20, 24, 30), 0.006)
        c.disc((sign * 0.30 * w, cowl - 0.02), 0.018, BLACK)
        rail = np.array([(sign * 0.60 * w, s.windscreen_top_x - 0.15), (sign * 0.58 * w, s.rear_screen_top_x + 0.12)])
        c.line(rail, PLASTIC, 0.035)
    roof = np.array([s.windscreen_top_x - 0.22, 0.55 * s.windscreen_top_x + 0.45 * s.rear_screen_top_x])
    c.fill(_rounded(0.0, roof.mean(), 0.40 * w, np.ptp(roof) / 2), GLASS, 1.0)
    c.disc((0.0, s.rear_screen_top_x + 0.14), 0.035, BLACK)
    return c.layer(0.72)


def _paint_under(s: CarShape) -> Layer:
    """Dark underside."""
    half = s.length / 2 + 0.1
    c = _Canvas((0, 0, -1), (0, 1, 0), (1, 0, 0), (-half, half), (2 * half, 2 * half))
    c.fill([(-half, -half), (half, -half), (half, half), (-half, half)], PLASTIC)
    return c.layer(0.5)


def _paint_plate(s: CarShape, outline: np.ndarray, facing: int) -> Layer:
    """A number plate seen from the front (facing = 1) or the rear (facing = -1)."""
    low, high = outline[:, 1].min(), outline[:, 1].max()
    c = _Canvas((facing, 0, 0), (0, facing, 0), (0, 0, 1), (-0.3, high + 0.02), (0.6, high - low + 0.04))
    c.fill(_rectangle(0.27, low - 0.01, high + 0.01), BLACK, 0.2)
    c.fill(_rectangle(0.25, low + 0.01, high - 0.01), WHITE if facing > 0 else (232, 200, 60), 0.2)
    blue = np.array([(-0.25, low + 0.01), (-0.21, low + 0.01), (-0.21, high - 0.01), (-0.25, high - 0.01)])
    c.fill(blue * (facing, 1), (24, 60, 160), 0.2)
    c.text("KR 0NC 66", (-0.19 * facing, low + 0.032), 0.048, BLACK)
    return c.layer(0.5)


def build_car(shape: CarShape = CarShape(), paint_rgb: Rgb = (36, 92, 168)) -> CarModel:  # noqa: B008
    """Builds geometry, textures and keypoints of a car with the given dimensions and paint."""
    outlines = features(shape)
    left = [body_part(shape)]
    for x in (shape.front_axle_x, shape.rear_axle_x):
        left += wheel_parts(shape, x)
    left += _handles_and_mirror(shape, outlines)
    parts = left + [part.mirrored() for part in left]
    for view, facing in (("front", 1), ("rear", -1)):
        plate = outlines[f"{view}_plate"]
        outermost = max(abs(surface_point(shape, view, 0.0, z)[0]) for z in plate[:, 1])
        centre = np.array([facing * (outermost - 0.012), 0, plate[:, 1].mean()])
        parts.append(plate_part(centre, 0.263, np.ptp(plate[:, 1]) / 2 + 0.003))
    body_layers = ("left", "right", "front", "rear", "top", "under")
    materials = {"body": Material(paint_rgb, 0.55, body_layers), "wheel": Material(SILVER, 0.5, ("left", "right")),
                 "tyre": Material(RUBBER, 0.05, ("left", "right")), "dark": Material(BLACK, 0.0),
                 "paint": Material(paint_rgb, 0.55), "trim": Material(PLASTIC, 0.3),
                 "plate": Material(BLACK, 0.2, ("front_plate", "rear_plate"))}  # fmt: skip
    layers = {"left": _paint_side(shape, outlines, 1), "right": _paint_side(shape, outlines, -1),
              "front": _paint_front(shape, outlines), "rear": _paint_rear(shape, outlines), "top": _paint_top(shape),
              "under": _paint_under(shape),
              "front_plate": _paint_plate(shape, outlines["front_plate"], 1),
              "rear_plate": _paint_plate(shape, outlines["rear_plate"], -1)}  # fmt: skip
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
