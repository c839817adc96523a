"""Figures: what poses are off by, by name; units are suffixes of the names."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from kronc_ns.geometry.poses import posed
from kronc_ns.metrics.poses import AUC_LIMITS_DEG, evaluate_poses

Figures = Mapping[str, float]
"""What one run gave, by name."""


def pose_figures(c2w: Float[np.ndarray, "n 3 4"], truth: Float[np.ndarray, "n 3 4"]) -> dict[str, float]:
    """Errors after a similarity alignment (mean, median and worst view), recall, and the share of views with a pose.

    Fewer than three views with a pose have no errors (NaN) and a recall of 0.
    """
    found = posed(c2w)
    share = {"registered": float(found.mean())}
    if found.sum() < 3:
        missing = ("rotation_deg", "median_deg", "worst_deg", "centre_cm", "median_cm", "worst_cm")
        return {**dict.fromkeys(missing, math.nan), **{f"auc_{x}": 0.0 for x in AUC_LIMITS_DEG}, **share}
    errors = evaluate_poses(
        {str(i): c2w[i] for i in np.flatnonzero(found)}, {str(i): pose for i, pose in enumerate(truth)}
    ).as_dict()
    rotation, centre = errors["rotation_deg"], errors["translation"]
    return {
        "rotation_deg": rotation["mean"],
        "median_deg": rotation["median"],
        "worst_deg": rotation["max"],
        "centre_cm": 100 * centre["mean"],
        "median_cm": 100 * centre["median"],
        "worst_cm": 100 * centre["max"],
        **{f"auc_{x}": errors[f"auc_{x}deg"] for x in AUC_LIMITS_DEG},
        **share,
    }


def plain(value: Any) -> Any:
    """Lists, dicts and numbers for JSON, which has no infinities: what is not finite becomes None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
