"""What stands before and behind a car: other cars, posts, people, plants, lettering."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from kronc_ns.training.shards import Picture


def colour(rng: np.random.Generator) -> tuple[int, int, int]:
    """Any; greys more often."""
    grey = rng.integers(0, 256)
    mixed = rng.uniform() * rng.integers(0, 256, 3) if rng.uniform() < 0.5 else np.full(3, grey)
    return int(mixed[0]), int(mixed[1]), int(mixed[2])


def cover(
    rgb: UInt8[np.ndarray, "h w 3"], box: Float[np.ndarray, "4"], rng: np.random.Generator
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """Something before the car in ``box`` (left, top, right, bottom); the picture, and 255 where it covers."""
    height, width = rgb.shape[:2]
    hidden = np.zeros((height, width), np.uint8)
    left, top, right, bottom = box
    span = max(right - left, 8.0)
    kind = rng.choice(["post", "person", "plant", "block"])
    x, y = rng.uniform(left, right), rng.uniform(top, bottom)
    if kind == "post":
        lean = rng.normal(0, 0.05) * height
        ends = (round(x), -5), (round(x + lean), round(rng.uniform(bottom, height + 20)))
        cv2.line(hidden, *ends, (255,), max(1, round(rng.uniform(0.01, 0.07) * span)), cv2.LINE_AA)
    elif kind == "person":
        tall = rng.uniform(0.25, 0.6) * span
        foot = bottom + rng.uniform(0, 0.1) * span
        cv2.ellipse(
            hidden,
            (round(x), round(foot - 0.45 * tall)),
            (round(0.13 * tall), round(0.38 * tall)),
            0,
            0,
            360,
            (255,),
            -1,
        )
        cv2.circle(hidden, (round(x), round(foot - 0.9 * tall)), round(0.08 * tall), (255,), -1)
        for sign in (-1, 1):
            knee = (round(x + sign * 0.07 * tall), round(foot))
            cv2.line(hidden, (round(x), round(foot - 0.3 * tall)), knee, (255,), max(1, round(0.08 * tall)))
    elif kind == "plant":
        for _ in range(int(rng.integers(10, 60))):
            at = round(x + rng.normal(0, 0.08) * span), round(bottom + rng.normal(0, 0.08) * span)
            cv2.circle(hidden, at, max(1, round(rng.uniform(0.005, 0.03) * span)), (255,), -1)
    else:
        half = rng.uniform(0.02, 0.12, 2) * span
        corners = cv2.boxPoints(
            ((float(x), float(y)), (float(2 * half[0]), float(2 * half[1])), float(rng.uniform(0, 90)))
        )
        cv2.fillConvexPoly(hidden, np.round(corners).astype(np.int32), (255,))
    low, high = np.array(colour(rng), np.float32), np.array(colour(rng), np.float32)
    grain = cv2.resize(rng.uniform(0, 1, (12, 16)).astype(np.float32), (width, height))[..., None]
    share = cv2.GaussianBlur(hidden, (3, 3), 0)[..., None].astype(np.float32) / 255
    out = rgb * (1 - share) + share * (low + grain * (high - low))
    return out.astype(np.uint8), hidden


def watermark(rgb: UInt8[np.ndarray, "h w 3"], rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """Lettering that one sees the picture through: it hides nothing."""
    height, width = rgb.shape[:2]
    over = rgb.copy()
    words = "".join(chr(int(c)) for c in rng.integers(65, 91, int(rng.integers(4, 14))))
    font, size, shade = int(rng.integers(0, 8)), float(rng.uniform(0.4, 1.6)), colour(rng)
    start, step = rng.integers([-40, 10], [width // 2, height]), int(rng.integers(40, 200))
    for line in range(int(rng.integers(1, 5))):
        at = int(start[0]), int(start[1] + line * step) % (height + 20)
        cv2.putText(over, words, at, font, size, shade, int(rng.integers(1, 3)), cv2.LINE_AA)
    share = float(rng.uniform(0.2, 0.6))
    return cv2.addWeighted(over, share, rgb, 1 - share, 0)


def beside(
    rgb: UInt8[np.ndarray, "h w 3"],
    mask: UInt8[np.ndarray, "h w"],
    other: Picture,
    before: bool,
    rng: np.random.Generator,
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """Another car, smaller than the one of ``mask`` and behind it (or before its edge); the picture, what it covers."""
    rows, columns = np.nonzero(other.mask[::2, ::2])
    mine = np.nonzero(mask.any(0))[0]
    if len(rows) < 50 or len(mine) < 2:
        return rgb, np.zeros_like(mask)
    height, width = mask.shape
    wide = 2 * np.ptp(columns) + 2
    scale = rng.uniform(0.25, 0.75) * np.ptp(mine) / wide
    middle = np.array([2 * columns.mean(), 2 * rows.mean()])
    span = float(np.ptp(mine))
    sign = rng.choice([-1.0, 1.0])
    if before:
        target = np.array(
            [(mine[0] + mine[-1]) / 2 + sign * (0.5 * span + 0.25 * wide * scale), rng.uniform(0.4, 0.9) * height]
        )
    else:
        target = np.array(
            [(mine[0] + mine[-1]) / 2 + sign * rng.uniform(0.2, 1.0) * span, rng.uniform(0.2, 0.7) * height]
        )
    matrix = np.array([[scale, 0, target[0] - scale * middle[0]], [0, scale, target[1] - scale * middle[1]]])
    cut = cv2.warpAffine(other.mask, matrix, (width, height), flags=cv2.INTER_LINEAR)
    drawn = cv2.warpAffine(other.rgb, matrix, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    share = cut.astype(np.float32) / 255
    if not before:
        share = share * (1 - mask.astype(np.float32) / 255)
    out = rgb * (1 - share[..., None]) + drawn * share[..., None]
    return out.astype(np.uint8), cut if before else np.zeros_like(mask)


def backdrop(size: tuple[int, int], others: Sequence[Picture], rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """A background of (width, height) without the main car: plain, a gradient, noise, a piece of another picture."""
    width, height = size
    kind = rng.choice(["white", "plain", "gradient", "noise", "piece"], p=[0.35, 0.2, 0.15, 0.1, 0.2])
    if kind == "white":
        return np.full((height, width, 3), int(rng.integers(235, 256)), np.uint8)
    if kind == "plain":
        return np.full((height, width, 3), colour(rng), np.uint8)
    if kind == "piece" and others:
        other = others[int(rng.integers(len(others)))].rgb
        rows, columns = rng.integers(20, 120), rng.integers(30, 200)
        corner = rng.integers([0, 0], [other.shape[0] - rows, other.shape[1] - columns])
        piece = other[corner[0] : corner[0] + rows, corner[1] : corner[1] + columns]
        return cv2.resize(piece, size, interpolation=cv2.INTER_LINEAR)
    cells = (2, 2) if kind == "gradient" else tuple(int(v) for v in rng.integers(3, 60, 2))
    coarse = rng.integers(0, 256, (*cells, 3)).astype(np.uint8)
    if rng.uniform() < 0.5:
        coarse[...] = coarse[..., :1]
    return cv2.resize(
        coarse, size, interpolation=int(rng.choice([cv2.INTER_LINEAR, cv2.INTER_NEAREST, cv2.INTER_CUBIC]))
    )


def clutter(rgb: UInt8[np.ndarray, "h w 3"], count: int, rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """Lines, boxes, discs, lettering: what is no car."""
    height, width = rgb.shape[:2]
    out = rgb.copy()
    for _ in range(count):
        a, b = ((int(rng.integers(-20, width + 20)), int(rng.integers(-20, height + 20))) for _ in range(2))
        thick = int(rng.choice([-1, 1, 2, 5]))
        kind = int(rng.integers(5))
        if kind == 0:
            cv2.rectangle(out, a, b, colour(rng), thick, cv2.LINE_AA)
        elif kind == 1:
            cv2.circle(out, a, int(rng.integers(2, 60)), colour(rng), thick, cv2.LINE_AA)
        elif kind == 2:
            cv2.line(out, a, b, colour(rng), abs(thick), cv2.LINE_AA)
        elif kind == 3:
            axes = int(rng.integers(3, 80)), int(rng.integers(3, 50))
            cv2.ellipse(out, a, axes, float(rng.uniform(0, 180)), 0, 360, colour(rng), thick, cv2.LINE_AA)
        else:
            words = "".join(chr(int(c)) for c in rng.integers(65, 91, int(rng.integers(2, 9))))
            cv2.putText(
                out, words, a, int(rng.integers(0, 8)), float(rng.uniform(0.3, 1.5)), colour(rng), 1, cv2.LINE_AA
            )
    return out
