"""How near a rendered view is to its photo: PSNR, SSIM and LPIPS of the full frame and of the vehicle alone.

Images are [h, w, 3] in [0, 1]; a mask is True on the vehicle.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

Lpips = Callable[[Float32[np.ndarray, "1 3 h w"], Float32[np.ndarray, "1 3 h w"]], float]
"""Learned perceptual distance of two images in [0, 1], with genuine weights (Zhang et al. 2018)."""


@dataclass(frozen=True)
class ImageMetrics:
    """Metrics of one image, or means over several."""

    psnr: float
    """Peak signal-to-noise ratio in dB; infinite where nothing differs."""
    ssim: float
    """Structural similarity (Wang et al. 2004): Gaussian window of 11 px with sigma 1.5, mean over the channels."""
    lpips: float | None
    """Perceptual distance, smaller is better; None without its weights."""


def frame_metrics(
    rendered: Float[np.ndarray, "h w 3"], truth: Float[np.ndarray, "h w 3"], lpips: Lpips | None = None
) -> ImageMetrics:
    """Metrics of the full frame, the same for every method (nerfstudio's methods compute SSIM in different ways)."""
    distance = None if lpips is None else lpips(_batch(rendered), _batch(truth))
    return ImageMetrics(_psnr(rendered, truth), float(_similarity(rendered, truth).mean()), distance)


def vehicle_metrics(
    rendered: Float[np.ndarray, "h w 3"],
    truth: Float[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"],
    lpips: Lpips | None = None,
) -> ImageMetrics | None:
    """Metrics of the vehicle's pixels alone; None where the mask is empty.

    PSNR is that of the mean squared error over the mask's pixels. SSIM is the mean over them of its map, whose windows
    reach over the rim as the images are there. LPIPS is that of the whole frames with the background of both white.
    """
    if not mask.any():
        return None
    distance = None
    if lpips is not None:
        distance = lpips(*(_batch(np.where(mask[..., None], image, 1)) for image in (rendered, truth)))
    similarity = float(_similarity(rendered, truth)[mask].mean())
    return ImageMetrics(_psnr(rendered[mask], truth[mask]), similarity, distance)


def mean_metrics(images: Sequence[ImageMetrics]) -> ImageMetrics:
    """Means over one or more images, of PSNR in dB as is the custom."""

    def mean(values: list[float]) -> float:
        return sum(values) / len(values)

    distances = [image.lpips for image in images if image.lpips is not None]
    return ImageMetrics(
        mean([image.psnr for image in images]),
        mean([image.ssim for image in images]),
        mean(distances) if len(distances) == len(images) else None,
    )


def _psnr(rendered: Float[np.ndarray, "*b 3"], truth: Float[np.ndarray, "*b 3"]) -> float:
    with np.errstate(divide="ignore"):
        return float(-10 * np.log10(np.square(rendered - truth, dtype=np.float64).mean()))


def _similarity(rendered: Float[np.ndarray, "h w 3"], truth: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w"]:
    """SSIM of the window about each pixel, mean over the channels."""
    import torch
    from torchmetrics.functional.image import structural_similarity_index_measure

    x, y = (torch.from_numpy(_batch(image)) for image in (rendered, truth))
    _, similarity = structural_similarity_index_measure(x, y, data_range=1.0, return_full_image=True)
    return similarity[0].mean(0).numpy()


def _batch(image: Float[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "1 3 h w"]:
    return np.ascontiguousarray(np.moveaxis(image, -1, 0)[None], dtype=np.float32)
