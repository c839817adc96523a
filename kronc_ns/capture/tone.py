"""Decoded video frames as 8-bit sRGB; high dynamic range (PQ, HLG) is mapped to what a display of today shows."""

from fractions import Fraction
from functools import cache

import av
import cv2
import numpy as np
from av.filter import Graph
from jaxtyping import Float, UInt8

_MATRICES = {1: "bt709", 4: "fcc", 5: "bt601", 6: "smpte170m", 7: "smpte240m", 9: "bt2020", 10: "bt2020"}
"""swscale's names of ITU-T H.273 matrix coefficients; what is not said is taken for BT.601, as ffmpeg does."""
_FULL_RANGE = 2
_PQ, _HLG = 16, 18  # ITU-T H.273 transfer characteristics
_WHITE_NITS = 203.0  # diffuse white of HDR (ITU-R BT.2408)
_PEAK_NITS = 1000.0  # what HLG is displayed at, and about what PQ is graded for
_KNEE = 0.8  # of diffuse white: up to here brightness is kept
_BT2020_TO_BT709 = np.array(
    [[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]],
    dtype=np.float32,
)
_ROWS = 256  # converted at a time, so that the memory of large frames stays bounded


def srgb(frame: av.VideoFrame, transfer: int | None) -> UInt8[np.ndarray, "h w 3"]:
    """The frame as stored (not turned upright); ``transfer`` is the video's transfer characteristic (H.273)."""
    if transfer not in (_PQ, _HLG):
        return _rgb(frame, "rgb24")
    deep = _rgb(frame, "rgb48le")
    light = (pq_light if transfer == _PQ else hlg_light)(np.linspace(0.0, 1.0, 1 << 16))
    out = np.empty(deep.shape, dtype=np.uint8)
    for row in range(0, len(deep), _ROWS):
        linear = light[deep[row : row + _ROWS]]
        out[row : row + _ROWS] = tone_map(linear if transfer == _PQ else hlg_display(linear))
    return out


def pq_light(signal: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Displayed light of a PQ signal in [0, 1] (SMPTE ST 2084), diffuse white being 1."""
    m1, m2, c1, c2, c3 = 2610 / 16384, 2523 / 32, 3424 / 4096, 2413 / 128, 2392 / 128
    root = signal ** (1 / m2)
    nits = 10_000 * (np.maximum(root - c1, 0) / (c2 - c3 * root)) ** (1 / m1)
    return (nits / _WHITE_NITS).astype(np.float32)


def hlg_light(signal: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Light in the scene, in [0, 1], of an HLG signal in [0, 1] (ITU-R BT.2100)."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12).astype(np.float32)


def hlg_display(scene: Float[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h w 3"]:
    """Displayed light of HLG's scene light at a system gamma of 1.2 (ITU-R BT.2100), diffuse white being 1."""
    luminance = scene @ np.array([0.2627, 0.6780, 0.0593], dtype=np.float32)
    return scene * (_PEAK_NITS / _WHITE_NITS * luminance**0.2)[..., None]


def tone_map(linear: Float[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """BT.2020 light (diffuse white 1) as sRGB: kept up to a knee, rolled off smoothly to the peak above it.

    The largest channel decides, so that bright colours keep their hue.
    """
    rgb = np.maximum(cv2.transform(linear, _BT2020_TO_BT709), 0)
    largest = rgb.max(axis=-1, keepdims=True)
    peak = (_PEAK_NITS / _WHITE_NITS - _KNEE) / (1 - _KNEE)
    above = np.maximum(largest - _KNEE, 0) / (1 - _KNEE)
    mapped = np.minimum(largest, _KNEE) + (1 - _KNEE) * above * (1 + above / peak**2) / (1 + above)
    rgb *= mapped / np.maximum(largest, 1e-6)
    return _srgb_codes()[np.rint(65535 * np.minimum(rgb, 1)).astype(np.uint16)]


@cache
def _srgb_codes() -> UInt8[np.ndarray, "65536"]:
    """8-bit codes of 16-bit linear light."""
    light = np.linspace(0.0, 1.0, 1 << 16)
    encoded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.rint(255 * encoded).astype(np.uint8)


def _rgb(frame: av.VideoFrame, pixels: str) -> np.ndarray:
    """The frame's signal as full-range RGB.

    By ffmpeg's own filter: PyAV's reformat of some versions overlooks the matrix or the range.
    """
    matrix = _MATRICES.get(int(frame.colorspace), "bt601")
    in_range = "pc" if int(frame.color_range) == _FULL_RANGE else "tv"
    graph = Graph()
    unit = frame.time_base or Fraction(1)
    source = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=unit)
    options = f"in_color_matrix={matrix}:in_range={in_range}:out_range=pc:flags=bicubic"
    steps = [source, graph.add("scale", options), graph.add("format", pixels), graph.add("buffersink")]
    graph.link_nodes(*steps).configure()
    source.push(frame)
    converted = steps[-1].pull()
    assert isinstance(converted, av.VideoFrame)
    return converted.to_ndarray()
