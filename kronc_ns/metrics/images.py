"""How near a rendered view is to its photo: PSNR, SSIM and LPIPS of the full frame and of the vehicle alone.

Images are [h, w, 3] in [0, 1]; a mask is True on the vehicle.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

Lpips = Callable[[Float[Tensor, "1 3 h w"], Float[Tensor, "1 3 h w"]], Tensor]
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
    rendered: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], lpips: Lpips | None = None
) -> ImageMetrics:
    """Metrics of the full frame, the same for every method (nerfstudio's methods compute SSIM in different ways)."""
    psnr = peak_signal_noise_ratio(rendered, truth, data_range=1.0)
    ssim = structural_similarity_index_measure(_batch(rendered), _batch(truth), data_range=1.0)
    assert isinstance(ssim, Tensor)
    distance = None if lpips is None else float(lpips(_batch(rendered), _batch(truth)))
    return ImageMetrics(float(psnr), float(ssim), distance)


def vehicle_metrics(
    rendered: Float[Tensor, "h w 3"],
    truth: Float[Tensor, "h w 3"],
    mask: Bool[Tensor, "h w"],
    lpips: Lpips | None = None,
) -> ImageMetrics | None:
    """Metrics of the vehicle's pixels alone; None where the mask is empty.

    PSNR is that of the mean squared error over the mask's pixels. SSIM is the mean over them of its map, whose windows
    reach over the rim as the images are there. LPIPS is that of the whole frames with the background of both white.
    """
    if not mask.any():
        return None
    psnr = peak_signal_noise_ratio(rendered[mask], truth[mask], data_range=1.0)
    _, similarity = structural_similarity_index_measure(
        _batch(rendered), _batch(truth), data_range=1.0, return_full_image=True
    )
    distance = None
    if lpips is not None:
        alone = [_batch(torch.where(mask[..., None], image, 1.0)) for image in (rendered, truth)]
        distance = float(lpips(*alone))
    return ImageMetrics(float(psnr), float(similarity[0].mean(0)[mask].mean()), distance)


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


def _batch(image: Float[Tensor, "h w 3"]) -> Float[Tensor, "1 3 h w"]:
    return image.movedim(-1, 0)[None]
