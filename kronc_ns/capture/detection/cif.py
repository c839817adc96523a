"""Decode composite intensity fields (Kreiss, Bertoni, Alahi: PifPaf, CVPR 2019; OpenPifPaf, T-ITS 2021).

Written from the papers' description. Each cell of a coarse grid holds, for each kind of keypoint, a confidence, the
place it points to, the spread of that vote and the size of the keypoint. The confidence map of the papers is a sum of
Gaussians, one per vote. It is a function of the plane and is evaluated here only where its peak must lie: at the
places voted for. No raster limits its resolution, and memory does not grow with the image.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

_MAX_VOTES = 128  # per keypoint; in training 4 x 4 cells around a keypoint vote for it
_PATCH_CELLS = 16.0
_STEPS = 8  # of the regression
_MIN_SIGMA = 0.5  # of a Gaussian, in cells: votes come from cells and scatter accordingly, however small the keypoint


def decode_cif(
    fields: Float[np.ndarray, "k 5 h w"],
    allowed: Callable[[Float[np.ndarray, "*n 2"]], Bool[np.ndarray, "*n"]] | None = None,
    min_vote: float = 0.1,
) -> tuple[Float[np.ndarray, "k 2"], Float[np.ndarray, "k"]]:
    """The strongest peak of each of K intensity fields, (x, y) in cells, and its confidence in [0, 1].

    The five components: confidence in [0, 1], x and y of the place voted for (absolute, in cells, cell (0, 0) being
    the origin), spread of the vote (only its proportions matter), size of the keypoint in cells. ``allowed`` says
    of places in cells whether the object may have a point there; other votes are ignored, as are those below
    ``min_vote``. A field without votes gets confidence 0 and the place (0, 0).
    """
    count, _, height, width = fields.shape
    flat = fields.reshape(count, 5, height * width)
    chosen = np.argpartition(-flat[:, 0], min(_MAX_VOTES, height * width) - 1, axis=1)[:, :_MAX_VOTES]
    votes = np.take_along_axis(flat, chosen[:, None], axis=2).astype(np.float64)
    confidence, x, y, spread, size = np.moveaxis(votes, 1, 0)
    places = np.stack([x, y], axis=-1)
    confidence = np.where(confidence >= min_vote, confidence, 0.0)
    if allowed is not None:
        confidence = confidence * allowed(places)
    sigma = np.maximum(0.5 * size, _MIN_SIGMA)

    squared = np.square(places[:, :, None] - places[:, None]).sum(-1)  # [k, at, of]
    density = np.einsum("ko,kao->ka", confidence, np.exp(-0.5 * squared / np.square(sigma)[:, None]))
    density = np.where(confidence > 0, density, 0.0)
    best = density.argmax(1)[:, None]
    peak = np.take_along_axis(places, best[..., None], axis=1)[:, 0]
    strength = np.minimum(np.take_along_axis(density, best, axis=1)[:, 0] / _PATCH_CELLS, 1.0)
    width_of_peak = np.take_along_axis(sigma, best, axis=1)[:, 0]
    peak = _regress(peak, width_of_peak, places, confidence / np.maximum(spread, 1e-3))
    return np.where(strength[:, None] > 0, peak, 0.0), strength


def _regress(
    peak: Float[np.ndarray, "k 2"],
    sigma: Float[np.ndarray, "k"],
    places: Float[np.ndarray, "k m 2"],
    weights: Float[np.ndarray, "k m"],
) -> Float[np.ndarray, "k 2"]:
    """Weighted means of the votes around each peak, which follow the peak (mean shift) with a window fit for noise.

    The window is a Gaussian twice as wide as the votes scatter, but never less than the peak: narrow enough to forget
    the same keypoint of another car, wide enough that noise in the votes averages out.
    """
    variance = np.square(sigma)
    for _ in range(_STEPS):
        squared = np.square(places - peak[:, None]).sum(-1)
        window = weights * np.exp(-0.5 * squared / variance[:, None])
        total = np.maximum(window.sum(1), 1e-12)
        peak = np.einsum("km,kmc->kc", window, places) / total[:, None]
        scatter = 0.5 * (window * squared).sum(1) / total  # per axis, as seen through the window
        variance = np.maximum(np.square(sigma), 4.0 * scatter)
    return peak
