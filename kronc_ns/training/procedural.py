"""Procedural bodies for training: the synthetic car's geometry in many styles, its painted layers as decals."""

from dataclasses import replace

import numpy as np

from kronc_ns.synthetic.car import CarModel, build_car
from kronc_ns.synthetic.car_paint import METRES_PER_TEXEL, Layer
from kronc_ns.synthetic.car_parts import CarShape
from kronc_ns.training.body import Body, Decal
from kronc_ns.training.deformation import Proportions, deform
from kronc_ns.training.meshes import Surface, TexturedMesh

_STYLES: dict[str, dict[str, float]] = {
    "wagon": {"length": 4.75, "height": 1.49, "wheelbase": 2.80, "rear_screen_run": 0.38, "boot_length": 0.08},
    "van": {"length": 4.55, "height": 1.80, "width": 1.84, "belt_height": 1.05, "cowl_height": 1.10,
            "boot_height": 1.12, "bonnet_length": 0.95, "nose_height": 0.88, "rear_screen_run": 0.22,
            "boot_length": 0.05, "tumblehome": 0.25, "windscreen_run": 0.85},
    "coupe": {"length": 4.45, "height": 1.33, "belt_height": 0.90, "cowl_height": 0.94, "boot_height": 0.98,
              "boot_length": 0.42, "rear_screen_run": 0.95, "bonnet_length": 1.32, "windscreen_run": 0.85},
}  # fmt: skip
"""Bodies beside those that `CarShape.random` draws: where they differ from the hatchback."""
_SURFACES = {"body": "paint", "paint": "paint", "wheel": "rim", "dark": "inside"}
_VIEWS = ("left", "right", "front", "rear", "top")


def draw_procedural(rng: np.random.Generator) -> Body:
    """A hatchback, saloon, SUV, wagon, van or coupe."""
    while True:
        shape = CarShape.random(rng)
        if rng.uniform() < 0.5:
            style = str(rng.choice(sorted(_STYLES)))
            shape = replace(CarShape(), **_STYLES[style])
        try:
            body = procedural_body(build_car(shape))
        except ValueError:  # proportions without room for a feature
            continue
        return deform(body, Proportions.draw(rng)) if rng.uniform() < 0.7 else body


def procedural_body(car: CarModel) -> Body:
    """The car with surfaces named as those of meshes; its layers become decals."""
    names = list(dict.fromkeys(_materials(car)))
    surface = np.array([names.index(name) for name in _materials(car)])[car.face_material]
    mesh = TexturedMesh(
        np.asarray(car.mesh.vertices, np.float64),
        np.asarray(car.mesh.vertex_normals, np.float64),
        np.zeros((len(car.mesh.vertices), 2)),
        np.asarray(car.mesh.faces),
        surface,
        tuple(Surface(name, np.full(3, {"plate": 0.9, "inside": 0.05}.get(name, 0.5))) for name in names),
    )
    decals = []
    for name, layer in car.layers.items():
        view = name.removesuffix("_plate")
        if view not in _VIEWS:
            continue
        wears = {n for n, m in zip(_materials(car), car.materials, strict=True) if name in m.layers}
        decals.append(_decal(layer, view, tuple(sorted(wears))))
    return Body("procedural", mesh, car.keypoints.copy(), tuple(decals))


def _materials(car: CarModel) -> list[str]:
    """The synthetic car keeps the order in which it was given its materials."""
    return [_SURFACES.get(name, name) for name in ("body", "wheel", "tyre", "dark", "paint", "trim", "plate")]


def _decal(layer: Layer, view: str, surfaces: tuple[str, ...]) -> Decal:
    image = layer.levels[0][::2, ::2].astype(np.float32)
    alpha = image[..., 3:4]
    rgb = np.where(alpha > 0, image[..., :3] * 255 / np.maximum(alpha, 1), 0)
    rgba = np.concatenate([rgb, alpha], axis=2).clip(0, 255).astype(np.uint8)
    left, top = layer.corner
    metres = 2 * METRES_PER_TEXEL
    axis = layer.right[np.abs(layer.right).argmax()]
    if view == "top":  # seen with the front up: decals have x to the right and y up
        rgba = rgba[::-1, ::-1].transpose(1, 0, 2)  # rows: y falls, columns: x grows
        high_x, low_y = top, left * axis
        width = rgba.shape[1] * metres
        return Decal("top", np.ascontiguousarray(rgba), (high_x - width, max(low_y, -low_y)), metres, surfaces)
    if axis < 0:
        rgba, left = rgba[:, ::-1], -(left + rgba.shape[1] * metres)
    return Decal(view, np.ascontiguousarray(rgba), (float(left), float(top)), metres, surfaces, glossy=True)  # pyright: ignore[reportArgumentType]
