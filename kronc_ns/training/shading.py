"""The shader: what light each ray that meets a car brings back, compiled."""

import math
from typing import Any

import numpy as np

from kronc_ns.solve.compiled import compiled

MATTE, PAINT, GLASS, LAMP, TYRE, METAL = range(6)
"""Kinds of surface: index into `GLOSS`."""
# reflectance at normal incidence, and how much of the sharp, glossy and rough panorama the reflection takes
GLOSS = np.array(
    [
        [0.02, 0.0, 0.0, 1.0],
        [0.05, 0.75, 0.25, 0.0],
        [0.06, 1.0, 0.0, 0.0],
        [0.08, 0.8, 0.2, 0.0],
        [0.02, 0.0, 0.0, 1.0],
        [0.55, 0.2, 0.6, 0.2],
    ],
    dtype=np.float32,
)

LEVELS = 5
"""Sizes in which a decal is kept, each half the one before."""


@compiled
def panorama(image: Any, x: float, y: float, z: float, out: Any) -> None:
    """Bilinear look-up of a unit direction."""
    height, width = image.shape[:2]
    column = (math.atan2(y, x) / (2 * math.pi) + 0.5) * width - 0.5
    row = math.acos(min(1.0, max(-1.0, z))) / math.pi * height - 0.5
    left, top = math.floor(column), math.floor(row)
    a, b = column - left, row - top
    r0, r1 = int(min(max(top, 0), height - 1)), int(min(max(top + 1, 0), height - 1))
    c0, c1 = int(left) % width, int(left + 1) % width
    for k in range(3):
        upper = (1 - a) * image[r0, c0, k] + a * image[r0, c1, k]
        lower = (1 - a) * image[r1, c0, k] + a * image[r1, c1, k]
        out[k] = (1 - b) * upper + b * lower


@compiled
def _texture(texels: Any, start: int, height: int, width: int, u: float, v: float, out: Any) -> None:
    """Bilinear look-up with repetition in a texture that lies flat among others; squared, as light adds up."""
    column = (u - math.floor(u)) * width - 0.5
    row = (1 - (v - math.floor(v))) * height - 0.5
    left, top = math.floor(column), math.floor(row)
    a, b = column - left, row - top
    c0, c1 = int(left) % width, int(left + 1) % width
    r0, r1 = int(top) % height, int(top + 1) % height
    for k in range(3):
        upper = (1 - a) * texels[start + r0 * width + c0, k] + a * texels[start + r0 * width + c1, k]
        lower = (1 - a) * texels[start + r1 * width + c0, k] + a * texels[start + r1 * width + c1, k]
        value = ((1 - b) * upper + b * lower) / 255
        out[k] = value * value


@compiled
def shade(
    hits: Any,
    where: Any,
    direction: Any,
    footprint: Any,
    corner: Any,
    weight: Any,
    sunlit: Any,
    mesh: Any,
    paint: Any,
    light: Any,
    out: Any,
) -> None:
    """Radiance [n, 3] that leaves the surface towards the eye.

    ``hits`` [n] faces, ``where`` [n, 3] points, ``direction`` [n, 3] of the rays, ``footprint`` [n] metres per pixel,
    ``corner``, ``weight`` [n, 3] vertices and their weights, ``sunlit`` [n] 0 or 1. ``mesh``, ``paint`` and ``light``
    are the tuples `rendering` packs.
    """
    normals, uv, occlusion, face_surface, face_normal = mesh
    kind, rgb, texels, texture_at, decals, decal_texels, gloss, flake, dirt, dirt_rgb = paint
    sharp, glossy, rough, diffuse, sun, sun_rgb, ground_rgb = light
    colour, sky, mirror = np.empty(3), np.empty(3), np.empty(3)
    value = np.empty(3)
    for n in range(len(hits)):
        face = hits[n]
        surface = face_surface[face]
        nx = ny = nz = open_ = u = v = 0.0
        for k in range(3):
            vertex, w = corner[n, k], weight[n, k]
            nx += w * normals[vertex, 0]
            ny += w * normals[vertex, 1]
            nz += w * normals[vertex, 2]
            open_ += w * occlusion[vertex]
            u += w * uv[vertex, 0]
            v += w * uv[vertex, 1]
        dx, dy, dz = direction[n, 0], direction[n, 1], direction[n, 2]
        # faces have two sides: the normal is the one that the eye sees
        fx, fy, fz = face_normal[face, 0], face_normal[face, 1], face_normal[face, 2]
        if nx * fx + ny * fy + nz * fz < 0:
            nx, ny, nz = -nx, -ny, -nz
        if fx * dx + fy * dy + fz * dz > 0:
            nx, ny, nz, fx, fy, fz = -nx, -ny, -nz, -fx, -fy, -fz
        size = math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-12
        nx, ny, nz = nx / size, ny / size, nz / size
        cosine = -(nx * dx + ny * dy + nz * dz)
        if cosine < 0.02:
            cosine = 0.02
        what = kind[surface]
        for k in range(3):
            colour[k] = rgb[surface, k]
        if texture_at[surface, 1] > 0:
            _texture(texels, texture_at[surface, 0], texture_at[surface, 1], texture_at[surface, 2], u, v, value)
            for k in range(3):
                colour[k] *= value[k]
        px, py, pz = where[n, 0], where[n, 1], where[n, 2]
        matte = 0.0
        for d in range(len(decals)):
            if decals[d, 5 + 3 * LEVELS + surface] == 0.0:
                continue
            view = int(decals[d, 0])
            if view == 0:
                facing, a, b = fy, px, pz
            elif view == 1:
                facing, a, b = -fy, px, pz
            elif view == 2:
                facing, a, b = fx, py, pz
            elif view == 3:
                facing, a, b = -fx, py, pz
            else:
                facing, a, b = fz, px, py
            if facing < 0.3:
                continue
            # the level whose texels are about as wide as the pixel
            level = int(min(max(math.log2(footprint[n] / decals[d, 3]) + 0.5, 0.0), LEVELS - 1.0))
            start, height, width = decals[d, 5 + 3 * level], decals[d, 6 + 3 * level], decals[d, 7 + 3 * level]
            column = math.floor((a - decals[d, 1]) / decals[d, 3] * width / decals[d, 7])
            row = math.floor((decals[d, 2] - b) / decals[d, 3] * height / decals[d, 6])
            if column < 0 or row < 0 or column >= width or row >= height:
                continue
            at = int(start + row * width + column)
            alpha = decal_texels[at, 3] / 255
            matte = max(matte, alpha * (1 - decals[d, 4]))
            for k in range(3):
                level = decal_texels[at, k] / 255
                colour[k] += alpha * (level * level - colour[k])
        if dirt > 0:
            much = dirt * math.exp(-max(pz, 0.0) / 0.28)
            matte = max(matte, much)
            for k in range(3):
                colour[k] += much * (dirt_rgb[k] - colour[k])
        panorama(diffuse, nx, ny, nz, sky)
        lambert = nx * sun[0] + ny * sun[1] + nz * sun[2]
        lambert = max(lambert, 0.0) * sunlit[n]
        # the reflection: of the surroundings, below the horizon of the ground
        rx, ry, rz = dx + 2 * cosine * nx, dy + 2 * cosine * ny, dz + 2 * cosine * nz
        length = math.sqrt(rx * rx + ry * ry + rz * rz) + 1e-12
        rx, ry, rz = rx / length, ry / length, rz / length
        fresnel = gloss[what, 0] + (1 - gloss[what, 0]) * (1 - cosine) ** 5 * (0.25 if what in (MATTE, TYRE) else 1.0)
        fresnel *= 1 - 0.8 * matte
        for k in range(3):
            mirror[k] = 0.0
        if rz < 0:
            for k in range(3):
                mirror[k] = ground_rgb[k]
        else:
            if gloss[what, 1] > 0:
                panorama(sharp, rx, ry, rz, value)
                for k in range(3):
                    mirror[k] += gloss[what, 1] * value[k]
            if gloss[what, 2] > 0:
                panorama(glossy, rx, ry, rz, value)
                for k in range(3):
                    mirror[k] += gloss[what, 2] * value[k]
            if gloss[what, 3] > 0:
                panorama(rough, rx, ry, rz, value)
                for k in range(3):
                    mirror[k] += gloss[what, 3] * value[k]
        shine = lambert_shine(rx, ry, rz, sun) * sunlit[n] * (40.0 if what in (PAINT, GLASS, LAMP, METAL) else 0.0)
        reflected = min(1.0, 0.3 + open_)
        for k in range(3):
            body = colour[k] * (sky[k] * open_ + lambert * sun_rgb[k])
            if what == PAINT:
                body += flake * colour[k] * mirror[k] * 0.5
            tint = colour[k] if what == METAL else 1.0
            out[n, k] = body * (1 - fresnel) + fresnel * tint * (reflected * mirror[k] + shine * sun_rgb[k])


@compiled
def lambert_shine(rx: float, ry: float, rz: float, sun: Any) -> float:
    """The sun's highlight around the mirrored direction."""
    near = rx * sun[0] + ry * sun[1] + rz * sun[2]
    return math.exp(-(1 - near) * 700) if near > 0.9 else 0.0


@compiled
def shade_ground(
    where: Any, distance: Any, shadow: Any, dark: Any, ground: Any, ground_m: float, light: Any, out: Any
) -> None:
    """Radiance [n, 3] of the ground at ``where`` [n, 2]; ``shadow`` [n] 0: no sun, ``dark`` [n]: share of the sky."""
    size = len(ground)
    _, _, _, diffuse, sun, sun_rgb, ground_rgb = light
    sky = np.empty(3)
    panorama(diffuse, 0.0, 0.0, 1.0, sky)
    for n in range(len(where)):
        column = int((where[n, 0] / ground_m - math.floor(where[n, 0] / ground_m)) * size) % size
        row = int((where[n, 1] / ground_m - math.floor(where[n, 1] / ground_m)) * size) % size
        # far away the texture would alias: there it fades to its mean
        blend = 1 / (1 + (distance[n] / 18) ** 2)
        for k in range(3):
            albedo = ground_rgb[3 + k] + blend * (ground[row, column, k] - ground_rgb[3 + k])
            out[n, k] = albedo * (sky[k] * dark[n] + max(sun[2], 0.0) * shadow[n] * sun_rgb[k])
