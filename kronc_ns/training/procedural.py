"""Procedural bodies for training: the skin of the synthetic car, with lamps, windows and grilles of its own cut in.

Features are surfaces of the mesh and not pictures on it, so that windows can be looked through, lamps shine, and all of
it follows when the proportions change.
"""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from kronc_ns.synthetic.car import KEYPOINTS, MIRROR
from kronc_ns.synthetic.car_parts import CarShape, Part, body_part, wheel_parts
from kronc_ns.training.body import Body
from kronc_ns.training.decals import painted
from kronc_ns.training.deformation import Proportions, deform
from kronc_ns.training.features import Features, draw_features
from kronc_ns.training.fittings import cabin_parts, outside_parts, rim_parts, roof_parts
from kronc_ns.training.labelling import cast
from kronc_ns.training.meshes import Surface, TexturedMesh

_STYLES: dict[str, tuple[float, dict[str, float]]] = {
    "hatchback": (2.0, {"length": 4.25, "wheelbase": 2.62, "bonnet_length": 1.05, "belt_height": 0.97,
                        "boot_height": 1.05}),
    "city": (1.0, {"length": 3.65, "width": 1.66, "height": 1.52, "wheelbase": 2.42, "wheel_radius": 0.29,
                   "bonnet_length": 0.86, "nose_height": 0.80, "cowl_height": 1.03, "belt_height": 0.98,
                   "rear_screen_run": 0.30, "boot_length": 0.05, "boot_height": 1.06, "tumblehome": 0.30}),
    "saloon": (2.0, {"length": 4.70, "height": 1.45, "wheelbase": 2.78, "boot_length": 0.50, "rear_screen_run": 0.80,
                     "boot_height": 1.06, "bonnet_length": 1.20, "belt_height": 0.97}),
    "limousine": (1.0, {"length": 5.00, "width": 1.88, "height": 1.46, "wheelbase": 2.98, "wheel_radius": 0.35,
                        "boot_length": 0.56, "rear_screen_run": 0.88, "boot_height": 1.07, "bonnet_length": 1.38}),
    "wagon": (1.2, {"length": 4.75, "height": 1.48, "wheelbase": 2.80, "rear_screen_run": 0.40, "boot_length": 0.08,
                    "bonnet_length": 1.20, "belt_height": 0.98, "boot_height": 1.05}),
    "crossover": (2.0, {"length": 4.40, "width": 1.83, "height": 1.60, "wheelbase": 2.65, "wheel_radius": 0.35,
                        "belt_height": 1.05, "cowl_height": 1.08, "nose_height": 0.88, "boot_height": 1.14,
                        "rear_screen_run": 0.36, "boot_length": 0.07, "clearance": 0.20, "bonnet_length": 1.05}),
    "suv": (2.0, {"length": 4.65, "width": 1.90, "height": 1.70, "wheelbase": 2.75, "wheel_radius": 0.375,
                  "belt_height": 1.10, "cowl_height": 1.13, "nose_height": 0.94, "boot_height": 1.18,
                  "rear_screen_run": 0.30, "boot_length": 0.06, "clearance": 0.23, "windscreen_run": 0.62}),
    "van": (1.0, {"length": 4.55, "width": 1.84, "height": 1.80, "wheelbase": 2.78, "belt_height": 1.06,
                  "cowl_height": 1.12, "boot_height": 1.12, "bonnet_length": 0.92, "nose_height": 0.88,
                  "rear_screen_run": 0.20, "boot_length": 0.05, "windscreen_run": 0.90, "tumblehome": 0.25}),
    "mpv": (1.2, {"length": 4.45, "width": 1.76, "height": 1.67, "wheelbase": 2.74, "wheel_radius": 0.31,
                  "belt_height": 1.01, "cowl_height": 1.10, "nose_height": 0.87, "boot_height": 1.09,
                  "bonnet_length": 0.95, "windscreen_run": 0.85, "rear_screen_run": 0.28, "boot_length": 0.05}),
    "sports": (1.4, {"length": 4.35, "width": 1.84, "height": 1.24, "wheelbase": 2.48, "belt_height": 0.84,
                     "cowl_height": 0.88, "nose_height": 0.64, "boot_height": 0.90, "boot_length": 0.30,
                     "rear_screen_run": 1.05, "bonnet_length": 1.30, "windscreen_run": 0.80, "clearance": 0.13}),
    "coupe": (1.8, {"length": 4.45, "height": 1.34, "wheelbase": 2.62, "belt_height": 0.90, "cowl_height": 0.94,
                    "boot_height": 0.98, "boot_length": 0.42, "rear_screen_run": 0.95, "bonnet_length": 1.32,
                    "windscreen_run": 0.85}),
}  # fmt: skip
"""Share among the styles, and where it differs from the synthetic car's default."""
_SPREAD = {"length": 0.02, "width": 0.02, "wheelbase": 0.015, "wheel_radius": 0.05, "clearance": 0.10,
           "nose_height": 0.04, "bonnet_length": 0.06, "windscreen_run": 0.10, "rear_screen_run": 0.15,
           "tumblehome": 0.2}  # fmt: skip
_TWO_DOORS = {"sports": 1.0, "coupe": 0.9, "city": 0.4, "hatchback": 0.25}  # share without rear doors
_REAR_DOOR = [16, 17, 18, 19, 38, 39, 40, 41]
_PAINTED = ("front_door", "rear_door", "bonnet", "boot", "front_plate", "rear_plate")
_AXES = {"side": (0, 2), "front": (1, 2), "rear": (1, 2), "top": (0, 1)}
_FACING = {"side": (0, 1, 0), "front": (1, 0, 0), "rear": (-1, 0, 0), "top": (0, 0, 1)}
_LEAST_FACING = 0.08  # cosine, of a surface that a feature is cut into
_LONGEST_EDGE_M = 0.12  # of the skin's triangles
_CAST_FROM = {"side": "left", "front": "front", "rear": "rear"}


class _Skin:
    """Left half of a body; outlines cut into it become surfaces of their own."""

    def __init__(self, part: Part) -> None:
        self.vertices, self.normals, self.faces = (part.vertices, part.normals, part.faces)
        self.names = np.full(len(part.faces), "paint", dtype=object)

    def inlay(self, view: str, outline: Float[np.ndarray, "k 2"], name: str) -> None:
        """Give what lies within the convex hull of an outline a name; edges are cut exactly."""
        hull = cv2.convexHull(outline.astype(np.float32))[:, 0].astype(np.float64)
        ahead = np.roll(hull, -1, axis=0)
        turn = np.sign((hull[:, 0] * ahead[:, 1] - hull[:, 1] * ahead[:, 0]).sum())
        axes = list(_AXES[view])
        at = self.vertices[:, axes]
        close = ((at > hull.min(0) - _LONGEST_EDGE_M) & (at < hull.max(0) + _LONGEST_EDGE_M)).all(1)
        close &= self.normals @ np.array(_FACING[view]) > _LEAST_FACING
        among = np.flatnonzero(close[self.faces[:, 0]])
        used, faces = np.unique(self.faces[among], return_inverse=True)
        patch = _Skin(Part(self.vertices[used], self.normals[used], faces.reshape(-1, 3), ""))
        patch.names = self.names[among]
        inside = np.arange(len(among))
        for start, stop in zip(hull, ahead, strict=True):
            along, to = stop - start, patch.vertices[:, axes] - start
            inside = patch._within(inside, turn * (along[0] * to[:, 1] - along[1] * to[:, 0]))
        patch.names[inside] = name
        index = np.concatenate([used, len(self.vertices) + np.arange(len(patch.vertices) - len(used))])
        self.vertices = np.concatenate([self.vertices, patch.vertices[len(used) :]])
        self.normals = np.concatenate([self.normals, patch.normals[len(used) :]])
        rest = np.delete(np.arange(len(self.faces)), among)
        self.faces = np.concatenate([self.faces[rest], index[patch.faces]])
        self.names = np.concatenate([self.names[rest], patch.names])

    def _within(self, among: Int[np.ndarray, "n"], value: Float[np.ndarray, "v"]) -> Int[np.ndarray, "m"]:
        """Of some faces those where the linear ``value`` is positive; faces across the edge are cut in three."""
        positive = value[self.faces[among]] > 0
        count = positive.sum(1)
        mixed = (count == 1) | (count == 2)
        cut, lone_in = among[mixed], count[mixed] == 1
        faces = self.faces[cut]
        lone = np.argmax(positive[mixed] == lone_in[:, None], axis=1)
        a, b, c = (faces[np.arange(len(faces)), (lone + i) % 3] for i in range(3))
        p = len(self.vertices) + np.arange(len(faces))
        q = p + len(faces)
        start, end = np.concatenate([a, a]), np.concatenate([b, c])
        w = (value[start] / (value[start] - value[end]))[:, None]
        self.vertices, self.normals = (
            np.concatenate([old, old[start] * (1 - w) + old[end] * w]) for old in (self.vertices, self.normals)
        )
        first = len(self.faces)
        self.faces = np.concatenate([self.faces, np.stack([p, b, c], 1), np.stack([p, c, q], 1)])
        self.faces[cut] = np.stack([a, p, q], 1)
        self.names = np.concatenate([self.names, self.names[cut], self.names[cut]])
        rest = np.flatnonzero(~lone_in)
        return np.concatenate([among[count == 3], cut[lone_in], first + rest, first + len(cut) + rest])

    def parts(self) -> list[Part]:
        """A part for each surface."""
        return [self._part(self.names == name, name) for name in dict.fromkeys(self.names)]

    def lining(self, above_m: float) -> Part:
        """What one sees of the skin from within the cabin."""
        opaque = ~np.isin(self.names, ("glass", "glass_roof")) & (self.vertices[self.faces][..., 2].min(1) > above_m)
        part = self._part(opaque, "lining")
        return replace(
            part, vertices=part.vertices - 0.025 * part.normals, normals=-part.normals, faces=part.faces[:, ::-1]
        )

    def _part(self, chosen: Bool[np.ndarray, "f"], name: str) -> Part:
        used, faces = np.unique(self.faces[chosen], return_inverse=True)
        return Part(self.vertices[used], self.normals[used], faces.reshape(-1, 3), name)


def draw_procedural(rng: np.random.Generator, style: str | None = None) -> Body:
    """A car of a style (default: of any), deformed like the meshes, painted."""
    while True:
        body = _draw_plain(style or str(rng.choice(list(_STYLES), p=_shares())), rng)
        if body is not None:
            break
    shaped = deform(body, Proportions.draw(rng)) if rng.uniform() < 0.8 else body
    return painted(shaped, _PAINTED, rng)


def _draw_plain(style: str, rng: np.random.Generator) -> Body | None:
    """A body without decals; None where the proportions leave no room for a feature."""
    shape = _draw_shape(style, rng)
    try:
        features = draw_features(shape, rng.uniform() < _TWO_DOORS.get(style, 0.0), rng)
    except ValueError:
        return None
    part = body_part(shape)
    skin, bare = _Skin(part), _Skin(part)
    for view, outline, name in features.inlays:
        skin.inlay(view, outline, name)
        if name.startswith("glass"):
            bare.inlay(view, outline, name)
    high = (skin.names == "paint") & (skin.vertices[skin.faces][..., 2].min(1) > shape.belt_height + 0.1)
    skin.names[high] = "paint_top"
    left = [
        *skin.parts(),
        bare.lining(shape.belt_height - 0.4),
        *cabin_parts(shape),
        *outside_parts(shape, features, rng),
        *roof_parts(shape, features, rng),
    ]
    design = int(rng.integers(2**31))
    for x in (shape.front_axle_x, shape.rear_axle_x):
        left += [*wheel_parts(shape, x)[1:], *rim_parts(shape, x, np.random.default_rng(design))]
    mesh = _joined([*left, *(part.mirrored() for part in left)], features.colours)
    keypoints = _keypoints(mesh, features)
    if keypoints is None:
        return None
    return Body(f"procedural_{style}", mesh, keypoints)


def _shares() -> Float[np.ndarray, "s"]:
    shares = np.array([share for share, _ in _STYLES.values()])
    return shares / shares.sum()


def _draw_shape(style: str, rng: np.random.Generator) -> CarShape:
    base = replace(CarShape(), **_STYLES[style][1])
    drawn = {name: getattr(base, name) * rng.uniform(1 - s, 1 + s) for name, s in _SPREAD.items()}
    lift = rng.uniform(-0.03, 0.04)
    heights = {name: getattr(base, name) + lift for name in ("height", "cowl_height", "belt_height", "boot_height")}
    overhangs = drawn["length"] - drawn["wheelbase"]
    drawn["clearance"] = min(drawn["clearance"], drawn["wheel_radius"] - 0.09)
    return replace(base, **drawn, **heights, front_overhang=overhangs * rng.uniform(0.47, 0.53))


def _keypoints(mesh: TexturedMesh, features: Features) -> Float[np.ndarray, "66 3"] | None:
    """The features' vertices cast onto the mesh; None where one misses it."""
    geometry = mesh.geometry()
    points = np.full((len(MIRROR), 3), np.nan)
    for view, seen_from in _CAST_FROM.items():
        index = [i for i, (name, _) in KEYPOINTS.items() if name.startswith(view) and name not in features.absent]
        at = np.array([features.outlines[KEYPOINTS[i][0]][KEYPOINTS[i][1]] for i in index])
        points[index] = cast(geometry, seen_from, at)  # pyright: ignore[reportArgumentType]
        if not np.isfinite(points[index]).all():
            return None
        points[MIRROR[index]] = points[index] * (1, -1, 1)
    if features.two_doors:
        points[_REAR_DOOR] = np.nan
    return points


def _joined(parts: list[Part], colours: dict[str, Float[np.ndarray, "3"]]) -> TexturedMesh:
    names = list(dict.fromkeys(part.material for part in parts))
    offsets = np.cumsum([0, *(len(p.vertices) for p in parts[:-1])])
    count = sum(len(p.vertices) for p in parts)
    return TexturedMesh(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.normals for p in parts]),
        np.zeros((count, 2)),
        np.concatenate([p.faces + o for p, o in zip(parts, offsets, strict=True)]),
        np.concatenate([np.full(len(p.faces), names.index(p.material)) for p in parts]),
        tuple(Surface(name, colours.get(name, np.full(3, 0.2))) for name in names),
    )
