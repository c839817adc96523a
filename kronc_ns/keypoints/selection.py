"""Which car? One instance per image out of several, the same car over the frames."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Integer

_SWITCH_WEIGHT = 2.0  # how much a jump of the car between neighbouring frames costs against size, place and mask


def select_instances(
    instances: Sequence[Float[np.ndarray, "_ j 3"]],
    sizes: Sequence[tuple[int, int]],
    masks: Sequence[Integer[np.ndarray, "h w"] | None] | None = None,
) -> tuple[Float[np.ndarray, "n j 3"], str]:
    """The (u, v, confidence) rows of one car per frame, and a sentence that says what was chosen from.

    ``instances`` are the cars found in each of the N frames, in capture order; ``sizes`` are the frames' (width,
    height); ``masks`` are 0 outside the car. Each car scores the share of its points inside the mask or, without a
    mask, its size and nearness to the image centre; a jump of place or size between frames costs. The best path
    through all frames is found exactly (dynamic programming). A frame without any car gets rows of zeros.
    """
    instances = [rows[(rows[..., 2] > 0).any(1)] for rows in instances]  # without a point there is no car
    filled = [i for i, rows in enumerate(instances) if len(rows)]
    chosen = np.zeros((len(instances), *instances[0].shape[1:]))
    if not filled:
        return chosen, "no car found in any image"
    boxes = [_boxes(instances[i], sizes[i]) for i in filled]
    scores = [
        _score(instances[i], box, sizes[i], masks[i] if masks else None) for i, box in zip(filled, boxes, strict=True)
    ]

    path = consistent_path(scores, boxes, filled)
    for i, instance in zip(filled, path, strict=True):
        chosen[i] = instances[i][instance]

    several = sum(len(rows) > 1 for rows in instances)
    if not several:
        return chosen, "one car in every image that has one"
    how = "overlap with the mask" if masks and any(m is not None for m in masks) else "size and nearness to the centre"
    return chosen, f"{several} images show several cars: the main one was taken by {how}, consistent over the frames"


def consistent_path(
    scores: Sequence[Float[np.ndarray, "_"]], boxes: Sequence[Float[np.ndarray, "_ 4"]], frames: Sequence[int]
) -> list[int]:
    """Which instance to take in each of these frames: high scores, without jumps. Exact (dynamic programming).

    ``boxes`` are (centre u, centre v, width, height) in image diagonals; ``frames`` tells how far apart they are.
    """
    total, back = scores[0], []
    for k in range(1, len(frames)):
        jump = np.abs(boxes[k][:, None] - boxes[k - 1][None]).sum(-1) / (frames[k] - frames[k - 1])
        candidates = total[None] - _SWITCH_WEIGHT * jump
        back.append(candidates.argmax(1))
        total = scores[k] + candidates.max(1)
    path = [int(total.argmax())]
    for choices in reversed(back):
        path.append(int(choices[path[-1]]))
    return path[::-1]


def prominence(boxes: Float[np.ndarray, "m 4"], size: tuple[int, int]) -> Float[np.ndarray, "m"]:
    """Score of boxes (centre and sides in image diagonals) by size and nearness to the image centre."""
    centre = np.array(size) / 2 / np.hypot(*size)
    return np.sqrt(boxes[:, 2] * boxes[:, 3]) * 2 - np.hypot(*(boxes[:, :2] - centre).T)


def _boxes(rows: Float[np.ndarray, "m j 3"], size: tuple[int, int]) -> Float[np.ndarray, "m 4"]:
    """(centre u, centre v, width, height) of each instance's seen points, in image diagonals."""
    seen = rows[..., 2:] > 0
    low = np.where(seen, rows[..., :2], np.inf).min(1)
    high = np.where(seen, rows[..., :2], -np.inf).max(1)
    return np.concatenate([(low + high) / 2, high - low], axis=1) / np.hypot(*size)


def _score(
    rows: Float[np.ndarray, "m j 3"],
    boxes: Float[np.ndarray, "m 4"],
    size: tuple[int, int],
    mask: Integer[np.ndarray, "h w"] | None,
) -> Float[np.ndarray, "m"]:
    seen = rows[..., 2] > 0
    if mask is not None:
        column = np.clip(rows[..., 0].astype(int), 0, mask.shape[1] - 1)
        row = np.clip(rows[..., 1].astype(int), 0, mask.shape[0] - 1)
        inside = (mask[row, column] > 0) & seen
        return inside.sum(1) / np.maximum(seen.sum(1), 1) + 0.01 * inside.sum(1)
    return prominence(boxes, size)
