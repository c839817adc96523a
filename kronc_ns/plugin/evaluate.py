"""What `kronc eval --nvs` prints: a trained run judged by its test views."""

import math
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from kronc_ns.errors import KroncError
from kronc_ns.files.output import atomic_path
from kronc_ns.metrics.images import ImageMetrics, frame_metrics, mean_metrics, vehicle_metrics
from kronc_ns.plugin.trained import RenderedView, load_run

ERROR_LIMIT = 0.25
"""Difference from which on a picture of the error is brightest."""


def evaluate_run(
    config_file: Path, pictures: Path | None = None, progress: Callable[[int, int, float | None], None] | None = None
) -> dict[str, Any]:
    """Metrics of the full frame and of the vehicle (None without masks), means and per test view, for JSON.

    ``pictures`` is a new or empty folder for rendered | truth | error of each view. LPIPS is None without its
    weights, a PSNR that is infinite is too. Raises `KroncError` as `load_run` does, and where ``pictures`` is in use.
    """
    if pictures is not None and pictures.exists() and (not pictures.is_dir() or any(pictures.iterdir())):
        raise KroncError(f"{pictures} exists already: expected a new or empty folder for the pictures")
    with redirect_stdout(sys.stderr), warnings.catch_warnings():  # stdout is for the result
        warnings.simplefilter("ignore")  # of nerfstudio's use of torch; that LPIPS is missing, the result says itself
        run = load_run(config_file)
        full: list[ImageMetrics] = []
        masked: list[ImageMetrics | None] = []
        for i, view in enumerate(run.render()):
            full.append(frame_metrics(view.rendered, view.truth, run.lpips))
            on_vehicle = None if view.mask is None else vehicle_metrics(view.rendered, view.truth, view.mask, run.lpips)
            masked.append(on_vehicle)
            if pictures is not None:
                with atomic_path(pictures / f"{i:04d}_{view.image.stem}.png") as path:
                    Image.fromarray(_picture(view)).save(path, format="PNG")
            if progress is not None:
                progress(i + 1, len(run), None)
    return {
        "config": str(config_file),
        "method": run.method,
        "step": run.step,
        "views": len(run),
        **_means(full, masked),
        "images": [
            {"file_path": str(image), "full": _plain(whole), "masked": _plain(vehicle)}
            for image, whole, vehicle in zip(run.photos.image_filenames, full, masked, strict=True)
        ],
    }


def _means(full: Sequence[ImageMetrics], masked: Sequence[ImageMetrics | None]) -> dict[str, Any]:
    seen = [metrics for metrics in masked if metrics is not None]
    return {"full": _plain(mean_metrics(full)), "masked": _plain(mean_metrics(seen) if seen else None)}


def _plain(metrics: ImageMetrics | None) -> dict[str, float | None] | None:
    if metrics is None:
        return None
    return {name: None if value is None or math.isinf(value) else value for name, value in asdict(metrics).items()}


def _picture(view: RenderedView) -> UInt8[np.ndarray, "h w3 3"]:
    """Rendered, truth and their mean absolute difference over the channels, side by side."""
    import cv2

    rendered, truth = (np.rint(255 * image).astype(np.uint8) for image in (view.rendered, view.truth))
    error = np.abs(view.rendered - view.truth).mean(-1) / ERROR_LIMIT
    levels = (255 * error.clip(0, 1)).astype(np.uint8)
    shown = cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    return np.concatenate([rendered, truth, shown], axis=1)
