"""Image metrics: known differences come out, and the vehicle's know nothing of the background."""

import math

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from kronc_ns.metrics.images import ImageMetrics, frame_metrics, mean_metrics, vehicle_metrics


@pytest.fixture
def truth():
    return np.random.default_rng(0).random((48, 64, 3), dtype=np.float32)


@pytest.fixture
def rendered(truth):
    noise = np.random.default_rng(1).standard_normal(truth.shape, dtype=np.float32)
    return (truth + 0.1 * noise).clip(0, 1)


@pytest.fixture
def mask():
    mask = np.zeros((48, 64), dtype=bool)
    mask[20:34, 24:44] = True
    return mask


def similarity_map(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[h, w] SSIM of Wang et al. by scipy, mean over the channels."""

    def blur(image: np.ndarray) -> np.ndarray:
        return gaussian_filter(image, sigma=(1.5, 1.5, 0), mode="mirror", radius=(5, 5, 0))

    mu_x, mu_y = blur(x), blur(y)
    variances = blur(x * x) - mu_x**2 + blur(y * y) - mu_y**2
    covariance = blur(x * y) - mu_x * mu_y
    c1, c2 = 0.01**2, 0.03**2
    return ((2 * mu_x * mu_y + c1) * (2 * covariance + c2) / ((mu_x**2 + mu_y**2 + c1) * (variances + c2))).mean(-1)


def test_a_constant_difference_has_its_psnr(truth):
    metrics = frame_metrics(0.5 * truth + 0.1, 0.5 * truth)
    assert metrics.psnr == pytest.approx(20.0, abs=1e-4)
    assert metrics.lpips is None


def test_ssim_is_that_of_its_paper(rendered, truth, mask):
    expected = similarity_map(rendered.astype(np.float64), truth.astype(np.float64))
    assert frame_metrics(rendered, truth).ssim == pytest.approx(expected.mean(), abs=1e-5)
    assert vehicle_metrics(rendered, truth, mask).ssim == pytest.approx(expected[mask].mean(), abs=1e-5)


def test_equal_images_differ_in_nothing(truth, mask):
    for metrics in (frame_metrics(truth, truth), vehicle_metrics(truth, truth, mask)):
        assert (metrics.psnr, metrics.ssim, metrics.lpips) == (math.inf, pytest.approx(1.0), None)


def test_of_a_mask_of_the_whole_frame_the_vehicle_is_the_frame(rendered, truth):
    whole = vehicle_metrics(rendered, truth, np.ones((48, 64), dtype=bool))
    frame = frame_metrics(rendered, truth)
    assert (whole.psnr, whole.ssim) == (pytest.approx(frame.psnr), pytest.approx(frame.ssim))


def test_the_vehicle_knows_nothing_of_a_distant_background(rendered, truth, mask):
    far = np.ones((48, 64), dtype=bool)
    far[14:40, 18:50] = False  # outside the reach of any window on the vehicle
    other = np.where(far[..., None], 1 - truth, rendered)
    alone, kept = vehicle_metrics(other, truth, mask), vehicle_metrics(rendered, truth, mask)
    assert (alone.psnr, alone.ssim) == (pytest.approx(kept.psnr), pytest.approx(kept.ssim))
    assert frame_metrics(other, truth).psnr < frame_metrics(rendered, truth).psnr - 3


def test_lpips_sees_the_vehicle_on_white(rendered, truth, mask):
    seen = []

    def lpips(*images):
        seen.append(images)
        return 0.25

    assert frame_metrics(rendered, truth, lpips).lpips == 0.25
    assert vehicle_metrics(rendered, truth, mask, lpips).lpips == 0.25
    (frame, _), (vehicle, photo) = seen
    assert frame.shape == vehicle.shape == (1, 3, 48, 64)
    np.testing.assert_array_equal(np.moveaxis(frame[0], 0, -1), rendered)
    for image, source in ((vehicle, rendered), (photo, truth)):
        image = np.moveaxis(image[0], 0, -1)
        np.testing.assert_array_equal(image[mask], source[mask])
        assert (image[~mask] == 1).all()


def test_an_empty_mask_has_no_vehicle(rendered, truth, mask):
    assert vehicle_metrics(rendered, truth, np.zeros_like(mask)) is None


def test_means_are_of_decibels_and_need_every_lpips():
    images = [ImageMetrics(20.0, 0.8, 0.1), ImageMetrics(30.0, 0.9, 0.3)]
    mean = mean_metrics(images)
    assert (mean.psnr, mean.ssim, mean.lpips) == (25.0, pytest.approx(0.85), pytest.approx(0.2))
    assert mean_metrics([*images, ImageMetrics(40.0, 1.0, None)]).lpips is None
