"""Pictures on surfaces: halvings of a texture, and its values between the texels."""

import numpy as np
from jaxtyping import Float, Float32, UInt8


def mip_levels(image: UInt8[np.ndarray, "h w c"]) -> tuple[UInt8[np.ndarray, "_ _ c"], ...]:
    """The image and its successive halvings, each the mean over 2 x 2 texels."""
    levels = [image]
    while min(levels[-1].shape[:2]) > 8:
        height, width = (n // 2 * 2 for n in levels[-1].shape[:2])
        rows = levels[-1][:height:2, :width].astype(np.uint16) + levels[-1][1:height:2, :width]
        levels.append(((rows[:, ::2] + rows[:, 1::2] + 2) // 4).astype(np.uint8))
    return tuple(levels)


def sample(
    levels: tuple[UInt8[np.ndarray, "_ _ c"], ...],
    column: Float[np.ndarray, "n"],
    row: Float[np.ndarray, "n"],
    size: Float[np.ndarray, "n"],
) -> Float32[np.ndarray, "n c"]:
    """Bilinear texture values in 0..1 at texel coordinates of level 0, from the level that fits `size` texels."""
    level = np.clip(np.round(np.log2(np.maximum(size, 1))), 0, len(levels) - 1).astype(int)
    out = np.empty((len(column), levels[0].shape[2]), np.float32)
    for i in np.unique(level):
        on, image = level == i, levels[i]
        x, y = column[on] / 2**i - 0.5, row[on] / 2**i - 0.5
        x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
        wx, wy = (x - x0).astype(np.float32)[:, None], (y - y0).astype(np.float32)[:, None]
        xa, xb = (np.clip(x0 + d, 0, image.shape[1] - 1) for d in (0, 1))
        ya, yb = (np.clip(y0 + d, 0, image.shape[0] - 1) for d in (0, 1))
        upper = image[ya, xa] * (1 - wx) + image[ya, xb] * wx
        lower = image[yb, xa] * (1 - wx) + image[yb, xb] * wx
        out[on] = (upper * (1 - wy) + lower * wy) / 255
    return out
