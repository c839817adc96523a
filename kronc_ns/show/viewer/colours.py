"""What the colours mean: Okabe and Ito's palette and cividis, which colour-blind readers can tell apart."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8
from markupsafe import escape

from kronc_ns.keypoints.schema import KeypointSchema
from kronc_ns.solution import ViewReport, ViewStatus

Colour = tuple[int, int, int]

SELECTED: Colour = (204, 121, 167)
ODD: Colour = (213, 94, 0)
"""Detections that are not explained."""
NEUTRAL: Colour = (140, 140, 140)
_LEFT: Colour = (0, 114, 178)
_RIGHT: Colour = (213, 94, 0)
_MIDDLE: Colour = (0, 158, 115)
_WIDTH = 390
_COMPLETED: Colour = (230, 159, 0)
_SOLVED: dict[bool, Colour] = {False: (0, 114, 178), True: (86, 180, 233)}
"""On light and on dark ground, as the next."""
_CIVIDIS = {False: (0, 210), True: (60, 255)}
"""The part of the scale that stands out from the ground."""


def by_status(views: Sequence[ViewReport], dark: bool) -> UInt8[np.ndarray, "n 3"]:
    """Solved views in blue, completed ones in orange."""
    return np.array([_SOLVED[dark] if view.status is ViewStatus.SOLVED else _COMPLETED for view in views], np.uint8)


def by_residual(views: Sequence[ViewReport], dark: bool) -> UInt8[np.ndarray, "n 3"]:
    """From the least to the largest RMSE along cividis; grey where a view has none."""
    error = np.array([np.nan if view.rmse_px is None else view.rmse_px for view in views])
    if np.isnan(error).all():
        return np.full((len(views), 3), NEUTRAL, np.uint8)
    low, high = np.nanmin(error), np.nanmax(error)
    share = (error - low) / max(high - low, 1e-9)
    colours = _scale(np.nan_to_num(share), dark)
    return np.where(np.isnan(error)[:, None], np.array(NEUTRAL, np.uint8), colours)


def status_legend(views: Sequence[ViewReport], dark: bool) -> str:
    """SVG that says which colour is which status, with the number of views."""
    drawn = ((ViewStatus.SOLVED, _SOLVED[dark]), (ViewStatus.COMPLETED, _COMPLETED))
    count = {status: sum(view.status is status for view in views) for status, _ in drawn}
    shown = [(colour, f"{status.value}: {count[status]}") for status, colour in drawn if count[status]]
    return _swatches([*shown, (SELECTED, "selected")], dark)


def residual_legend(views: Sequence[ViewReport], dark: bool) -> str:
    """SVG of the scale with its ends in pixels."""
    error = [view.rmse_px for view in views if view.rmse_px is not None]
    if not error:
        return _swatches([(NEUTRAL, "no view has a residual")], dark)
    colours = _scale(np.linspace(0, 1, 60), dark).tolist()
    bars = "".join(
        f'<rect x="{10 + 6 * i}" width="7" height="14" fill="rgb{tuple(c)}"/>' for i, c in enumerate(colours)
    )
    texts = (
        f'<text x="10" y="30">{min(error):.2f} px</text>'
        f'<text x="{_WIDTH // 2}" y="30" text-anchor="middle">RMSE of a view</text>'
        f'<text x="{_WIDTH - 18}" y="30" text-anchor="end">{max(error):.2f} px</text>'
    )
    return _svg(36, bars + texts, dark)


def by_side(schema: KeypointSchema) -> list[Colour]:
    """Colour of each keypoint: on the object's left, its right, or neither."""
    left, right = set(schema.left), {schema.flip[j] for j in schema.left}
    return [_LEFT if j in left else _RIGHT if j in right else _MIDDLE for j in range(len(schema))]


def side_legend(schema: KeypointSchema, dark: bool) -> str:
    """SVG of the keypoints' colours."""
    used = set(by_side(schema))
    sides = ((_LEFT, "car's left"), (_RIGHT, "car's right"), (_MIDDLE, "keypoint"))
    return _swatches([(colour, text) for colour, text in sides if colour in used], dark)


def _swatches(shown: Sequence[tuple[Colour, str]], dark: bool) -> str:
    parts = [
        f'<rect x="{10 + 125 * i}" y="3" width="14" height="14" rx="3" fill="rgb{colour}"/>'
        f'<text x="{30 + 125 * i}" y="15">{escape(text)}</text>'
        for i, (colour, text) in enumerate(shown)
    ]
    return _svg(20, "".join(parts), dark)


def _svg(height: int, content: str, dark: bool) -> str:
    style = f'font-family="sans-serif" font-size="13" fill="{"#c1c2c5" if dark else "#333333"}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" {style}>{content}</svg>'


def _scale(share: np.ndarray, dark: bool) -> UInt8[np.ndarray, "n 3"]:
    low, high = _CIVIDIS[dark]
    level = np.round(low + (high - low) * share).astype(np.uint8)[:, None]
    return cv2.applyColorMap(level, cv2.COLORMAP_CIVIDIS)[:, 0, ::-1]
