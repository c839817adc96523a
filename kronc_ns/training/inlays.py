"""What is cut into the skin of procedural bodies: windows, lamps, grilles, trim; and their colours."""

from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from kronc_ns.synthetic.car_parts import CarShape

Inlay: TypeAlias = tuple[str, Float[np.ndarray, "_ 2"], str]
"""View, outline whose convex hull is cut out (metres, left half), surface."""


def draw_colours(rng: np.random.Generator) -> dict[str, Float[np.ndarray, "3"]]:
    """Of lamps, grilles and the cabin, 0 to 1."""
    lamp, red = rng.uniform(0.45, 0.95), rng.uniform(0.45, 0.85)
    return {
        "light_front": lamp * np.array([0.97, 0.99, 1.0]),
        "light_front_bezel": np.full(3, rng.choice([rng.uniform(0.05, 0.2), rng.uniform(0.5, 0.9)])),
        "light_front_amber": np.array([0.95, 0.55, 0.15]),
        "light_rear": red * np.array([1.0, rng.uniform(0.03, 0.2), rng.uniform(0.05, 0.2)]),
        "light_rear_dark": 0.5 * red * np.array([1.0, 0.08, 0.1]),
        "light_rear_clear": np.full(3, rng.uniform(0.7, 0.95)),
        "grille": np.full(3, rng.uniform(0.03, 0.25)),
        "inside": np.full(3, rng.uniform(0.05, 0.2)),
        "seat": rng.uniform(0.1, 0.5) * np.array([1.0, rng.uniform(0.85, 1.0), rng.uniform(0.7, 1.0)]),
        "lining": np.full(3, rng.uniform(0.15, 0.75)),
        "dark": np.full(3, 0.05),
        "frit": np.full(3, 0.1),
    }


def side_inlays(s: CarShape, windows: list[np.ndarray], rng: np.random.Generator) -> list[Inlay]:
    """Side windows from front to rear, their frame, a black sill."""
    inlays = []
    frame = rng.choice(["", "frit", "chrome"], p=[0.3, 0.5, 0.2])
    if frame:
        whole = np.concatenate(windows)
        grown = whole.mean(0) + (whole - whole.mean(0)) * (1.015, 1.0)
        edge = rng.uniform(0.012, 0.022)
        inlays.append(("side", np.concatenate([grown + np.array([0, edge]), grown - np.array([0, edge])]), str(frame)))
        if frame == "chrome":
            inlays.append(
                (
                    "side",
                    np.concatenate([grown + np.array([0, edge - 0.012]), grown - np.array([0, edge - 0.012])]),
                    "frit",
                )
            )
    inlays += [("side", piece, "glass") for piece in windows]
    if rng.uniform() < 0.35:  # black sill
        top = s.clearance + rng.uniform(0.05, 0.10)
        box = [(s.front_axle_x, 0.0), (s.rear_axle_x, 0.0), (s.rear_axle_x, top), (s.front_axle_x, top)]
        inlays.append(("side", np.array(box), "trim"))
    return inlays


def screen_inlays(outlines: dict[str, np.ndarray], rng: np.random.Generator) -> list[Inlay]:
    """Windscreen and rear screen with the black edge of the glass."""
    inlays = []
    for view in ("front", "rear"):
        screen = outlines[f"{view}_screen"]
        left = screen[screen[:, 0] > -0.01]
        left = np.concatenate([left[::4], left[-1:], screen[[12, 24]]])  # the corners are among them
        inlays.append((view, left, "frit"))
        middle = np.array([0.0, screen[:, 1].mean()])
        inlays.append((view, middle + (left - middle) * (rng.uniform(0.93, 0.99), rng.uniform(0.88, 0.97)), "glass"))
    return inlays


def front_inlays(
    s: CarShape, outlines: dict[str, np.ndarray], absent: tuple[str, ...], rng: np.random.Generator
) -> list[Inlay]:
    """Grilles, bars, lamps, badge, in the order in which they lie over each other."""
    w, lamp, fog = s.width / 2, outlines["front_lamp"], outlines["front_fog"]
    inlays = []
    top, inner = lamp[0, 1] + rng.uniform(-0.03, 0.01), lamp[:2, 0].min()
    if rng.uniform() < 0.85:
        half = rng.uniform(0.55, 1.0) * inner - 0.01
        low = top - rng.choice([rng.uniform(0.05, 0.12), rng.uniform(0.12, 0.36)])
        foot = rng.uniform(0.65, 1.05) * half
        shape = np.array(
            [(0, top), (half, top), (half * 0.5 + foot * 0.5 + 0.02, 0.5 * (top + low)), (foot, low), (0, low)]
        )
        if rng.uniform() < 0.5:
            inlays.append(
                ("front", shape + (shape - shape.mean(0)) * (0.05, 0.12), str(rng.choice(["chrome", "trim"])))
            )
        inlays.append(("front", shape, "grille"))
        metal = str(rng.choice(["chrome", "trim", "paint"]))
        for z in np.linspace(low, top, int(rng.integers(2, 8)))[1:-1]:
            inlays.append(
                ("front", np.array([(0, z - 0.006), (half, z - 0.006), (half, z + 0.006), (0, z + 0.006)]), metal)
            )
    base = s.clearance + 0.05
    if rng.uniform() < 0.8:
        half, high = rng.uniform(0.4, 0.72) * w, base + rng.uniform(0.08, 0.2)
        inlays.append(
            ("front", np.array([(0, base), (half, base), (rng.uniform(0.8, 1.0) * half, high), (0, high)]), "grille")
        )
    if rng.uniform() < 0.25:
        inlays.append(("front", np.array([(0, 0.0), (w, 0.0), (w, base + 0.02), (0, base + 0.02)]), "trim"))
    inlays.append(("front", _rounded(lamp, 1.0), "light_front_bezel"))
    inlays.append(("front", _rounded(lamp, rng.uniform(0.8, 0.97)), "light_front"))
    middle, reach = lamp.mean(0), 0.5 * (lamp[[2, 3]].mean(0) - lamp[[0, 1]].mean(0))
    radius = 0.4 * min(lamp[0, 1] - lamp[1, 1], lamp[3, 1] - lamp[2, 1])
    for at in ((0.0,), (-0.45, 0.3), (-0.5,), (-0.55, 0.0, 0.5))[int(rng.integers(4))]:
        inlays.append(("front", _disc(middle + at * reach, radius), "light_front_bezel"))
        inlays.append(("front", _disc(middle + at * reach, 0.65 * radius), "light_front"))
    if rng.uniform() < 0.3:
        inlays.append(
            ("front", np.array([lamp[1], lamp[2], lamp[2] + (0, 0.02), lamp[1] + (0, 0.02)]), "light_front_amber")
        )
    if "front_fog" not in absent:
        inlays.append(("front", fog, "grille"))
        if rng.uniform() < 0.7:
            inlays.append(("front", _disc(fog.mean(0), 0.45 * np.ptp(fog[:, 1])), "light_front"))
    inlays.append(("front", _disc(np.array([0.0, top - 0.05]), rng.uniform(0.03, 0.06)), "chrome"))
    return inlays


def rear_inlays(s: CarShape, outlines: dict[str, np.ndarray], rng: np.random.Generator) -> list[Inlay]:
    """Plate recess, bumper, bar, lamps."""
    w, lamp, plate = s.width / 2, outlines["rear_lamp"], outlines["rear_plate"]
    inlays = []
    if rng.uniform() < 0.5:
        grown = plate.mean(0) + (plate - plate.mean(0)) * (rng.uniform(1.05, 1.5), rng.uniform(1.1, 1.5))
        inlays.append(("rear", grown, str(rng.choice(["trim", "inside", "paint"]))))
    if rng.uniform() < 0.5:
        high = s.clearance + rng.uniform(0.08, 0.22)
        inlays.append(
            ("rear", np.array([(0, 0.0), (0.9 * w, 0.0), (rng.uniform(0.5, 0.95) * w, high), (0, high)]), "trim")
        )
    if rng.uniform() < 0.3:  # a bar between the lamps
        z = lamp[0, 1] - rng.uniform(0.02, 0.05)
        bar = np.array([(0, z), (lamp[0, 0], z), (lamp[0, 0], z + 0.018), (0, z + 0.018)])
        inlays.append(("rear", bar, str(rng.choice(["chrome", "light_rear", "trim"]))))
    inlays.append(("rear", _rounded(lamp, 1.0), str(rng.choice(["light_rear", "light_rear_dark"]))))
    inlays.append(("rear", _rounded(lamp, rng.uniform(0.75, 0.95)), "light_rear"))
    across = rng.uniform(0.2, 0.8) * (lamp[[2, 3]] - lamp[[1, 0]])
    kind = int(rng.integers(4))
    if kind == 0:
        inlays.append(("rear", _disc(lamp.mean(0), 0.3 * np.ptp(lamp[:, 1])), "light_rear_clear"))
    elif kind == 1:
        inlays.append(("rear", np.concatenate([lamp[[1, 0]], lamp[[1, 0]] + 0.4 * across]), "light_rear_clear"))
    elif kind == 2:
        band = 0.65 * lamp[[1, 2]] + 0.35 * lamp[[0, 3]]
        inlays.append(("rear", np.concatenate([band, 0.9 * lamp[[1, 2]] + 0.1 * lamp[[0, 3]]]), "light_rear_clear"))
    return inlays


def _rounded(outline: Float[np.ndarray, "k 2"], size: float) -> Float[np.ndarray, "_ 2"]:
    """A polygon scaled about its middle, its corners cut a little."""
    shape = outline.mean(0) + size * (outline - outline.mean(0))
    ahead = np.roll(shape, -1, axis=0)
    return np.concatenate([0.95 * shape + 0.05 * ahead, 0.05 * shape + 0.95 * ahead])


def _disc(centre: Float[np.ndarray, "2"], radius: float) -> Float[np.ndarray, "12 2"]:
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    return centre + radius * np.stack([np.cos(angle), np.sin(angle)], 1)
