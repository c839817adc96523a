"""What the surfaces of a car look like: its paint and what the names of surfaces tell."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int

from kronc_ns.training.meshes import TexturedMesh
from kronc_ns.training.shading import GLASS, LAMP, MATTE, METAL, PAINT, TYRE

_PAINT_NAMES = ("paint", "primary", "body.001", "body2.001")  # the last ones: cars that do not follow our names
_PAINTS = {  # share on the road, range of linear colours
    "white": (0.22, (0.75, 0.75, 0.73), (0.92, 0.92, 0.92)),
    "black": (0.19, (0.004, 0.004, 0.004), (0.02, 0.02, 0.022)),
    "silver": (0.16, (0.35, 0.35, 0.34), (0.6, 0.61, 0.62)),
    "grey": (0.16, (0.05, 0.05, 0.05), (0.25, 0.25, 0.26)),
    "red": (0.08, (0.25, 0.005, 0.005), (0.6, 0.04, 0.03)),
    "blue": (0.09, (0.004, 0.01, 0.06), (0.06, 0.18, 0.55)),
    "green": (0.03, (0.005, 0.04, 0.01), (0.25, 0.45, 0.08)),
    "warm": (0.04, (0.2, 0.1, 0.02), (0.75, 0.45, 0.15)),
    "any": (0.03, (0.0, 0.0, 0.0), (0.9, 0.9, 0.9)),
}


@dataclass(frozen=True, eq=False)
class Look:
    """What each surface of a mesh looks like, in linear colours."""

    kind: Int[np.ndarray, "s"]
    rgb: Float32[np.ndarray, "s 3"]
    tint: float
    """What a window lets through."""
    flake: float
    dirt: float
    dirt_rgb: Float32[np.ndarray, "3"]


def kind_of(name: str) -> int:
    """What a surface is by its name."""
    name = name.lower()
    if name.startswith(
        ("light", "left_front_light", "right_front_light", "lens", "breaklight", "foglight", "revlight")
    ):
        return LAMP
    if name in _PAINT_NAMES or name.startswith("paint"):
        return PAINT
    if "glass" in name:
        return GLASS
    if name.startswith(("tyre", "tire")):
        return TYRE
    if name.startswith(("rim", "chrome", "w_gold", "w_chrome", "aluminium")):
        return METAL
    return LAMP if name.endswith(("_rear_light", "indicator_rf", "indicator_lf")) else MATTE


def draw_look(rng: np.random.Generator, mesh: TexturedMesh) -> Look:
    """Paint in the colours of the road, tinted or clear windows, chrome or black trim, dirt at times."""
    names = list(_PAINTS)
    shares = np.array([_PAINTS[name][0] for name in names])

    def draw_paint() -> np.ndarray:
        _, low, high = _PAINTS[names[int(rng.choice(len(names), p=shares / shares.sum()))]]
        if low == (0.0, 0.0, 0.0):
            return rng.uniform(low, high)
        return np.array(low) + rng.uniform() * (np.array(high) - np.array(low)) * rng.uniform(0.9, 1.1, 3)

    paint = draw_paint()
    top = draw_paint() if rng.uniform() < 0.12 else paint
    rgb = np.array([surface.rgb for surface in mesh.surfaces]) ** 2.2
    kind = np.array([kind_of(surface.name) for surface in mesh.surfaces])
    black_trim, dark_rims = rng.uniform(0.01, 0.05), rng.uniform() < 0.25
    hue = rng.uniform(0.7, 1.2, 3) * rng.uniform(0.7, 1.2)
    for index, surface in enumerate(mesh.surfaces):
        name = surface.name.lower()
        if kind[index] == PAINT:
            rgb[index] = top if name == "paint_top" else paint
        elif name == "trim":
            rgb[index] = black_trim
            if rng.uniform() < 0.1:
                kind[index], rgb[index] = METAL, 0.6
        elif kind[index] == METAL:
            rgb[index] = rng.uniform(0.02, 0.08) if dark_rims and "chrome" not in name else rng.uniform(0.4, 0.85)
        elif kind[index] == GLASS:
            rgb[index] = rng.uniform(0.002, 0.03) * rng.uniform(0.8, 1.2, 3)
        elif kind[index] == TYRE:
            rgb[index] = rng.uniform(0.01, 0.05) if surface.texture is None else rng.uniform(0.4, 1.2)
        elif surface.texture is not None:
            rgb[index] = np.clip(rgb[index] * hue, 0, 1)
    dirt = rng.uniform(0.1, 0.8) if rng.uniform() < 0.15 else 0.0
    return Look(
        kind,
        np.clip(rgb, 0, 1).astype(np.float32),
        float(rng.uniform(0.0, 0.85)),
        float(rng.choice([0.0, rng.uniform(0.2, 1.0)])),
        float(dirt),
        np.array([0.16, 0.12, 0.08], np.float32) * np.float32(rng.uniform(0.5, 1.6)),
    )
