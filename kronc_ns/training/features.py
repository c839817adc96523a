"""Lamps, windows, doors and grilles of procedural bodies: what they look like and where they lie."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from kronc_ns.synthetic.car import features as usual_features
from kronc_ns.synthetic.car_paint import rectangle
from kronc_ns.synthetic.car_parts import CarShape, deck_height, tail_height
from kronc_ns.training.inlays import Inlay, draw_colours, front_inlays, rear_inlays, screen_inlays, side_inlays

_PLATES_M = ((0.26, 0.11), (0.26, 0.11), (0.165, 0.165), (0.153, 0.153))  # half width, height: Europe, Japan, America


@dataclass(frozen=True, eq=False)
class Features:
    """The left half of what a body shows."""

    outlines: dict[str, Float[np.ndarray, "_ 2"]]
    """Metres, as `kronc_ns.synthetic.car.features` lists them."""
    inlays: tuple[Inlay, ...]
    """Later ones lie over earlier ones."""
    colours: dict[str, Float[np.ndarray, "3"]]
    """Of surfaces whose look nobody draws."""
    two_doors: bool
    absent: tuple[str, ...] = ()
    """Outlines that the car does not have."""


def draw_features(s: CarShape, two_doors: bool, rng: np.random.Generator) -> Features:
    """Of a random design; `ValueError` where the shape leaves no room for a feature."""
    outlines = usual_features(s)
    w, hood, tail = s.width / 2, s.nose_height, tail_height(s)
    outlines["front_lamp"] = _draw_lamp(rng, w, hood - rng.uniform(0.06, 0.13), rng.uniform(0.05, 0.17))
    outlines["rear_lamp"] = _draw_tail(rng, s, tail)
    top = min(rng.uniform(0.40, 0.50) + s.clearance - 0.17, outlines["front_lamp"][:, 1].min() - 0.06)
    outer, size = rng.uniform(0.70, 0.85) * w, rng.uniform(0.09, 0.2)
    low = top - rng.uniform(0.05, 0.12)
    outlines["front_fog"] = np.array(
        [(outer - size, top), (outer - size * 0.9, low), (outer - 0.01, low + 0.01), (outer, top)]
    )
    half, high = _PLATES_M[int(rng.integers(4))]
    foot = rng.uniform(0.34, 0.46) + s.clearance - 0.17
    outlines["front_plate"] = np.array(rectangle(half, foot, foot + high))
    lamp_low, on_lid = outlines["rear_lamp"][:, 1].min(), rng.uniform() < 0.75
    top = min(tail - rng.uniform(0.0, 0.12), tail - 0.02) if on_lid else rng.uniform(0.46, 0.54) + s.clearance - 0.17
    outlines["rear_plate"] = np.array(rectangle(half, top - high, top))
    seam = min(rng.uniform(0.50, 0.66), lamp_low - 0.06, top - high - 0.03 if on_lid else np.inf)
    outlines["rear_boot"] = np.array([(rng.uniform(0.52, 0.68) * w, seam)])
    outlines["rear_bumper"] = np.array([(rng.uniform(0.79, 0.85) * w, rng.uniform(0.43, 0.5) + s.clearance - 0.17)])
    windows = _draw_doors(s, outlines, two_doors, rng)
    absent = ("front_fog",) if rng.uniform() < 0.15 else ()
    inlays = [
        *side_inlays(s, windows, rng),
        *screen_inlays(outlines, rng),
        *front_inlays(s, outlines, absent, rng),
        *rear_inlays(s, outlines, rng),
    ]
    if rng.uniform() < 0.25:
        x = np.array([s.windscreen_top_x - 0.25, 0.4 * s.windscreen_top_x + 0.6 * s.rear_screen_top_x])
        inlays.append(("top", np.array([(a, b) for a in x for b in (-0.01, rng.uniform(0.35, 0.6) * w)]), "glass_roof"))
    return Features(outlines, tuple(inlays), draw_colours(rng), two_doors, absent)


def _draw_lamp(rng: np.random.Generator, w: float, top: float, height: float) -> Float[np.ndarray, "4 2"]:
    """Inner top, inner bottom, outer bottom, outer top."""
    inner, outer = rng.uniform(0.42, 0.62) * w, rng.uniform(0.80, 0.92) * w
    rise, taper = rng.uniform(-0.005, 0.05), rng.uniform(0.6, 1.3)
    outer_height = float(np.clip(height * taper, 0.05, 0.18))
    return np.array([
        (inner, top), (inner + rng.uniform(-0.01, 0.07), top - height),
        (outer + rng.uniform(-0.04, 0.01), top + rise - outer_height), (outer, top + rise),
    ])  # fmt: skip


def _draw_tail(rng: np.random.Generator, s: CarShape, tail: float) -> Float[np.ndarray, "4 2"]:
    """The same order: a block, a slim band or, on an upright tail, a tall lamp below the rear pillar."""
    w = s.width / 2
    kind = rng.choice(["block", "slim", "tall"], p=[0.45, 0.25, 0.3] if s.boot_length < 0.2 else [0.65, 0.35, 0.0])
    top = tail + rng.uniform(-0.05, 0.01)
    if kind == "tall":
        inner, outer, height = (rng.uniform(0.66, 0.76), rng.uniform(0.86, 0.92), rng.uniform(0.22, 0.42))
    elif kind == "slim":
        inner, outer, height = (rng.uniform(0.35, 0.55), rng.uniform(0.84, 0.92), rng.uniform(0.07, 0.11))
    else:
        inner, outer, height = (rng.uniform(0.45, 0.62), rng.uniform(0.80, 0.91), rng.uniform(0.12, 0.20))
    rise = rng.uniform(-0.01, 0.03)
    return np.array([
        (inner * w, top), ((inner + rng.uniform(-0.02, 0.05)) * w, top - height),
        ((outer - rng.uniform(-0.01, 0.04)) * w, top - height * rng.uniform(0.85, 1.1) + rise), (outer * w, top + rise),
    ])  # fmt: skip


def _draw_doors(
    s: CarShape, outlines: dict[str, np.ndarray], two_doors: bool, rng: np.random.Generator
) -> list[Float[np.ndarray, "_ 2"]]:
    """Move the doors' seams and handles; returns the outlines of the side windows from front to rear."""
    front, rear = outlines["side_front_door"], outlines["side_rear_door"]
    a_x, c_x = front[0, 0], rear[0, 0]
    b_x = front[4, 0] + rng.uniform(-0.06, 0.06) - (rng.uniform(0.12, 0.28) if two_doors else 0.0)
    upper, lower = np.split(outlines["side_windows"], 2)
    (x, top), sash = upper.T, lower[::-1, 1]
    belt = float(deck_height(s, np.array([b_x]))[0]) - 0.012
    lean = rng.uniform(0.02, 0.08)
    sill = front[3, 1] + rng.uniform(-0.03, 0.03)
    b_top = (b_x - lean, float(np.interp(lean - b_x, -x, top)) + 0.012)
    outlines["side_front_door"] = np.array([front[0], front[1], (a_x, sill), (b_x, sill), (b_x, belt), b_top])
    outlines["side_rear_door"] = np.concatenate([rear[:4], [(rear[4, 0], sill), (b_x, sill), (b_x, belt), b_top]])
    drop, length = rng.uniform(0.09, 0.19), rng.uniform(0.15, 0.23)
    for name, at in (("front", b_x + rng.uniform(0.04, 0.09)), ("rear", c_x + rng.uniform(0.06, 0.14))):
        z = float(deck_height(s, np.array([at]))[0]) - drop
        outlines[f"side_{name}_handle"] = np.array([(at + length, z), (at, z)])
    pillar = rng.uniform(0.03, 0.06)
    ends = [(x.max(), b_x + pillar / 2), (b_x - pillar, x.min())]
    if not two_doors and c_x - 0.16 - x.min() > 0.30:  # a third window behind the door
        ends[1:] = [(b_x - pillar, c_x - 0.06), (c_x - 0.06 - pillar, x.min())]
    pieces = []
    for start, stop in ends:
        at = np.linspace(start, stop, 7)
        shift = np.array([-lean * 0.6, 0.0]) if start < x.max() - 0.01 else np.zeros(2)
        upper = np.stack([at, np.interp(-at, -x, top)], 1) + shift * (at[:, None] == start)
        lower = np.stack([at, np.interp(-at, -x, sash)], 1)
        pieces.append(np.concatenate([upper, lower]))
    return pieces
