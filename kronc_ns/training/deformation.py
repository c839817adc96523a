"""A family of cars from one: smooth changes of proportion that move surface and keypoints together."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.training.body import Body
from kronc_ns.training.meshes import TexturedMesh

_FRONT_WHEEL, _REAR_WHEEL = 7, 20  # keypoints of the left side
_BELT = (9, 12)  # keypoints on the belt line
_STEP = 1e-3  # m, for derivatives


@dataclass(frozen=True)
class Proportions:
    """Factors of lengths (1: as it is) and shifts in metres (0: as it is)."""

    front_overhang: float = 1.0
    wheelbase: float = 1.0
    rear_overhang: float = 1.0
    body_height: float = 1.0
    """Between the wheels' tops and the belt line."""
    cabin_height: float = 1.0
    """Above the belt line."""
    width: float = 1.0
    wheels: float = 1.0
    """Diameter."""
    ride_m: float = 0.0
    """Body above the wheels."""
    nose_m: float = 0.0
    """Height of the front end above the bumper."""
    tail_m: float = 0.0
    """The same of the rear end."""
    cabin_m: float = 0.0
    """Shift of the cabin and the doors forwards, the wheels staying."""
    rake: float = 0.0
    """Shift of the cabin backwards per height above the belt."""
    lean: float = 0.0
    """Narrowing of the cabin per metre of height above the belt."""

    @staticmethod
    def draw(rng: np.random.Generator) -> "Proportions":
        """Plausible ones; mostly mild."""
        size = rng.normal(0, 0.05)  # long cars are long everywhere

        def factor(spread: float) -> float:
            return float(np.clip(np.exp(size * spread / 0.08 + rng.normal(0, spread)), 0.75, 1.33))

        return Proportions(
            factor(0.09),
            factor(0.05),
            factor(0.10),
            float(np.exp(rng.normal(0, 0.08))),
            float(np.exp(rng.normal(0, 0.09))),
            float(np.exp(0.4 * size + rng.normal(0, 0.025))),
            float(np.exp(rng.normal(0, 0.04))),
            float(np.clip(rng.normal(0.01, 0.03), -0.05, 0.1)),
            float(rng.normal(0, 0.035)),
            float(rng.normal(0, 0.045)),
            float(np.clip(rng.normal(0, 0.05), -0.1, 0.1)),
            float(rng.normal(0, 0.10)),
            float(rng.normal(0, 0.05)),
        )


def deform(body: Body, to: Proportions) -> Body:
    """The body with other proportions; wheels stay round and on the ground."""
    mesh = body.mesh
    front, rear = body.keypoints[_FRONT_WHEEL], body.keypoints[_REAR_WHEEL]
    names = np.array([s.name.lower() for s in mesh.surfaces])
    is_wheel = np.array([name.startswith(("tyre", "tire", "rim", "wheel")) for name in names])  # not "trim", "primary"
    of_wheel = np.zeros(len(mesh.vertices), dtype=bool)
    of_wheel[mesh.faces[is_wheel[mesh.surface]].ravel()] = True
    of_wheel &= _within_wheels(mesh.vertices, front, rear, 1.15)  # a spare wheel belongs to the body
    # where no name tells, everything as far out as the tread is taken to be wheel
    of_wheel |= _within_wheels(mesh.vertices, front, rear, 0.93 if is_wheel.any() else 1.005)
    move = _body_map(body, to)
    wheel_map = _wheel_map(front, rear, to, move)

    vertices = np.where(of_wheel[:, None], wheel_map(mesh.vertices), move(mesh.vertices))
    normals = _carried(mesh.vertices, mesh.normals, move)
    normals = np.where(of_wheel[:, None], mesh.normals, normals)
    hubs = np.zeros(len(body.keypoints), dtype=bool)
    hubs[list(APOLLOCAR3D_66.wheels)] = True
    keypoints = np.where(hubs[:, None], wheel_map(body.keypoints), move(body.keypoints))
    low, high = vertices.min(0), vertices.max(0)
    shift = np.array([-(low[0] + high[0]) / 2, 0.0, -low[2]])
    moved = replace(mesh, vertices=vertices + shift, normals=normals)
    return replace(body, mesh=moved, keypoints=keypoints + shift)


def refined(mesh: TexturedMesh, longest_m: float = 0.12) -> TexturedMesh:
    """The same surface without long edges: bent, large triangles would let what lies behind them through."""
    vertices, normals, uv = mesh.vertices, mesh.normals, mesh.uv
    faces, surface = mesh.faces.copy(), mesh.surface
    check = np.arange(len(faces))
    while len(check):
        corners = vertices[faces[check]]
        length = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        long = length.max(1) > longest_m
        check, edge = check[long], length.argmax(1)[long]
        a, b, c = (faces[check, (edge + k) % 3] for k in range(3))
        middle = len(vertices) + np.arange(len(check))
        vertices, normals, uv = (np.concatenate([v, (v[a] + v[b]) / 2]) for v in (vertices, normals, uv))
        new = len(faces) + np.arange(len(check))
        faces[check] = np.stack([a, middle, c], 1)
        faces = np.concatenate([faces, np.stack([middle, b, c], 1)])
        surface = np.concatenate([surface, surface[check]])
        check = np.concatenate([check, new])
    return replace(mesh, vertices=vertices, normals=normals, uv=uv, faces=faces, surface=surface)


def _within_wheels(
    p: Float[np.ndarray, "v 3"], front: Float[np.ndarray, "3"], rear: Float[np.ndarray, "3"], radius: float
) -> Bool[np.ndarray, "v"]:
    """Vertices inside cylinders of so many wheel radii: brakes and hubs that carry other names."""
    inside = np.zeros(len(p), dtype=bool)
    for hub in (front, rear):
        near = np.hypot(p[:, 0] - hub[0], p[:, 2] - hub[2]) < radius * hub[2]
        inside |= near & (np.abs(p[:, 1]) > abs(hub[1]) - 0.28)
    return inside


def _body_map(body: Body, to: Proportions) -> Callable[[np.ndarray], np.ndarray]:
    """Where each point of the body goes; the arches keep their shape."""
    points = body.keypoints
    front, rear = points[_FRONT_WHEEL], points[_REAR_WHEEL]
    low, high = body.mesh.vertices.min(0), body.mesh.vertices.max(0)
    belt = float(np.nanmean(points[list(_BELT), 2]))
    arch_f, arch_r = 1.25 * front[2] * to.wheels, 1.25 * rear[2] * to.wheels
    x = np.array([low[0], rear[0] - arch_r, rear[0] + arch_r, front[0] - arch_f, front[0] + arch_f, high[0]])
    between = x[3] - x[2]
    # all of the wheelbase's change has to come from between the arches
    middle = max(0.6, ((front[0] - rear[0]) * to.wheelbase - (arch_f + arch_r)) / between)
    slopes = np.array([to.rear_overhang, 1.0, middle, 1.0, to.front_overhang])
    new_x = np.concatenate([[0.0], np.cumsum(slopes * np.diff(np.maximum.accumulate(x)))])
    new_x += x[2] - new_x[2]
    along_x = _smooth_map(x, new_x)
    z = np.array([0.0, 2.3 * max(front[2], rear[2]), belt, high[2]])
    z[1] = min(z[1], belt - 0.05)
    new_z = np.concatenate([[0.0], np.cumsum(np.array([1.0, to.body_height, to.cabin_height]) * np.diff(z))])
    along_z = _smooth_map(z, new_z)
    new_belt = float(along_z(np.array([belt]))[0])

    def move(p: np.ndarray) -> np.ndarray:
        out = np.empty_like(p)
        up = along_z(p[:, 2])
        above = np.maximum(up - new_belt, 0.0)
        out[:, 0] = along_x(p[:, 0]) - to.rake * above
        out[:, 1] = p[:, 1] * to.width * (1 - to.lean * above)
        raised = _step(p[:, 2], 0.45, 0.9)
        # low down only what lies between the arches may move
        between = _step(p[:, 0], x[2], x[2] + 0.5) * _step(-p[:, 0], -x[3], 0.5 - x[3])
        whole = _step(p[:, 0], x[0], x[0] + 1.1) * _step(-p[:, 0], -x[5], 1.1 - x[5])
        out[:, 0] += to.cabin_m * (between + _step(p[:, 2], 2.2 * front[2], belt + 0.05) * (whole - between))
        nose = to.nose_m * raised * _step(p[:, 0], front[0] - 0.6, front[0] + 0.3)
        tail = to.tail_m * raised * _step(-p[:, 0], -rear[0] - 0.4, -rear[0] + 0.5)
        out[:, 2] = up + to.ride_m * _step(p[:, 2], 0.02, 0.25) + nose + tail
        return out

    return move


def _wheel_map(
    front: Float[np.ndarray, "3"],
    rear: Float[np.ndarray, "3"],
    to: Proportions,
    move: Callable[[np.ndarray], np.ndarray],
) -> Callable[[np.ndarray], np.ndarray]:
    """Wheels move as they are and grow about their hubs."""
    hubs = np.stack([front, rear])
    moved = move(hubs)

    def wheels(p: np.ndarray) -> np.ndarray:
        which = (np.abs(p[:, 0] - rear[0]) < np.abs(p[:, 0] - front[0])).astype(int)
        hub, new = hubs[which], moved[which]
        side = np.sign(p[:, 1])
        out = np.empty_like(p)
        out[:, 0] = new[:, 0] + to.wheels * (p[:, 0] - hub[:, 0])
        out[:, 1] = p[:, 1] + side * (new[:, 1] - hub[:, 1])
        out[:, 2] = hub[:, 2] + to.wheels * (p[:, 2] - hub[:, 2])
        return out

    return wheels


def _smooth_map(knots: Float[np.ndarray, "k"], values: Float[np.ndarray, "k"]) -> Callable[[np.ndarray], np.ndarray]:
    """Piecewise linear through knots, its corners rounded over some 15 cm, going on in straight lines."""
    dense = np.arange(knots[0] - 0.5, knots[-1] + 0.5, 0.01)
    inner = np.interp(dense, knots, values)
    first, last = ((values[i] - values[j]) / (knots[i] - knots[j]) for i, j in ((1, 0), (-1, -2)))
    inner = np.where(dense < knots[0], values[0] + first * (dense - knots[0]), inner)
    inner = np.where(dense > knots[-1], values[-1] + last * (dense - knots[-1]), inner)
    kernel = np.hanning(17)
    padded = np.pad(inner, 8, mode="reflect", reflect_type="odd")
    smooth = np.convolve(padded, kernel / kernel.sum(), mode="valid")
    return lambda at: np.interp(at, dense, smooth)


def _step(value: np.ndarray, low: float, high: float) -> np.ndarray:
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def _carried(
    p: Float[np.ndarray, "v 3"], normals: Float[np.ndarray, "v 3"], move: Callable[[np.ndarray], np.ndarray]
) -> Float[np.ndarray, "v 3"]:
    """Normals of the moved surface: the cofactors of the map's derivative times the old ones."""
    a, b, c = ((move(p + _STEP * axis) - move(p - _STEP * axis)) / (2 * _STEP) for axis in np.eye(3))
    turned = normals[:, :1] * np.cross(b, c) + normals[:, 1:2] * np.cross(c, a) + normals[:, 2:] * np.cross(a, b)
    return turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-12)
