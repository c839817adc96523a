"""Paint of the procedural car: its features drawn as textures of orthographic views, in metres."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from kronc_ns.synthetic.car_parts import CarShape, deck_height, tail_height
from kronc_ns.synthetic.texture import mip_levels

METRES_PER_TEXEL = 0.0025
Rgb = tuple[int, int, int]
Outline = np.ndarray | list
BLACK, SEAM, RUBBER, PLASTIC = (12, 12, 14), (16, 16, 20), (30, 30, 32), (44, 45, 48)
GLASS, INTERIOR, SILVER, WHITE = (26, 33, 40), (52, 54, 58), (190, 194, 200), (235, 236, 232)
RED, DARK_RED, AMBER = (190, 22, 26), (120, 12, 18), (228, 132, 30)


@dataclass(frozen=True)
class Layer:
    """A texture projected along one direction onto the surfaces that face it."""

    facing: Float[np.ndarray, "3"]
    """Unit vector from the car to the viewer of this texture."""
    right: Float[np.ndarray, "3"]
    """Unit vector of increasing columns."""
    up: Float[np.ndarray, "3"]
    """Unit vector of decreasing rows."""
    corner: tuple[float, float]
    """Metres along `right` and `up` at the upper left corner of the image."""
    levels: tuple[UInt8[np.ndarray, "_ _ 5"], ...]
    """Mip levels of the image: red, green, blue, alpha, gloss; all premultiplied by alpha."""
    min_cos: float
    """Applied where the surface normal has at least this cosine with `facing`."""


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
        image = cv2.merge([self.rgb, self.rest])
        return Layer(self.facing, self.right, self.up, self.corner, mip_levels(image), min_cos)


def _arc(centre: tuple[float, float], radius: float, start_deg: float, stop_deg: float) -> np.ndarray:
    """Points [48,2] on a circular arc."""
    angle = np.radians(np.linspace(start_deg, stop_deg, 48))
    return np.array(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], 1)


def rectangle(half_width: float, low: float, high: float) -> list[tuple[float, float]]:
    """Corners from the lower right over lower left and upper left to the upper right (negative y is right)."""
    return [(-half_width, low), (half_width, low), (half_width, high), (-half_width, high)]


def paint_side(s: CarShape, outlines: dict[str, np.ndarray], side: int) -> Layer:
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


def paint_front(s: CarShape, outlines: dict[str, np.ndarray]) -> Layer:
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


def paint_rear(s: CarShape, outlines: dict[str, np.ndarray]) -> Layer:
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
    c.fill(rectangle(0.30, tail - 0.15, tail), PLASTIC)
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


def paint_top(s: CarShape) -> Layer:
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


def paint_under(s: CarShape) -> Layer:
    """Dark underside."""
    half, wide = s.length / 2 + 0.1, s.width / 2 + 0.1
    c = _Canvas((0, 0, -1), (0, 1, 0), (1, 0, 0), (-wide, half), (2 * wide, 2 * half))
    c.fill([(-wide, -half), (wide, -half), (wide, half), (-wide, half)], PLASTIC)
    return c.layer(0.5)


def paint_plate(s: CarShape, outline: np.ndarray, facing: int) -> Layer:
    """A number plate seen from the front (facing = 1) or the rear (facing = -1)."""
    low, high = outline[:, 1].min(), outline[:, 1].max()
    c = _Canvas((facing, 0, 0), (0, facing, 0), (0, 0, 1), (-0.3, high + 0.02), (0.6, high - low + 0.04))
    c.fill(rectangle(0.27, low - 0.01, high + 0.01), BLACK, 0.2)
    c.fill(rectangle(0.25, low + 0.01, high - 0.01), WHITE if facing > 0 else (232, 200, 60), 0.2)
    blue = np.array([(-0.25, low + 0.01), (-0.21, low + 0.01), (-0.21, high - 0.01), (-0.25, high - 0.01)])
    c.fill(blue * (facing, 1), (24, 60, 160), 0.2)
    c.text("KR 0NC 66", (-0.19 * facing, low + 0.032), 0.048, BLACK)
    return c.layer(0.5)
