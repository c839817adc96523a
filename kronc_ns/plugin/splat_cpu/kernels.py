"""Compiled loops of the rasteriser; importing this module imports numba, so import it only to rasterise.

"3D Gaussian Splatting for Real-Time Radiance Field Rendering" (Kerbl et al. 2023), section 6 and appendix C, ordered
for a CPU: within a tile the Gaussians come one after the other, front to back, and each works on whole rows of the
tile at once. A pixel meets the same Gaussians in the same order as on a GPU. The loops over x have a fixed length and
no branches, so that they compile to vector instructions; for that the constants are single precision, too.
All of it stands in one file because numba's cache on disk notices changes of a function's own file only.

Arrays are flat over cameras: M = cameras x Gaussians, K = (tile, Gaussian) pairs, T = cameras x tiles.
"""

import math
from typing import Any

import numpy as np

from kronc_ns.plugin.splat_cpu.tiles import TILE
from kronc_ns.solve.compiled import compiled

ALPHA_MIN = np.float32(1 / 255)  # fainter contributions are skipped
ALPHA_MAX = np.float32(0.999)
TRANSMITTANCE_MIN = np.float32(1e-4)  # a pixel is closed before its transmittance would fall below this
ZERO, HALF, ONE = np.float32(0), np.float32(0.5), np.float32(1)
# The planes of a tile's workspace [planes, TILE, TILE]; one array for all, or the compiler fears that they overlap and
# gives up on vector instructions. Colours or their gradients, one plane a channel, come after the others.
PASSED, OPEN, WEIGHT, COLUMN, BEHIND, ALONG, PLANES = range(7)
RECOUNT = 16  # Gaussians between two looks at which rows of a tile still have open pixels

# exp(-s) = (e^-r e^-(s/8 - r))^8 with |s/8 - r| <= r on [0, REACH]: a Taylor series of degree 7 is exact to rounding
REACH = np.float32(5.6)  # past log(255) even an opaque Gaussian is fainter than ALPHA_MIN
EIGHTH, MIDDLE = np.float32(1 / 8), np.float32(5.6 / 16)
C0, C1, C2, C3, C4, C5, C6, C7 = (np.float32((-1) ** n / math.factorial(n) * math.exp(-5.6 / 16)) for n in range(8))


@compiled
def _falloff(sigma: Any) -> Any:
    """exp(-sigma) for sigma in [0, REACH], from products only: a call of ``exp`` would end the vector instructions."""
    u = min(sigma, REACH) * EIGHTH - MIDDLE
    e = C0 + u * (C1 + u * (C2 + u * (C3 + u * (C4 + u * (C5 + u * (C6 + u * C7))))))
    e = e * e
    e = e * e
    return e * e


@compiled
def _rows(mx: float, my: float, a: float, b: float, c: float, opacity: float, height: int) -> tuple[int, int]:
    """First row and last row + 1 of a tile that the ellipse ``alpha >= ALPHA_MIN`` reaches, at most one too many.

    ``mx`` and ``my`` count from the tile's corner, of which ``height`` rows lie in the image.
    """
    determinant = a * c - b * b
    if not (determinant > 0 and a > 0):  # not an ellipse: rounding spoilt the covariance
        return 0, height
    scale = 2 * math.log(opacity / ALPHA_MIN) / determinant
    half_x, half_y = math.sqrt(scale * c), math.sqrt(scale * a)
    if mx + half_x < 0 or mx - half_x > TILE:
        return 0, 0
    return int(max(0.0, math.floor(my - half_y - 0.5))), int(min(float(height), math.ceil(my + half_y + 0.5)))


@compiled
def _workspace(channels: int, height: int, width: int, dtype: Any) -> np.ndarray:
    """Planes for a tile of which ``height`` x ``width`` pixels lie in the image."""
    work = np.zeros((PLANES + channels, TILE, TILE), dtype)
    for y in range(TILE):
        for x in range(TILE):
            work[PASSED, y, x] = ONE
            work[OPEN, y, x] = ONE if (y < height) & (x < width) else ZERO
            work[COLUMN, y, x] = x + 0.5
    return work


@compiled
def _any_open(work: np.ndarray, row_open: np.ndarray) -> bool:
    """Whether a tile has open pixels left, and in ``row_open [TILE]`` which of its rows."""
    anywhere = False
    for y in range(TILE):
        count = ZERO
        for x in range(TILE):
            count += work[OPEN, y, x]
        row_open[y] = count > ZERO
        anywhere |= row_open[y]
    return anywhere


@compiled
def _composite_tile(
    means2d: np.ndarray,
    conics: np.ndarray,
    colors: np.ndarray,
    opacities: np.ndarray,
    background: np.ndarray,
    gaussians: np.ndarray,
    top: int,
    left: int,
    render: np.ndarray,
    transmittance: np.ndarray,
) -> None:
    """One tile of `rasterize_forward`: its own ``gaussians``, and the image of its own camera."""
    kind = means2d.dtype.type
    height, width, channels = render.shape
    bottom, right = min(top + TILE, height), min(left + TILE, width)
    work, row_open = _workspace(channels, bottom - top, right - left, means2d.dtype), np.ones(TILE, np.bool_)
    for k in range(len(gaussians)):
        if k % RECOUNT == 0 and not _any_open(work, row_open):
            break
        i = gaussians[k]
        opacity = opacities[i]
        if not opacity >= ALPHA_MIN:
            continue
        mx, my, a, b, c = (
            means2d[i, 0] - kind(left),
            means2d[i, 1] - kind(top),
            conics[i, 0],
            conics[i, 1],
            conics[i, 2],
        )
        first, last = _rows(mx, my, a, b, c, opacity, bottom - top)
        for y in range(first, last):
            if not row_open[y]:
                continue
            dy = my - kind(y + 0.5)
            slope, base = b * dy, HALF * c * dy * dy
            for x in range(TILE):
                dx = mx - work[COLUMN, y, x]
                sigma = (HALF * a * dx + slope) * dx + base
                alpha = min(ALPHA_MAX, opacity * _falloff(sigma))
                before = work[PASSED, y, x]
                after = before * (ONE - alpha)
                hit = (sigma >= ZERO) & (sigma < REACH) & (alpha >= ALPHA_MIN) & (work[OPEN, y, x] > ZERO)
                drawn = hit & (after > TRANSMITTANCE_MIN)
                work[WEIGHT, y, x] = alpha * before if drawn else ZERO
                work[PASSED, y, x] = after if drawn else before
                work[OPEN, y, x] = ZERO if hit & (not drawn) else work[OPEN, y, x]
            for d in range(channels):
                color = colors[i, d]
                for x in range(TILE):
                    work[PLANES + d, y, x] += work[WEIGHT, y, x] * color
    for y in range(bottom - top):
        for x in range(right - left):
            transmittance[top + y, left + x] = work[PASSED, y, x]
            for d in range(channels):
                render[top + y, left + x, d] = work[PLANES + d, y, x] + work[PASSED, y, x] * background[d]


@compiled
def rasterize_forward(
    share: np.ndarray,
    means2d: np.ndarray,
    conics: np.ndarray,
    colors: np.ndarray,
    opacities: np.ndarray,
    backgrounds: np.ndarray,
    gaussians: np.ndarray,
    offsets: np.ndarray,
    across: int,
    render: np.ndarray,
    transmittance: np.ndarray,
) -> None:
    """Composite front to back (equation 3 of the paper): C = sum_i c_i alpha_i T_i, T_i = prod_{j<i} (1 - alpha_j).

    ``means2d [M,2]`` px, ``conics [M,3]`` (inverse 2D covariance: xx, xy, yy) 1/px^2, ``colors [M,D]``,
    ``opacities [M]``, ``backgrounds [C,D]``, ``gaussians [K]`` front to back within each tile, ``offsets [T+1]`` into
    it; fills the tiles named in ``share`` of ``render [C,H,W,D]`` and ``transmittance [C,H,W]``.
    """
    tiles = (len(offsets) - 1) // len(render)
    for tile in share:
        camera, place = tile // tiles, tile % tiles
        top, left = place // across * TILE, place % across * TILE
        listed, image = gaussians[offsets[tile] : offsets[tile + 1]], (render[camera], transmittance[camera])
        _composite_tile(means2d, conics, colors, opacities, backgrounds[camera], listed, top, left, *image)


@compiled
def _differentiate_tile(
    means2d: np.ndarray,
    conics: np.ndarray,
    colors: np.ndarray,
    opacities: np.ndarray,
    gaussians: np.ndarray,
    numbers: np.ndarray,
    top: int,
    left: int,
    render: np.ndarray,
    transmittance: np.ndarray,
    v_render: np.ndarray,
    v_alpha: np.ndarray,
    v_pairs: np.ndarray,
) -> None:
    """One tile of `rasterize_backward`: its own ``gaussians`` and ``numbers``, and the image of its own camera."""
    kind = means2d.dtype.type
    height, width, channels = render.shape
    bottom, right = min(top + TILE, height), min(left + TILE, width)
    work, row_open = _workspace(channels, bottom - top, right - left, means2d.dtype), np.ones(TILE, np.bool_)
    for y in range(bottom - top):
        for x in range(right - left):  # behind: what the loss gains from here on
            work[BEHIND, y, x] = -transmittance[top + y, left + x] * v_alpha[top + y, left + x]
            for d in range(channels):
                work[PLANES + d, y, x] = v_render[top + y, left + x, d]
                work[BEHIND, y, x] += render[top + y, left + x, d] * work[PLANES + d, y, x]
    for k in range(len(gaussians)):
        if k % RECOUNT == 0 and not _any_open(work, row_open):
            break
        i = gaussians[k]
        opacity = opacities[i]
        if not opacity >= ALPHA_MIN:
            continue
        mx, my, a, b, c = (
            means2d[i, 0] - kind(left),
            means2d[i, 1] - kind(top),
            conics[i, 0],
            conics[i, 1],
            conics[i, 2],
        )
        first, last = _rows(mx, my, a, b, c, opacity, bottom - top)
        v = v_pairs[numbers[k]]
        v_x, v_y, v_x_abs, v_y_abs, v_a, v_b, v_c, v_opacity = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO, ZERO
        for y in range(first, last):
            if not row_open[y]:
                continue
            dy = my - kind(y + 0.5)
            slope, base, c_dy = b * dy, HALF * c * dy * dy, c * dy
            for x in range(TILE):
                work[ALONG, y, x] = ZERO
            for d in range(channels):
                color = colors[i, d]
                for x in range(TILE):
                    work[ALONG, y, x] += color * work[PLANES + d, y, x]
            # sums over the row of v_sigma, v_sigma dx, v_sigma dx^2 and of the absolute gradients of the centre
            sum_0, sum_1, sum_2, sum_x, sum_y = ZERO, ZERO, ZERO, ZERO, ZERO
            for x in range(TILE):
                dx = mx - work[COLUMN, y, x]
                sigma = (HALF * a * dx + slope) * dx + base
                full = opacity * _falloff(sigma)
                alpha = min(ALPHA_MAX, full)
                before = work[PASSED, y, x]
                after = before * (ONE - alpha)
                hit = (sigma >= ZERO) & (sigma < REACH) & (alpha >= ALPHA_MIN) & (work[OPEN, y, x] > ZERO)
                drawn = hit & (after > TRANSMITTANCE_MIN)
                weight = alpha * before if drawn else ZERO
                behind = work[BEHIND, y, x] - weight * work[ALONG, y, x]
                v_sigma = alpha * (behind / (ONE - alpha) - before * work[ALONG, y, x])
                v_sigma = v_sigma if drawn & (full <= ALPHA_MAX) else ZERO  # clamped: only the colour matters
                work[WEIGHT, y, x] = weight
                work[BEHIND, y, x] = behind
                work[PASSED, y, x] = after if drawn else before
                work[OPEN, y, x] = ZERO if hit & (not drawn) else work[OPEN, y, x]
                sum_0 += v_sigma
                sum_1 += v_sigma * dx
                sum_2 += v_sigma * dx * dx
                sum_x += abs(v_sigma * (a * dx + slope))
                sum_y += abs(v_sigma * (b * dx + c_dy))
            v_x += a * sum_1 + slope * sum_0
            v_y += b * sum_1 + c_dy * sum_0
            v_x_abs += sum_x
            v_y_abs += sum_y
            v_a += HALF * sum_2
            v_b += dy * sum_1
            v_c += HALF * dy * dy * sum_0
            v_opacity -= sum_0 / opacity
            for d in range(channels):
                v_color = ZERO
                for x in range(TILE):
                    v_color += work[WEIGHT, y, x] * work[PLANES + d, y, x]
                v[8 + d] += v_color
        v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7] = v_x, v_y, v_x_abs, v_y_abs, v_a, v_b, v_c, v_opacity


@compiled
def rasterize_backward(
    share: np.ndarray,
    means2d: np.ndarray,
    conics: np.ndarray,
    colors: np.ndarray,
    opacities: np.ndarray,
    gaussians: np.ndarray,
    offsets: np.ndarray,
    numbers: np.ndarray,
    across: int,
    render: np.ndarray,
    transmittance: np.ndarray,
    v_render: np.ndarray,
    v_alpha: np.ndarray,
    v_pairs: np.ndarray,
) -> None:
    """Gradients of every (tile, Gaussian) pair on the tiles in ``share``, walking front to back once more.

    With g the gradient of a pixel's colour and R its rendered colour, background included,
    dL/dalpha_i = T_i c_i.g - (what lies behind i) / (1 - alpha_i), and what lies behind is R.g minus what has been
    passed, so no order needs to be turned round. ``v_render [C,H,W,D]`` and ``v_alpha [C,H,W]`` (of 1 - the final
    transmittance) come in; row ``numbers[k]`` of ``v_pairs [K,8+D]`` is filled for pair k: means2d x, y and the sums
    of their absolute values over pixels (AbsGS, Ye et al. 2024), conics xx, xy, yy, opacity, colours.
    """
    tiles = (len(offsets) - 1) // len(render)
    for tile in share:
        camera, place = tile // tiles, tile % tiles
        top, left = place // across * TILE, place % across * TILE
        start, end = offsets[tile], offsets[tile + 1]
        listed, image = (gaussians[start:end], numbers[start:end]), (render[camera], transmittance[camera])
        wanted = (v_render[camera], v_alpha[camera], v_pairs)
        _differentiate_tile(means2d, conics, colors, opacities, *listed, top, left, *image, *wanted)


@compiled
def sum_over_tiles(v_pairs: np.ndarray, starts: np.ndarray, order: np.ndarray, v_gaussians: np.ndarray) -> None:
    """Add the rows ``starts[i]:starts[i+1]`` of ``v_pairs [K,F]`` into row ``order[i]`` of ``v_gaussians [M,F]``."""
    for i in range(len(order)):
        for row in range(starts[i], starts[i + 1]):
            for f in range(v_pairs.shape[1]):
                v_gaussians[order[i], f] += v_pairs[row, f]
