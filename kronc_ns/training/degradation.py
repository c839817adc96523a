"""What cameras and files do to pictures: light, colour, blur, noise, compression; nothing that moves a point."""

import cv2
import numpy as np
from jaxtyping import UInt8


def degrade(rgb: UInt8[np.ndarray, "h w 3"], rng: np.random.Generator) -> UInt8[np.ndarray, "h w 3"]:
    """Clean studio photos to bad phone videos; mostly mild."""
    strength = float(rng.choice([0.35, 1.0, 2.0], p=[0.4, 0.45, 0.15]))
    out = _tones(rgb, rng, strength)
    if rng.uniform() < 0.12 * strength:
        out = _glare(out, rng)
    if rng.uniform() < 0.1 * strength:
        out = _vignetted(out, rng)
    if rng.uniform() < 0.3 * strength:
        out = _blurred(out, rng, strength)
    if rng.uniform() < 0.25 * strength:
        out = _coarse(out, rng)
    if rng.uniform() < 0.35 * strength:
        out = _noisy(out, rng, strength)
    if rng.uniform() < 0.12:
        soft = cv2.GaussianBlur(out, (0, 0), float(rng.uniform(0.7, 1.6)))
        out = cv2.addWeighted(out, 1 + (more := float(rng.uniform(0.3, 1.4))), soft, -more, 0)
    if rng.uniform() < 0.5:
        quality = int(np.clip(rng.normal(88 - 22 * strength, 15), 14, 96))
        out = cv2.imdecode(cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR)
    return out


def _tones(rgb: np.ndarray, rng: np.random.Generator, strength: float) -> np.ndarray:
    """Exposure, contrast, gamma and white balance by a table for each channel; saturation; grey now and then."""
    level = np.linspace(0, 1, 256)
    gamma = np.exp(rng.normal(0, 0.18 * strength))
    contrast, shift = np.exp(rng.normal(0, 0.14 * strength)), rng.normal(0, 0.05 * strength)
    gain = np.exp(rng.normal(0, 0.12 * strength)) * np.exp(rng.normal(0, 0.045 * strength, 3))
    if rng.uniform() < 0.03 * strength:  # night
        gain = gain * rng.uniform(0.12, 0.5)
    curves = ((level**gamma - 0.5) * contrast + 0.5 + shift)[:, None] * gain
    table = (255 * np.clip(curves, 0, 1)).astype(np.uint8)
    out = cv2.LUT(rgb, table[:, None, :])
    if rng.uniform() < 0.05:
        return cv2.cvtColor(cv2.cvtColor(out, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    saturation = float(np.clip(np.exp(rng.normal(0, 0.25 * strength)), 0.1, 2.2))
    mix = saturation * np.eye(3) + (1 - saturation) * np.array([0.299, 0.587, 0.114])
    if rng.uniform() < 0.25:  # hue: paint and surroundings in colours that nobody drew
        angle = rng.normal(0, 0.35 * strength)
        grey = np.full((3, 3), 1 / 3)
        cross = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / 3**0.5
        mix = mix @ (grey + np.cos(angle) * (np.eye(3) - grey) + np.sin(angle) * cross)
    return cv2.transform(out, mix)


def _glare(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Haze over all, or a bright spot."""
    height, width = rgb.shape[:2]
    if rng.uniform() < 0.4:
        return cv2.addWeighted(
            rgb, much := float(rng.uniform(0.55, 0.9)), rgb, 0, 255 * (1 - much) * rng.uniform(0.4, 1)
        )
    spot = np.zeros((height // 8, width // 8), np.float32)
    at = (int(rng.integers(width // 8)), int(rng.integers(height // 8)))
    cv2.circle(spot, at, int(rng.integers(1, 5)), (1.0,), -1)
    spot = cv2.GaussianBlur(spot, (0, 0), float(rng.uniform(1, 5)))
    spot = cv2.resize(spot / max(float(spot.max()), 1e-6), (width, height)) * rng.uniform(40, 200)
    return np.clip(rgb + spot[..., None], 0, 255).astype(np.uint8)


def _vignetted(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Darker away from the middle, about as the fourth power of a cosine."""
    height, width = rgb.shape[:2]
    row, column = np.ogrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    share = (1 / (1 + rng.uniform(0.1, 0.6) * (row**2 + column**2) / 2) ** 2).astype(np.float32)
    return (rgb * share[..., None]).astype(np.uint8)


def _blurred(rgb: np.ndarray, rng: np.random.Generator, strength: float) -> np.ndarray:
    """Defocus, or a movement of the camera along a line."""
    if rng.uniform() < 0.5:
        return cv2.GaussianBlur(rgb, (0, 0), float(rng.uniform(0.5, 0.7 + 0.8 * strength)))
    length = rng.uniform(2, 3 + 4 * strength)
    size = 2 * int(np.ceil(length / 2)) + 1
    kernel = np.zeros((size, size), np.float32)
    angle, middle = rng.uniform(0, np.pi), size // 2
    reach = np.array([np.cos(angle), np.sin(angle)]) * length / 2
    ends = [tuple(int(v) for v in np.round(16 * (middle + sign * reach))) for sign in (-1, 1)]
    cv2.line(kernel, ends[0], ends[1], (1.0,), 1, cv2.LINE_AA, 4)
    kernel = kernel + kernel[::-1, ::-1]  # centred: the place of a point does not move
    return cv2.filter2D(rgb, -1, kernel / kernel.sum())


def _coarse(rgb: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Through a smaller picture and back."""
    height, width = rgb.shape[:2]
    factor = rng.uniform(0.4, 0.9)
    small = cv2.resize(rgb, (round(width * factor), round(height * factor)), interpolation=cv2.INTER_AREA)
    return cv2.resize(small, (width, height), interpolation=int(rng.choice([cv2.INTER_LINEAR, cv2.INTER_CUBIC])))


def _noisy(rgb: np.ndarray, rng: np.random.Generator, strength: float) -> np.ndarray:
    """Shot and read noise, at times as coarse as a video's."""
    height, width = rgb.shape[:2]
    cell = int(rng.choice([1, 1, 2]))
    noise = rng.standard_normal((height // cell, width // cell, 3 if rng.uniform() < 0.5 else 1), dtype=np.float32)
    noise = cv2.resize(noise, (width, height)).reshape(height, width, -1)
    level = rgb.astype(np.float32)
    scale = rng.uniform(1, 4 + 6 * strength) * np.sqrt(0.3 + level / 255)
    return np.clip(level + scale * noise, 0, 255).astype(np.uint8)
