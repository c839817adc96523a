"""What cannot be trained on, found before training starts. All raise `KroncError`."""

import math
from collections.abc import Sequence
from pathlib import Path

from kronc_ns.errors import KroncError
from kronc_ns.files.images import read_grey


def check_positive(**options: float | int) -> None:
    """Options that must be finite and above 0."""
    for name, value in options.items():
        if not (math.isfinite(value) and value > 0):
            raise KroncError(f"{name} is {value:g}: expected a finite number above 0")


def check_shares(**options: float) -> None:
    """Options that must lie between 0 and 1, both excluded."""
    for name, value in options.items():
        if not 0 < value < 1:
            raise KroncError(f"{name} is {value:g}: expected a number above 0 and below 1")


def check_not_negative(**options: int) -> None:
    """Options that must not be below 0."""
    for name, value in options.items():
        if value < 0:
            raise KroncError(f"{name} is {value}: expected 0 or more")


def check_masks(masks: Sequence[Path]) -> None:
    """At least one mask must leave something of its image."""
    if any(read_grey(path).any() for path in masks):
        return
    raise KroncError(
        f"all {len(masks)} masks are empty, {masks[0]} the first: expected the car not to be 0; give other masks, or "
        "--background keep to train on the full frames"
    )
