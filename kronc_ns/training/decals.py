"""What is painted on a body: features its mesh does not show, and what makes every car look different."""

from collections.abc import Sequence
from typing import Literal, TypeAlias

import cv2
import numpy as np

from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.training.body import Body, Decal

Side: TypeAlias = Literal["left", "right", "front", "rear", "top"]
METRES_PER_TEXEL = 0.004
_AXES: dict[Side, tuple[int, int]] = {"left": (0, 2), "right": (0, 2), "front": (1, 2), "rear": (1, 2), "top": (0, 1)}
_SKIN = ("paint", "body", "trim", "primary")  # what seams and stickers are painted on
_LETTERS = "ABCDEFGHJKLMNPRSTUVWXYZ0123456789"


class _Canvas:
    """One side of a body, drawn in metres."""

    def __init__(self, body: Body, side: Side) -> None:
        a, b = _AXES[side]
        low, high = body.mesh.vertices.min(0), body.mesh.vertices.max(0)
        self.side: Side = side
        self.corner = (float(low[a]) - 0.05, float(high[b]) + 0.05)
        shape = (int((high[b] - low[b] + 0.1) / METRES_PER_TEXEL), int((high[a] - low[a] + 0.1) / METRES_PER_TEXEL))
        self.image = np.zeros((*shape, 4), np.uint8)

    def texels(self, points: np.ndarray) -> np.ndarray:
        at = np.column_stack([points[:, 0] - self.corner[0], self.corner[1] - points[:, 1]]) / METRES_PER_TEXEL
        return np.round(at * 16).astype(np.int32)

    def line(self, points: np.ndarray, rgb: Sequence[int], width_m: float) -> None:
        thick = max(1, round(width_m / METRES_PER_TEXEL))
        cv2.polylines(self.image, [self.texels(points)], False, (*rgb, 255), thick, cv2.LINE_AA, 4)

    def fill(self, points: np.ndarray, rgb: Sequence[int], alpha: int = 255) -> None:
        cv2.fillPoly(self.image, [self.texels(points)], (*rgb, alpha), cv2.LINE_AA, 4)

    def disc(self, at: np.ndarray, radius_m: float, rgb: Sequence[int]) -> None:
        centre = self.texels(at[None])[0]
        radius = round(16 * radius_m / METRES_PER_TEXEL)
        cv2.circle(self.image, (int(centre[0]), int(centre[1])), radius, (*rgb, 255), -1, cv2.LINE_AA, 4)

    def text(self, at: np.ndarray, words: str, size_m: tuple[float, float], rgb: Sequence[int]) -> None:
        """Letters from a lower left corner, at most so wide and high, readable from outside."""
        width, height = (max(4, round(v / METRES_PER_TEXEL)) for v in size_m)
        (wide, high), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_DUPLEX, 2.0, 4)
        stamp = np.zeros((high + 12, wide + 8), np.uint8)
        cv2.putText(stamp, words, (4, high + 6), cv2.FONT_HERSHEY_DUPLEX, 2.0, (255,), 4, cv2.LINE_AA)
        width = min(width, round(1.1 * height * wide / high))
        stamp = cv2.resize(stamp, (width, height), interpolation=cv2.INTER_AREA)
        stamp = stamp[:, ::-1] if self.side in ("left", "rear") else stamp
        column, row = self.texels(at[None])[0] // 16
        top = row - height
        if top < 0 or column < 0 or row > self.image.shape[0] or column + width > self.image.shape[1]:
            return
        patch = self.image[top:row, column : column + width]
        share = stamp[..., None] / 255
        patch[..., :3] = (patch[..., :3] * (1 - share) + np.array(rgb) * share).astype(np.uint8)
        patch[..., 3] = np.maximum(patch[..., 3], stamp)

    def decal(self, surfaces: tuple[str, ...] | None) -> Decal:
        return Decal(self.side, self.image, self.corner, METRES_PER_TEXEL, surfaces)


def painted(body: Body, draw: Sequence[str], rng: np.random.Generator) -> Body:
    """The body with what ``draw`` lists, with plates or without, and with ornaments.

    Plates that are left out take their keypoints along: those become NaN.
    """
    keypoints = body.keypoints.copy()
    skin = tuple(s.name for s in body.mesh.surfaces if s.name.lower().startswith(_SKIN))
    decals, plates = [], []
    seam = tuple(int(v) for v in np.full(3, rng.integers(0, 40)))
    for side in ("left", "right"):
        p = keypoints[:, list(_AXES[side])]
        flip = [*range(66)] if side == "left" else _mirror()
        canvas = _Canvas(body, side)
        state = rng.bit_generator.state
        _paint_side(canvas, p[flip], draw, seam, rng)
        if side == "left":
            rng.bit_generator.state = state  # both sides alike
        decals.append(canvas.decal(skin))
    for side in ("front", "rear"):
        canvas = _Canvas(body, side)
        p = keypoints[:, list(_AXES[side])]
        (_paint_front if side == "front" else _paint_rear)(canvas, p, draw, seam, rng)
        decals.append(canvas.decal(skin))
        corners = [58, 59, 61, 60] if side == "front" else [63, 62, 65, 64]
        if f"{side}_plate" not in draw and rng.uniform() < 0.6:
            continue  # the mesh shows its own
        plate = _Canvas(body, side)
        if np.isfinite(p[corners]).all() and rng.uniform() < 0.6:
            _paint_plate(plate, p[corners], side, rng)
            plates.append(plate.decal(None))
        elif f"{side}_plate" in draw:
            keypoints[corners] = np.nan
    if "bonnet" in draw:
        canvas = _Canvas(body, "top")
        _paint_bonnet(canvas, keypoints[:, :2], seam, rng)
        decals.append(canvas.decal(skin))
    return Body(body.name, body.mesh, keypoints, (*body.decals, *decals, *plates))


def _mirror() -> list[int]:
    return list(APOLLOCAR3D_66.flip)


def _rounded(points: np.ndarray, radius_m: float = 0.03) -> np.ndarray:
    """A closed polygon whose corners are cut, as seams are drawn."""
    ahead = np.roll(points, -1, axis=0)
    share = np.clip(radius_m / np.maximum(np.linalg.norm(ahead - points, axis=1, keepdims=True), 1e-6), 0, 0.4)
    cut = np.stack([points + share * (ahead - points), ahead - share * (ahead - points)], axis=1).reshape(-1, 2)
    return np.concatenate([cut, cut[:1]])


def _paint_side(
    canvas: _Canvas, p: np.ndarray, draw: Sequence[str], seam: tuple[int, ...], rng: np.random.Generator
) -> None:
    """Seen along y; ``p`` in the order of the left side."""
    width = float(rng.uniform(0.004, 0.010))
    if rng.uniform() < 0.15:  # black arches
        rgb, grow = (int(rng.integers(15, 60)),) * 3, rng.uniform(1.25, 1.4)
        for hub in (7, 20):
            canvas.disc(p[hub], grow * p[hub, 1], rgb)
    if rng.uniform() < 0.2 and np.isfinite(p[[6, 10, 15, 21]]).all():  # black cladding along the sill
        low, thick = min(p[10, 1], p[15, 1]) - 0.15, rng.uniform(0.1, 0.22)
        sill = np.array([[p[6, 0], low], [p[21, 0], low], [p[21, 0], low + thick], [p[6, 0], low + thick]])
        canvas.fill(sill, tuple(int(v) for v in np.full(3, rng.integers(10, 60))))
    if rng.uniform() < 0.15:  # moulding
        height = rng.uniform(0.3, 0.75) * (p[12, 1] - p[10, 1]) + p[10, 1]
        rgb = tuple(int(v) for v in np.full(3, rng.choice([20, 35, 60, 200])))
        canvas.line(
            np.array([[p[10, 0], height], [p[21, 0], height + rng.uniform(-0.05, 0.1)]]), rgb, rng.uniform(0.01, 0.06)
        )
    if "front_door" in draw:
        canvas.line(_rounded(p[[9, 10, 15, 12]]), seam, width)
    if "rear_door" in draw and np.isfinite(p[[12, 15, 19, 16]]).all():
        canvas.line(_rounded(p[[12, 15, 19, 16]]), seam, width)
    for name, front, rear in (("front_handle", 13, 14), ("rear_handle", 17, 18)):
        if name not in draw or not np.isfinite(p[[front, rear]]).all():
            continue
        shade = int(rng.choice([15, 40, 120, 220]))
        canvas.line(p[[front, rear]] - [0, 0.012], (10, 10, 10), 0.03)
        canvas.line(p[[front, rear]], (shade, shade, shade), 0.022)
    if rng.uniform() < 0.35:  # fuel cap
        at = np.array([p[20, 0] - rng.uniform(-0.05, 0.3), p[12, 1] - rng.uniform(0.06, 0.14)])
        square = at + np.array([[0.085, 0], [-0.085, 0], [-0.085, -0.16], [0.085, -0.16]])
        canvas.line(_rounded(square), seam, width)
    if rng.uniform() < 0.06:  # lettering
        words = "".join(rng.choice(list(_LETTERS), int(rng.integers(3, 9))))
        rgb = tuple(int(v) for v in rng.integers(0, 255, 3))
        size = (rng.uniform(0.3, 1.0), rng.uniform(0.06, 0.25))
        canvas.text(p[15] + [rng.uniform(-0.5, 0.1), rng.uniform(0.1, 0.3)], words, size, rgb)


def _paint_front(
    canvas: _Canvas, p: np.ndarray, draw: Sequence[str], seam: tuple[int, ...], rng: np.random.Generator
) -> None:
    """Seen along x: grille, intakes, lamps."""
    inner, low = p[0, 0], p[1]
    if rng.uniform() < 0.3:
        top, bottom = p[0, 1] - rng.uniform(0.0, 0.05), low[1] - rng.uniform(0.02, 0.12)
        half = rng.uniform(0.6, 0.95) * inner
        shape = np.array([[-half, top], [half, top], [0.9 * half, bottom], [-0.9 * half, bottom]])
        dark = int(rng.integers(5, 45))
        canvas.fill(shape, (dark, dark, dark))
        bright = int(rng.choice([50, 120, 210]))
        for height in np.linspace(bottom, top, int(rng.integers(3, 9)))[1:-1]:
            canvas.line(np.array([[-0.93 * half, height], [0.93 * half, height]]), (bright, bright, bright), 0.008)
        canvas.disc(np.array([0.0, (top + bottom) / 2]), rng.uniform(0.03, 0.07), (190, 190, 195))
    if rng.uniform() < 0.3 and np.isfinite(p[5]).all():
        half, height = (rng.uniform(0.4, 0.9) * p[5, 0], p[5, 1] - rng.uniform(-0.05, 0.05))
        shape = np.array([[-half, height], [half, height], [0.85 * half, height - 0.12], [-0.85 * half, height - 0.12]])
        canvas.fill(shape, (15, 15, 15))
    for flip in (False, True):
        order = _mirror() if flip else list(range(66))
        q = p[order]
        if "front_lamp" in draw:
            lamp = q[[0, 1, 3, 2]]
            canvas.fill(lamp.mean(0) + 1.05 * (lamp - lamp.mean(0)), (25, 25, 28))
            canvas.fill(lamp.mean(0) + 0.94 * (lamp - lamp.mean(0)), (170, 175, 180))
            canvas.disc(0.6 * lamp.mean(0) + 0.4 * lamp[0], 0.05, (240, 242, 245))
            canvas.disc(0.6 * lamp.mean(0) + 0.4 * lamp[3], 0.045, (90, 92, 95))
        if "fog" in draw and np.isfinite(q[[4, 5]]).all():
            step = -0.14 * np.sign(q[4, 0])
            recess = np.array([q[4], q[5], q[5] + [step, 0.01], q[4] + [step, -0.005]])
            canvas.fill(recess, (20, 20, 20))
            canvas.disc(recess.mean(0), 0.035, (150, 155, 160))
    if rng.uniform() < 0.3:
        canvas.line(np.array([[-inner, p[0, 1] + 0.02], [inner, p[0, 1] + 0.02]]), seam, 0.008)


def _paint_bonnet(canvas: _Canvas, p: np.ndarray, seam: tuple[int, ...], rng: np.random.Generator) -> None:
    """Seen from above: the seams from the lamps to the foot of the windscreen."""
    inset, bow = rng.uniform(0.02, 0.10), rng.uniform(0.0, 0.08)
    for order in (list(range(66)), _mirror()):
        lamp, door = p[order][0], p[order][9]
        side = np.sign(lamp[1])
        foot = np.array([door[0] + 0.12, door[1] - side * (0.06 + inset)])
        front = np.array([lamp[0] - 0.02, lamp[1]])
        bend = np.array([0.5 * (foot[0] + lamp[0]) + 0.1, foot[1] - side * 0.02])
        canvas.line(np.array([front, 0.6 * bend + 0.4 * front + [0, side * bow], bend, foot]), seam, 0.006)


def _paint_rear(
    canvas: _Canvas, p: np.ndarray, draw: Sequence[str], seam: tuple[int, ...], rng: np.random.Generator
) -> None:
    """Seen along x: lamps, the boot's seam, a bumper in black."""
    if rng.uniform() < 0.25:
        low = p[28, 1] - rng.uniform(0.02, 0.12)
        half = 0.75 * p[28, 0]
        canvas.fill(
            np.array([[-half, low], [half, low], [0.9 * half, low - 0.2], [-0.9 * half, low - 0.2]]), (18, 18, 18)
        )
    for flip in (False, True):
        q = p[_mirror() if flip else list(range(66))]
        if "rear_lamp" in draw:
            lamp = q[[25, 26, 23, 22]]
            canvas.fill(lamp, (150, 12, 14))
            canvas.fill(lamp.mean(0) + [0.6, 0.35] * (lamp - lamp.mean(0)), (225, 215, 210))
    if "boot" in draw:
        lid = np.array([p[25], p[27], p[30], p[32]])
        canvas.line(_rounded(lid), seam, rng.uniform(0.005, 0.01))
    if rng.uniform() < 0.3:
        words = "".join(rng.choice(list(_LETTERS), int(rng.integers(2, 6))))
        canvas.text(p[27] + [-0.3, 0.12], words, (0.3, rng.uniform(0.04, 0.07)), (200, 200, 205))


def _paint_plate(canvas: _Canvas, corners: np.ndarray, side: Side, rng: np.random.Generator) -> None:
    """``corners`` in order around the plate."""
    ground = ((238, 238, 235), (230, 195, 60), (240, 240, 245), (30, 60, 150), (20, 20, 20))[
        int(rng.choice(5, p=[0.5, 0.2, 0.2, 0.05, 0.05]))
    ]
    ink = (20, 20, 25) if sum(ground) > 350 else (235, 235, 235)
    canvas.fill(corners, (25, 25, 25))
    middle = corners.mean(0)
    inner = middle + np.array([0.97, 0.9]) * (corners - middle)
    canvas.fill(inner, ground)
    low, high = inner.min(0), inner.max(0)
    left, right = low[0], high[0]
    if rng.uniform() < 0.4:  # the blue strip of Europe, on the reader's left
        edge = 0.08 * (right - left)
        strip = (left, left + edge) if side == "front" else (right - edge, right)
        canvas.fill(
            np.array([[strip[0], low[1]], [strip[1], low[1]], [strip[1], high[1]], [strip[0], high[1]]]), (25, 55, 150)
        )
        left, right = (left + edge, right) if side == "front" else (left, right - edge)
    words = "".join(rng.choice(list(_LETTERS), int(rng.integers(5, 9))))
    size = (0.9 * (right - left), rng.uniform(0.5, 0.72) * (high[1] - low[1]))
    canvas.text(np.array([left + 0.05 * (right - left), low[1] + 0.16 * (high[1] - low[1])]), words, size, ink)
