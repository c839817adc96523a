"""Sub-pixel places of features: the pixels around them are laid over each other from view to view.

Least-squares matching (Gruen, 1985; Lucas and Kanade, IJCAI 1981): of every track the patch of one view is the
template; in each other view an affine warp, brightness and contrast are found under which that view shows the same.
SIFT finds a blob's middle, which moves when the blob is seen askew; the patch does not care.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8, UInt16

from kronc_ns.geometry.poses import unit
from kronc_ns.refine.gathering import Gathered
from kronc_ns.refine.rig import Rig
from kronc_ns.refine.tracks import Tracks, angles_off_middle_deg, rays, rows_of
from kronc_ns.solve.compiled import compiled
from kronc_ns.solve.linear import solve
from kronc_ns.solve.threads import side_by_side

_RADIUS = 7  # samples on each side of the middle
_STEP = 0.5  # between samples, of the feature's size, but at least a pixel
_LEVELS = 4
_STEPS, _REST_PX = 12, 0.005
_ALIKE = 0.85  # least correlation of two patches
_FARTHEST = 1.5  # steps that a feature may be moved by
_WIDEST_DEG = 60.0  # from the mean direction of those that see a point, within which it may look alike
_WIDEST_LEVEL_DEG, _LEVEL_M = 90.0, 0.1  # on the ground, whose plane is known, from all around
_MOST_NEW = 10  # views that a track is looked for in: those that see its point most as the others do
_EDGE_PX = 4.0
_AT_ONCE = 50  # groups that a thread does before it hands over
_LEAST_ALIKE = 0.3  # to begin with
_BLUR_PX = 0.7
_FINE = 128  # parts of a grey level: faint features are one or two levels deep


def align(tracks: Tracks, gathered: Gathered, rig: Rig) -> Gathered:
    """Move the tracks' features to where their patches fit; those that fit nowhere stay."""
    template = templates(tracks, gathered, rig)
    other = np.flatnonzero(tracks.feature != template[tracks.of_track])
    track, there = tracks.of_track[other], tracks.feature[other]
    pixel = gathered.pixel.copy()
    pixel[there], _ = _laid_over(
        template[track], gathered.view[there], pixel[there], tracks.points[track], gathered, rig
    )
    return replace(gathered, pixel=pixel)


def grow(tracks: Tracks, gathered: Gathered, rig: Rig) -> tuple[Tracks, Gathered]:
    """Look for each track's patch where its point should be seen in other views, which found no feature there."""
    template = templates(tracks, gathered, rig)
    track, view, pixel = _expected(tracks, gathered, rig)
    pixel, fits = _laid_over(template[track], view, pixel, tracks.points[track], gathered, rig)
    track, view, pixel = track[fits], view[fits], pixel[fits]
    new = len(gathered.view) + np.arange(len(track))
    origin = template[track]
    vehicle = gathered.on_vehicle
    gathered = replace(
        gathered,
        view=np.concatenate([gathered.view, view]),
        pixel=np.concatenate([gathered.pixel, pixel]),
        on_vehicle=None if vehicle is None else np.concatenate([vehicle, vehicle[origin]]),
        colour=np.concatenate([gathered.colour, gathered.colour[origin]]),
    )
    feature, of_track = np.concatenate([tracks.feature, new]), np.concatenate([tracks.of_track, track])
    order = np.lexsort((gathered.view[feature], of_track))
    return rows_of(feature[order], of_track[order], tracks.points), gathered


def _expected(
    tracks: Tracks, gathered: Gathered, rig: Rig
) -> tuple[Int[np.ndarray, "k"], Int[np.ndarray, "k"], Float[np.ndarray, "k 2"]]:
    """Track, view and photographed pixel of sightings that are missing: of points that face a view as they face those
    that see them."""
    centre = rig.cameras.centre
    _, mean = rays(tracks, gathered.view, rig.cameras)
    level = np.abs(tracks.points[:, 2]) < _LEVEL_M
    widest = np.cos(np.radians(np.where(level, _WIDEST_LEVEL_DEG, _WIDEST_DEG)))
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []
    seen = np.zeros((len(tracks), len(centre)), bool)
    seen[tracks.of_track, gathered.view[tracks.feature]] = True
    for view, camera in enumerate(rig.lenses[lens] for lens in rig.lens):
        turned = (unit(tracks.points - centre[view]) * mean).sum(1)
        uv = tracks.points @ rig.rotation[view].T + rig.translation[view]
        near = np.flatnonzero(~seen[:, view] & (turned > widest) & (uv[:, 2] > 0.1))
        plane = uv[near, :2] / uv[near, 2:]
        pixel = camera.distort(plane * (camera.fx, camera.fy) + (camera.cx, camera.cy))
        inside = ((pixel > _EDGE_PX) & (pixel < np.array([camera.width, camera.height]) - _EDGE_PX)).all(1)
        found.append((near[inside], np.full(int(inside.sum()), view), pixel[inside], turned[near[inside]]))
    track, view, pixel, turned = (np.concatenate(column) for column in zip(*found, strict=True))
    order = np.lexsort((-turned, track))
    begin = np.searchsorted(track[order], track[order])  # of each track's rows
    kept = np.sort(order[np.arange(len(order)) - begin < _MOST_NEW])
    return track[kept], view[kept], pixel[kept]


def _laid_over(
    here: Int[np.ndarray, "k"],
    view: Int[np.ndarray, "k"],
    pixel: Float[np.ndarray, "k 2"],
    world: Float[np.ndarray, "k 3"],
    gathered: Gathered,
    rig: Rig,
) -> tuple[Float[np.ndarray, "k 2"], Bool[np.ndarray, "k"]]:
    """Where in other views the features ``here`` of points ``world`` are seen, near ``pixel``; and where that fits."""
    shrink = np.array(
        [grey.shape[1] / rig.lenses[lens].width for grey, lens in zip(gathered.grey, rig.lens, strict=True)]
    )  # from photographed pixels to those of the grey pictures
    of_here = gathered.view[here]
    enlarged = rig.enlargement * shrink
    warps = _warps(rig, world, of_here, view) * (enlarged[view] / enlarged[of_here])[:, None, None, None]
    step = np.maximum(1.0, _STEP * _size(gathered)[here] * shrink[of_here])
    level = np.minimum(np.floor(np.log2(step)).astype(int), _LEVELS - 1)
    groups = _groups(level, of_here, view)
    pyramids = list(side_by_side(_pyramid, gathered.grey))

    def overlay(rows: Int[np.ndarray, "g"]) -> tuple[Float[np.ndarray, "g 2"], Float[np.ndarray, "g"]]:
        at, i, j = level[rows[0]], of_here[rows[0]], view[rows[0]]
        scale = 2.0**at
        shift, alike = np.zeros((len(rows), 2)), np.zeros(len(rows))
        _align(
            pyramids[i][at],
            pyramids[j][at],
            (gathered.pixel[here[rows]] * shrink[i] - 0.5) / scale,
            (pixel[rows] * shrink[j] - 0.5) / scale,
            np.ascontiguousarray(warps[rows]),
            step[rows] / scale,
            shift,
            alike,
        )
        return shift * scale, alike

    found, fits = pixel.copy(), np.zeros(len(here), bool)
    parts = [groups[i : i + _AT_ONCE] for i in range(0, len(groups), _AT_ONCE)]
    for some, overlaid in zip(parts, side_by_side(lambda part: [overlay(rows) for rows in part], parts), strict=True):
        for rows, (shift, alike) in zip(some, overlaid, strict=True):
            fits[rows] = (alike >= _ALIKE) & (np.linalg.norm(shift, axis=1) <= _FARTHEST * step[rows])
            good = rows[fits[rows]]
            found[good] += shift[fits[rows]] / shrink[view[good]][:, None]
    return found, fits


def _size(gathered: Gathered) -> Float[np.ndarray, "f"]:
    """Of all features; corners are as small as can be."""
    return np.pad(gathered.size, (0, len(gathered.view) - gathered.sift), constant_values=1.0)


def templates(tracks: Tracks, gathered: Gathered, rig: Rig) -> Int[np.ndarray, "p"]:
    """The feature of each track that the others are aligned to: seen from the middle of all directions."""
    order = np.lexsort((angles_off_middle_deg(tracks, gathered.view, rig.cameras), tracks.of_track))
    return tracks.feature[order[tracks.first[:-1]]]


def _warps(
    rig: Rig, world: Float[np.ndarray, "k 3"], here: Int[np.ndarray, "k"], there: Int[np.ndarray, "k"]
) -> Float[np.ndarray, "k 2 2 2"]:
    """What a plane through each point does to its surroundings from one view to the other; for two planes: one that
    faces both views, and a level one."""
    centre = rig.cameras.centre
    facing = unit(unit(centre[here] - world) + unit(centre[there] - world))
    level = np.broadcast_to(np.array([0.0, 0.0, 1.0]), facing.shape)
    by_here, by_there = _by_point(rig, world, here), _by_point(rig, world, there)
    warps = np.empty((len(world), 2, 2, 2))
    for which, normal in enumerate((facing, level)):
        side = unit(np.cross(normal, np.where(np.abs(normal[:, :1]) < 0.9, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])))
        tangent = np.stack([side, np.cross(normal, side)], axis=2)
        ours, theirs = (np.einsum("kij,kjl->kil", of, tangent) for of in (by_here, by_there))
        (a, b), (c, d) = ours.transpose(1, 2, 0)
        determinant = a * d - b * c
        flat = np.abs(determinant) < 1e-6 * np.square(ours).sum((1, 2))  # seen along the plane
        back = np.stack([d, -b, -c, a], axis=1).reshape(-1, 2, 2) / np.where(flat, 1.0, determinant)[:, None, None]
        warps[:, which] = np.where(flat[:, None, None], np.eye(2), np.einsum("kij,kjl->kil", theirs, back))
    return warps


def _by_point(rig: Rig, world: Float[np.ndarray, "k 3"], view: Int[np.ndarray, "k"]) -> Float[np.ndarray, "k 2 3"]:
    """Derivative of each point's pixel by the point."""
    r = rig.rotation[view]
    seen = np.einsum("kij,kj->ki", r, world) + rig.translation[view]
    z = np.maximum(seen[:, 2], 1e-3)
    return rig.focal / z[:, None, None] * (r[:, :2] - (seen[:, :2] / z[:, None])[..., None] * r[:, 2:])


def _groups(*keys: Int[np.ndarray, "k"]) -> list[Int[np.ndarray, "g"]]:
    """Rows of equal keys."""
    if not len(keys[0]):
        return []
    order = np.lexsort(keys[::-1])
    table = np.stack(keys, axis=1)[order]
    return np.split(order, np.flatnonzero((table[1:] != table[:-1]).any(1)) + 1)


def _pyramid(grey: UInt8[np.ndarray, "_ _"]) -> Sequence[UInt16[np.ndarray, "_ _"]]:
    """The smoothed picture at 1, 1/2, 1/4, ...; pixel i of a level lies at pixel 2 i of the one below."""
    levels = [cv2.GaussianBlur(grey.astype(np.uint16) * _FINE, (0, 0), _BLUR_PX)]
    while len(levels) < _LEVELS:
        levels.append(cv2.pyrDown(levels[-1]))
    return levels


@compiled
def _value(image: Any, x: float, y: float) -> Any:
    """The picture at a place; negative outside."""
    i, j = int(np.floor(x)), int(np.floor(y))
    if i < 0 or j < 0 or i + 1 >= image.shape[1] or j + 1 >= image.shape[0]:
        return -1.0
    p, q = x - i, y - j
    above = (1.0 - p) * image[j, i] + p * image[j, i + 1]
    below = (1.0 - p) * image[j + 1, i] + p * image[j + 1, i + 1]
    return (1.0 - q) * above + q * below


@compiled
def _patch(image: Any, at: Any, a: Any, dx: float, dy: float, x: Any, y: Any, out: Any) -> Any:
    """Values at the warped places; False where some lie outside."""
    for k in range(len(x)):
        out[k] = _value(
            image, at[0] + dx + a[0, 0] * x[k] + a[0, 1] * y[k], at[1] + dy + a[1, 0] * x[k] + a[1, 1] * y[k]
        )
        if out[k] < 0.0:
            return False
    return True


@compiled
def _correlation(template: Any, patch: Any, weight: Any) -> Any:
    """Of two patches, -1 to 1."""
    total = a = b = 0.0
    for k in range(len(template)):
        total += weight[k]
        a += weight[k] * template[k]
        b += weight[k] * patch[k]
    a, b = a / total, b / total
    aa = bb = ab = 1e-9
    for k in range(len(template)):
        u, v = template[k] - a, patch[k] - b
        aa += weight[k] * u * u
        bb += weight[k] * v * v
        ab += weight[k] * u * v
    return ab / np.sqrt(aa * bb)


@compiled
def _project_out(rows: Any, template: Any, weight: Any, count: int) -> None:
    """Take off each row what brightness and contrast explain of it."""
    total = mean = 0.0
    for k in range(count):
        total += weight[k]
        mean += weight[k] * template[k]
    mean /= total
    square = 1e-9
    for k in range(count):
        square += weight[k] * (template[k] - mean) * (template[k] - mean)
    for row in rows:
        level = slope = 0.0
        for k in range(count):
            level += weight[k] * row[k]
            slope += weight[k] * row[k] * (template[k] - mean)
        level, slope = level / total, slope / square
        for k in range(count):
            row[k] -= level + slope * (template[k] - mean)


@compiled
def _align(here: Any, there: Any, at_here: Any, at_there: Any, warps: Any, step: Any, shift: Any, alike: Any) -> None:
    """Of each feature, the shift in ``there`` under which it shows what ``here`` does, and the correlation then.

    Inverse composition (Baker and Matthews, IJCV 2004): the template's slopes serve all steps.
    """
    side = 2 * _RADIUS + 1
    count = side * side
    template, patch, weight = np.empty(count), np.empty(count), np.empty(count)
    x, y, a, eye = np.empty(count), np.empty(count), np.empty((2, 2)), np.eye(2)
    rows, normal, matrix, right = np.empty((6, count)), np.empty((6, 6)), np.empty((6, 6)), np.empty(6)
    for k in range(count):
        u, v = float(k % side - _RADIUS), float(k // side - _RADIUS)
        weight[k] = np.exp(-0.5 * (u * u + v * v) / (0.25 * _RADIUS * _RADIUS))
    mass = weight.sum()
    for f in range(len(step)):
        h = step[f]
        for k in range(count):
            x[k], y[k] = (k % side - _RADIUS) * h, (k // side - _RADIUS) * h
        if not _patch(here, at_here[f], eye, 0.0, 0.0, x, y, template):
            continue
        best = 0.0
        for which in range(warps.shape[1]):
            if _patch(there, at_there[f], warps[f, which], 0.0, 0.0, x, y, patch):
                found = _correlation(template, patch, weight)
                if found > best:
                    best = found
                    a[:] = warps[f, which]
        if best < _LEAST_ALIKE:
            continue
        for k in range(count):
            px, py = at_here[f, 0] + x[k], at_here[f, 1] + y[k]
            gx = 0.5 * (_value(here, px + 1.0, py) - _value(here, px - 1.0, py))
            gy = 0.5 * (_value(here, px, py + 1.0) - _value(here, px, py - 1.0))
            u, v = x[k] / h, y[k] / h
            rows[0, k], rows[1, k], rows[2, k], rows[3, k], rows[4, k], rows[5, k] = (
                gx * u,
                gx * v,
                gy * u,
                gy * v,
                gx,
                gy,
            )
        _project_out(rows, template, weight, count)
        for p in range(6):
            for q in range(6):
                total = 0.0
                for k in range(count):
                    total += weight[k] * rows[p, k] * rows[q, k]
                normal[p, q] = total
            normal[p, p] = normal[p, p] * 1.0001 + 1e-9
        mean = square = 0.0
        for k in range(count):
            mean += weight[k] * template[k] / mass
        for k in range(count):
            square += weight[k] * (template[k] - mean) * (template[k] - mean)
        dx = dy = 0.0
        sound = True
        for _ in range(_STEPS):
            if not _patch(there, at_there[f], a, dx, dy, x, y, patch):
                sound = False
                break
            gain = 0.0
            for k in range(count):
                gain += weight[k] * patch[k] * (template[k] - mean)
            gain = max(gain / max(square, 1e-9), 0.1)
            for p in range(6):
                total = 0.0
                for k in range(count):
                    total += weight[k] * rows[p, k] * patch[k]
                right[p] = total / gain
            matrix[:] = normal
            if not solve(matrix, right):
                sound = False
                break
            # the warp after the inverse of the step
            d00, d01, d10, d11 = 1.0 + right[0] / h, right[1] / h, right[2] / h, 1.0 + right[3] / h
            inverse = d00 * d11 - d01 * d10
            if not inverse > 0.1:
                sound = False
                break
            b00, b01 = (a[0, 0] * d11 - a[0, 1] * d10) / inverse, (a[0, 1] * d00 - a[0, 0] * d01) / inverse
            b10, b11 = (a[1, 0] * d11 - a[1, 1] * d10) / inverse, (a[1, 1] * d00 - a[1, 0] * d01) / inverse
            a[0, 0], a[0, 1], a[1, 0], a[1, 1] = b00, b01, b10, b11
            mx, my = b00 * right[4] + b01 * right[5], b10 * right[4] + b11 * right[5]
            dx -= mx
            dy -= my
            if dx * dx + dy * dy > 4.0 * _FARTHEST * _FARTHEST * h * h:
                sound = False
                break
            if mx * mx + my * my < _REST_PX * _REST_PX:
                break
        if sound:
            alike[f] = _correlation(template, patch, weight)
            shift[f, 0], shift[f, 1] = dx, dy
