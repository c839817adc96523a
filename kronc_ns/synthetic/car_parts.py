"""Geometry of the procedural car: dimensions, the implicit body, its mesh, wheels and add-on parts.

Axes: x forward, y left, z up, metres, ground at z = 0, car centred in x and y. The body is the zero set of one scalar
field that is even in y, so everything built from it is exactly mirror symmetric.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

STYLES: dict[str, dict[str, float]] = {
    "hatchback": {},
    "saloon": {"length": 4.65, "height": 1.45, "wheelbase": 2.76, "boot_length": 0.52, "rear_screen_run": 0.80,
               "boot_height": 1.05, "bonnet_length": 1.22},
    "suv": {"length": 4.55, "width": 1.88, "height": 1.68, "wheelbase": 2.70, "wheel_radius": 0.37, "belt_height": 1.06,
            "cowl_height": 1.10, "nose_height": 0.90, "boot_height": 1.16, "rear_screen_run": 0.36, "boot_length": 0.07,
            "clearance": 0.23, "windscreen_run": 0.66},
}  # fmt: skip
"""What `CarShape.random` starts from: the fields in which a body style differs from the default hatchback."""


@dataclass(frozen=True)
class CarShape:
    """Dimensions of the car in metres."""

    length: float = 4.40
    """Bumper to bumper."""
    width: float = 1.80
    """Across the doors, without mirrors."""
    height: float = 1.47
    """Ground to the highest point of the roof."""
    wheelbase: float = 2.65
    """Front axle to rear axle."""
    wheel_radius: float = 0.33
    """Ground to wheel centre."""
    front_overhang: float = 0.86
    """Front bumper to front axle."""
    clearance: float = 0.17
    """Ground to the underside of the body."""
    bonnet_length: float = 1.15
    """Front bumper to the foot of the windscreen."""
    nose_height: float = 0.76
    """Front edge of the bonnet."""
    cowl_height: float = 0.99
    """Foot of the windscreen."""
    belt_height: float = 0.95
    """Lower edge of the side windows at the B pillar."""
    windscreen_run: float = 0.74
    """Horizontal length of the windscreen."""
    rear_screen_run: float = 0.46
    """Horizontal length of the rear screen."""
    boot_length: float = 0.10
    """Rear bumper to the foot of the rear screen: short on a hatchback, long on a saloon."""
    boot_height: float = 1.03
    """Foot of the rear screen."""
    tumblehome: float = 0.38
    """Inward lean of the side windows: metres in y per metre of height."""

    @property
    def front_axle_x(self) -> float:
        """x of the front wheel centres."""
        return self.length / 2 - self.front_overhang

    @property
    def rear_axle_x(self) -> float:
        """x of the rear wheel centres."""
        return self.front_axle_x - self.wheelbase

    @property
    def cowl_x(self) -> float:
        """x of the foot of the windscreen at y = 0."""
        return self.length / 2 - self.bonnet_length

    @property
    def windscreen_top_x(self) -> float:
        """x of the upper edge of the windscreen at y = 0."""
        return self.cowl_x - self.windscreen_run

    @property
    def rear_screen_foot_x(self) -> float:
        """x of the foot of the rear screen at y = 0."""
        return self.boot_length - self.length / 2

    @property
    def rear_screen_top_x(self) -> float:
        """x of the upper edge of the rear screen at y = 0."""
        return self.rear_screen_foot_x + self.rear_screen_run

    @property
    def arch_radius(self) -> float:
        """Radius of the wheel arches."""
        return self.wheel_radius + 0.055

    @staticmethod
    def random(rng: np.random.Generator) -> CarShape:
        """A plausible hatchback, saloon or SUV: a body style, each dimension varied by a few per cent."""
        base = CarShape(**STYLES[str(rng.choice(sorted(STYLES)))])
        spread = {"length": 0.03, "width": 0.02, "wheelbase": 0.02, "wheel_radius": 0.03, "clearance": 0.06,
                  "bonnet_length": 0.04, "nose_height": 0.02, "windscreen_run": 0.06, "rear_screen_run": 0.10,
                  "tumblehome": 0.10}  # fmt: skip
        drawn = {name: getattr(base, name) * rng.uniform(1 - s, 1 + s) for name, s in spread.items()}
        lift = rng.uniform(-0.02, 0.03)
        heights = {name: getattr(base, name) + lift for name in ("height", "cowl_height", "belt_height", "boot_height")}
        slack = drawn["length"] - drawn["wheelbase"]
        return CarShape(
            **drawn, **heights, boot_length=base.boot_length, front_overhang=slack * rng.uniform(0.48, 0.51)
        )


@dataclass(frozen=True)
class Part:
    """Triangles of one material, with unit normals at their vertices; metres."""

    vertices: Float[np.ndarray, "v 3"]
    normals: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    material: str

    def mirrored(self) -> Part:
        """The same part on the other side of the car (y -> -y)."""
        flip = np.array([1.0, -1.0, 1.0])
        return Part(self.vertices * flip, self.normals * flip, self.faces[:, ::-1], self.material)


def _smooth_curve(x: Float[np.ndarray, "..."], knots: list[tuple[float, float]], blur: float) -> np.ndarray:
    """Piecewise linear curve through `knots` (x, z), its corners rounded over about `blur` metres."""
    knots = sorted(knots)
    kx, kz = np.array(knots).T
    dense = np.arange(kx[0] - 1, kx[-1] + 1, 0.01)
    ends = (kz[0] + (dense - kx[0]) * (kz[1] - kz[0]) / (kx[1] - kx[0]),
            kz[-1] + (dense - kx[-1]) * (kz[-1] - kz[-2]) / (kx[-1] - kx[-2]))  # fmt: skip
    z = np.where(dense < kx[0], ends[0], np.where(dense > kx[-1], ends[1], np.interp(dense, kx, kz)))
    kernel = np.hanning(int(blur / 0.01) * 2 + 3)
    pad = len(kernel) // 2
    z = np.convolve(np.pad(z, pad, mode="reflect", reflect_type="odd"), kernel / kernel.sum(), mode="valid")
    return np.interp(x, dense, z)


def deck_height(s: CarShape, x: Float[np.ndarray, "..."]) -> np.ndarray:
    """z of the top of the lower body along y = 0: bonnet, belt line, boot lid."""
    half = s.length / 2
    knots = [(half, s.nose_height - 0.06), (half - 0.16, s.nose_height), (s.cowl_x, s.cowl_height),
             (s.windscreen_top_x - 0.2, s.belt_height), (s.rear_screen_foot_x, s.boot_height),
             (-half, s.boot_height - 0.2 * s.boot_length)]  # fmt: skip
    return _smooth_curve(x, knots, 0.12)


def tail_height(s: CarShape) -> float:
    """Upper edge of the tail lamps, below the rear edge of the deck."""
    return float(deck_height(s, np.array([-s.length / 2]))[0]) - 0.07


def roof_height(s: CarShape, x: Float[np.ndarray, "..."]) -> np.ndarray:
    """z of windscreen, roof and rear screen along y = 0."""
    peak = 0.55 * s.windscreen_top_x + 0.45 * s.rear_screen_top_x
    knots = [(s.cowl_x, s.cowl_height), (s.windscreen_top_x, s.height - 0.06), (peak, s.height + 0.004),
             (s.rear_screen_top_x, s.height - 0.07), (s.rear_screen_foot_x, s.boot_height)]  # fmt: skip
    return _smooth_curve(x, knots, 0.28) + s.height - _smooth_curve(np.array([peak]), knots, 0.28)


def _crowned_roof(s: CarShape, x: Float[np.ndarray, "..."], yn: Float[np.ndarray, "..."]) -> np.ndarray:
    """z of windscreen, roof and rear screen at x and at `yn` half widths from the middle: bowed in plan, crowned."""
    bow = 0.15 * np.tanh((x - 0.5 * (s.windscreen_top_x + s.rear_screen_top_x)) / 0.5)
    return roof_height(s, x + bow * yn**2) - 0.07 * yn**2


def side_rail_height(s: CarShape, x: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """z of the edge between side windows and roof."""
    return _crowned_roof(s, x, np.full_like(x, 0.72))


def cabin_half_width(s: CarShape, x: Float[np.ndarray, "..."], z: Float[np.ndarray, "..."]) -> np.ndarray:
    """Half width of the glasshouse at (x, z)."""
    taper = 0.09 * np.clip((-0.5 - x) / 1.7, 0, None) ** 2 + 0.05 * np.clip((x - 0.2) / 0.8, 0, None) ** 2
    return s.width / 2 - 0.035 - s.tumblehome * np.abs(z - s.belt_height) - taper


def _smooth_max(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    """max(a, b) with the corner rounded where the two differ by less than k."""
    return np.maximum(a, b) + np.clip(k - np.abs(a - b), 0, None) ** 2 / (4 * k)


def body_field(s: CarShape, p: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n"]:
    """Signed field of the body without wheels: negative inside, zero on the skin, roughly metric near it."""
    x, y, z = p[..., 0], np.abs(p[..., 1]), p[..., 2]
    half, half_w = s.length / 2, s.width / 2
    yn, zn = y / half_w, z / s.belt_height
    bumper = 0.5 * (1 + np.tanh((0.60 - zn) / 0.03))
    front = half - 0.26 * yn**2.4 - 0.34 * np.clip(zn - 0.58, 0, None) - 0.30 * np.clip(0.36 - zn, 0, None)
    rear = half - 0.16 * yn**2.6 - 0.16 * np.clip(zn - 0.58, 0, None) - 0.25 * np.clip(0.42 - zn, 0, None)
    ends = np.maximum(x - front + 0.025 * (1 - bumper), -x - rear + 0.03 * (1 - bumper))
    taper = 0.07 * (np.clip(np.abs(x) - 0.8, 0, None) / (half - 0.8)) ** 2
    crease = 0.012 * (1 + np.tanh((zn - 0.80) / 0.02)) / 2 + 0.010 * np.exp(-(((zn - 0.42) / 0.07) ** 2))
    section = 0.05 * np.clip((0.58 - zn) / 0.4, 0, None) ** 2 + 0.06 * np.clip((zn - 0.58) / 0.4, 0, None) ** 2
    side = y - (half_w - taper - section - crease)
    floor = s.clearance + 0.10 * np.clip(np.abs(x) - half + 0.45, 0, None) - z
    crown = 0.05 * yn**2 + 0.02 * yn**8 - 0.014 * np.exp(-(((yn - 0.55) / 0.05) ** 2)) * (x > s.cowl_x - 0.3)
    deck = (z - deck_height(s, x) + crown) * 0.97
    tub = _smooth_max(_smooth_max(_smooth_max(side, ends, 0.20), deck, 0.09), floor, 0.06)
    roof = (z - _crowned_roof(s, x, yn)) * 0.85
    cabin = np.maximum(_smooth_max(_smooth_max(y - cabin_half_width(s, x, z), roof, 0.10), ends + 0.12, 0.08), 0.5 - z)
    return -_smooth_max(-tub, -cabin, 0.09)


def surface_point(s: CarShape, view: Literal["side", "front", "rear"], u: float, z: float) -> Float[np.ndarray, "3"]:
    """Point of the body skin at (x, z) on the left side, or at (y, z) seen from the front or rear."""
    start = np.array([u, 0.0, z]) if view == "side" else np.array([0.0, u, z])
    step = np.array({"side": [0, 1.2, 0], "front": [4.0, 0, 0], "rear": [-4.0, 0, 0]}[view], dtype=float)
    return start + _first_outside(s, start[None], step[None])[0] * step


def _first_outside(s: CarShape, start: Float[np.ndarray, "n 3"], step: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """Fraction [n, 1] of `step` at which rays from inside cross the skin, by bisection."""
    low, high = np.zeros((len(start), 1)), np.ones((len(start), 1))
    for _ in range(18):
        middle = (low + high) / 2
        inside = body_field(s, start + middle * step)[:, None] < 0
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return (low + high) / 2


def _grid_faces(rows: int, cols: int) -> Int[np.ndarray, "f 3"]:
    """Two triangles for each cell of a rows x cols vertex grid."""
    a = (np.arange(rows - 1)[:, None] * cols + np.arange(cols - 1)).ravel()
    return np.concatenate([np.stack([a, a + cols, a + 1], 1), np.stack([a + 1, a + cols, a + cols + 1], 1)])


def body_part(s: CarShape) -> Part:
    """Left half (y >= 0) of the body skin with open wheel arches.

    Rays run from a core segment inside the body to a grid on its bounding box; the skin is where they leave the field.
    """
    half, box_w, low = s.length / 2 + 0.02, s.width / 2 + 0.02, s.clearance - 0.05
    n_y, n_z, n_x = 30, 64, 170
    ramp_y, ramp_z = np.linspace(0, box_w, n_y), np.linspace(0, 1, n_z)
    x = half * np.sin(np.linspace(-1.2, 1.2, n_x)) / np.sin(1.2)
    top = np.maximum(deck_height(s, x), roof_height(s, x)) + 0.02
    one = np.ones((n_x, 1))
    wall_z = low + ramp_z * (top[:, None] - low)
    shell_y = np.hstack([one * ramp_y, one * np.full(n_z - 2, box_w), one * ramp_y[::-1]])
    shell_z = np.hstack([one * np.full(n_y, low), wall_z[:, 1:-1], top[:, None] * np.ones(n_y)])
    shell = np.stack([np.broadcast_to(x[:, None], shell_y.shape), shell_y, shell_z], -1)
    targets, faces, count = [shell.reshape(-1, 3)], [_grid_faces(*shell.shape[:2])], shell_y.size
    for i, order in ((0, 1), (-1, -1)):
        cap = np.stack(np.broadcast_arrays(x[i], ramp_y[:, None], wall_z[i][None]), -1)
        targets.append(cap.reshape(-1, 3))
        faces.append(_grid_faces(n_y, n_z)[:, ::order] + count)
        count += n_y * n_z
    target = np.concatenate(targets)
    core = np.stack([np.clip(target[:, 0], 0.6 - half, half - 0.6), 0 * target[:, 0], 0 * target[:, 0] + 0.6], 1)
    vertices = core + _first_outside(s, core, target - core) * (target - core)
    normals = _field_normals(s, vertices)
    face = np.concatenate(faces)
    tri = vertices[face]
    outward = np.einsum("fi,fi->f", np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0]), normals[face].sum(1))
    face[outward < 0] = face[outward < 0][:, ::-1]
    return _cut(Part(vertices, normals, face, "body"), _outside_arches(s, vertices))


def _field_normals(s: CarShape, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Unit outward normals of the skin from central differences of the field."""
    offsets = 2e-3 * np.eye(3)
    gradient = np.stack([body_field(s, p + d) - body_field(s, p - d) for d in offsets], 1)
    return gradient / np.linalg.norm(gradient, axis=1, keepdims=True)


def _outside_arches(s: CarShape, p: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    """Positive where the skin stays, negative inside a wheel arch of the left side."""
    keep = np.full(len(p), np.inf)
    for x in (s.front_axle_x, s.rear_axle_x):
        radius = np.hypot(p[:, 0] - x, p[:, 2] - s.wheel_radius)
        keep = np.minimum(keep, np.maximum(radius - s.arch_radius, _well_inner_y(s) - p[:, 1]))
    return keep


def _well_inner_y(s: CarShape) -> float:
    """y of the inner wall of a wheel well."""
    return s.width / 2 - 0.36


def _cut(part: Part, value: Float[np.ndarray, "v"]) -> Part:
    """The piece of a mesh where the linearly interpolated `value` is positive; cut triangles are retriangulated."""
    inside = value[part.faces] > 0
    count = inside.sum(1)
    mixed = (count == 1) | (count == 2)
    faces, lone_in = part.faces[mixed], count[mixed] == 1
    lone = np.argmax(inside[mixed] == lone_in[:, None], axis=1)
    a, b, c = (faces[np.arange(len(faces)), (lone + i) % 3] for i in range(3))
    vertices, normals = part.vertices, part.normals
    new_v, new_n = [vertices], [normals]
    for other in (b, c):
        w = (value[a] / (value[a] - value[other]))[:, None]
        new_v.append(vertices[a] * (1 - w) + vertices[other] * w)
        new_n.append(normals[a] * (1 - w) + normals[other] * w)
    p = len(vertices) + np.arange(len(faces))
    q = p + len(faces)
    kept = [part.faces[count == 3], np.stack([a, p, q], 1)[lone_in],
            np.stack([p, b, c], 1)[~lone_in], np.stack([p, c, q], 1)[~lone_in]]  # fmt: skip
    normals = np.concatenate(new_n)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Part(np.concatenate(new_v), normals, np.concatenate(kept), part.material)


def flat_part(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], material: str) -> Part:
    """A part shaded face by face."""
    tri = vertices[faces]
    normal = np.cross(tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0])
    solid = np.linalg.norm(normal, axis=1) > 1e-12
    tri, normal = tri[solid], normal[solid]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Part(tri.reshape(-1, 3), np.repeat(normal, 3, axis=0), np.arange(3 * len(tri)).reshape(-1, 3), material)


def _revolved(profile: list[tuple[float, float]], x: float, z: float, material: str) -> Part:
    """Surface of revolution about the line through (x, z) along y; `profile` lists (radius, y) from the hub out."""
    r, y = np.array(profile).T
    angle = np.linspace(0, 2 * np.pi, 65)
    grid = np.stack(np.broadcast_arrays(x + r * np.cos(angle)[:, None], y, z + r * np.sin(angle)[:, None]), -1)
    return flat_part(grid.reshape(-1, 3), _grid_faces(len(angle), len(r)), material)


def wheel_parts(s: CarShape, x: float) -> list[Part]:
    """Left wheel on the axle at x, and the dark well around it."""
    r, rim, y = s.wheel_radius, s.wheel_radius * 0.70, s.width / 2 - 0.035
    face = [(0.0, y - 0.020), (0.06, y - 0.020), (0.075, y - 0.035), (rim - 0.03, y - 0.022), (rim, y - 0.010)]
    tyre = [(rim, y - 0.010), (rim + 0.02, y), (r - 0.03, y - 0.002), (r - 0.008, y - 0.02), (r, y - 0.05),
            (r, y - 0.16), (r - 0.03, y - 0.20), (0.0, y - 0.20)]  # fmt: skip
    lowest = np.arcsin((s.clearance + 0.005 - r) / s.arch_radius)
    angle = np.linspace(lowest, np.pi - lowest, 60)
    edge = np.stack([x + s.arch_radius * np.cos(angle), 0 * angle, r + s.arch_radius * np.sin(angle)], 1)
    side = np.array([0, 1.2, 0])
    outer = edge + _first_outside(s, edge, np.tile(side, (len(edge), 1))) * side
    inner = edge + np.array([0, _well_inner_y(s), 0])
    hub = np.broadcast_to([x, _well_inner_y(s), r], edge.shape)
    well = np.stack([outer, inner, hub], 1)
    return [_revolved(face, x, r, "wheel"), _revolved(tyre, x, r, "tyre"),
            flat_part(well.reshape(-1, 3), _grid_faces(len(angle), 3), "dark")]  # fmt: skip


def blob_part(centre: np.ndarray, radii: tuple[float, float, float], squareness: float, material: str) -> Part:
    """Superellipsoid: an ellipsoid at squareness 0, close to a box near 1."""
    v, u = np.meshgrid(np.linspace(-np.pi / 2, np.pi / 2, 17), np.linspace(-np.pi, np.pi, 33), indexing="ij")
    unit = np.stack([np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)], -1).reshape(-1, 3)
    power = 2 / (1 - 0.9 * squareness)
    local = unit / (np.abs(unit) ** power).sum(1, keepdims=True) ** (1 / power)
    normal = np.sign(local) * np.abs(local) ** (power - 1) / np.array(radii)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return Part(centre + local * np.array(radii), normal, _grid_faces(17, 33)[:, ::-1], material)


def plate_part(centre: np.ndarray, half_width: float, half_height: float) -> Part:
    """Number plate: a thin upright box whose faces look along x, centred on `centre` and mirror symmetric."""
    corner = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), -1).reshape(-1, 3)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return flat_part(centre + corner * np.array([0.02, half_width, half_height]), faces, "plate")
