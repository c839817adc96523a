"""Tracks that need no poses: features of neighbouring views that choose each other, where one epipolar geometry fits.

Keypoints of few photos are off by more than guided matching looks from them, and what it finds near wrong lines
confirms them. Only the matches are used, not the geometry they were found by: of few, or of a plane, it is vague.
"""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from kronc_ns.refine.gathering import Gathered
from kronc_ns.refine.tracks import Linked, Tracks, link
from kronc_ns.solve.compiled import compiled
from kronc_ns.solve.threads import side_by_side

_MOST = 2000  # features of a view: the largest, which look alike from farther apart
_RATIO, _SIMILAR = 0.85, 0.8  # of descriptors, as in guided matching
_WITHIN_PX, _TRIALS, _CONFIDENCE = 1.5, 5000, 0.9999  # of consensus
_LEAST, _LEAST_SHARE = 16, 0.45  # matches that must agree: of views across the car up to 26 do, a share of 0.43; of
# neighbours up to 50 degrees apart 45 or more, from 0.46 on


def unguided_tracks(
    gathered: Gathered,
    used: Bool[np.ndarray, "f"],
    pairs: Int[np.ndarray, "p 2"],
    uv: Float[np.ndarray, "f 2"],
    focal: float,
    advance: Callable[[], None],
) -> Tracks:
    """Tracks, whose points are still unknown, of the features that may be ``used``.

    ``uv`` are ideal pixels of a camera with this focal length; ``advance`` is called after each pair.
    """
    chosen = [_largest(gathered, used, view) for view in range(len(gathered.first) - 1)]
    camera = np.diag([focal, focal, 1.0])

    def compare(pair: list[int]) -> Linked:
        a, b = chosen[pair[0]], chosen[pair[1]]
        here, there, similarity, ratio = _mutual(gathered.descriptor[a], gathered.descriptor[b])
        matches = Linked(a[here], b[there], similarity, ratio)
        return matches.chosen(_agree(uv[matches.here], uv[matches.there], camera))

    parts = []
    for part in side_by_side(compare, pairs.tolist()):
        parts.append(part)
        advance()
    return link(Linked.of(parts), gathered.view)


def _largest(gathered: Gathered, used: Bool[np.ndarray, "f"], view: int) -> Int[np.ndarray, "k"]:
    own = np.arange(gathered.first[view], gathered.first[view + 1])
    own = own[used[own]]
    return np.sort(own[np.argsort(-gathered.size[own], kind="stable")[:_MOST]])


def _mutual(
    a: Float32[np.ndarray, "k 128"], b: Float32[np.ndarray, "l 128"]
) -> tuple[Int[np.ndarray, "m"], Int[np.ndarray, "m"], Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """Descriptors that choose each other: which, their product, and the larger ratio of distances to the next best."""
    best, ahead = np.full((len(a), 1), -1), np.full((len(a), 2), -1.0)
    best_back, ahead_back = np.full((len(b), 1), -1), np.full((len(b), 2), -1.0)
    if len(a) and len(b):
        _two_best(a @ b.T, best[:, 0], ahead, best_back[:, 0], ahead_back)
    here = np.flatnonzero((best[:, 0] >= 0) & (ahead[:, 0] > _SIMILAR))
    here = here[best_back[best[here, 0], 0] == here]
    there = best[here, 0]

    def ratio(products: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m"]:
        first, second = np.sqrt(np.maximum(2 - 2 * products, 0.0)).T
        return first / np.maximum(second, 1e-9)

    worse = np.maximum(ratio(ahead[here]), ratio(ahead_back[there]))
    clear = worse < _RATIO
    return here[clear], there[clear], ahead[here[clear], 0], worse[clear]


@compiled
def _two_best(product: Any, best: Any, ahead: Any, best_back: Any, ahead_back: Any) -> None:
    """The best of each row and of each column, and the best and next best product of each."""
    for i in range(product.shape[0]):
        first, second, chosen = -1.0, -1.0, -1
        for j in range(product.shape[1]):
            value = product[i, j]
            if value > second:
                if value > first:
                    first, second, chosen = value, first, j
                else:
                    second = value
            if value > ahead_back[j, 1]:
                if value > ahead_back[j, 0]:
                    ahead_back[j, 1] = ahead_back[j, 0]
                    ahead_back[j, 0] = value
                    best_back[j] = i
                else:
                    ahead_back[j, 1] = value
        best[i], ahead[i, 0], ahead[i, 1] = chosen, first, second


def _agree(
    here: Float[np.ndarray, "m 2"], there: Float[np.ndarray, "m 2"], camera: Float[np.ndarray, "3 3"]
) -> Bool[np.ndarray, "m"]:
    """Which matches the epipolar geometry explains that explains most; none of them where that is not many."""
    nobody = np.zeros(len(here), bool)
    if len(here) < _LEAST:
        return nobody
    _, inlier = cv2.findEssentialMat(here, there, camera, cv2.USAC_MAGSAC, _CONFIDENCE, _WITHIN_PX, maxIters=_TRIALS)
    if inlier is None:
        return nobody
    agree = inlier[:, 0] > 0
    return agree if agree.sum() >= max(_LEAST, _LEAST_SHARE * len(here)) else nobody
