"""What surrounds a rendered car: light, reflections, ground and backdrop.

Light comes from panoramas of linear radiance: row 0 is up, the column grows with atan2(y, x) from -pi.
"""

import base64
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from jaxtyping import Float32

from kronc_ns.errors import KroncError

Panorama: TypeAlias = Float32[np.ndarray, "_ _ 3"]
_HEIGHT, _WIDTH = 512, 1024
_SUN = 300.0  # the most that is read of a map
_BRIGHTEST = 30.0  # times the mean: suns are lights of their own, below


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Where a car stands."""

    sharp: Panorama
    """Seen in clear coat and glass, and as the background."""
    glossy: Panorama
    rough: Panorama
    diffuse: Panorama
    """Mean radiance over the hemisphere around each direction, weighted by the cosine."""
    sun: Float32[np.ndarray, "3"]
    """Direction to it."""
    sun_rgb: Float32[np.ndarray, "3"]
    """Radiance that a white surface facing it sends back; 0 where there is none."""
    ground: Float32[np.ndarray, "g g 3"]
    """Albedo, tiled over the plane z = 0."""
    ground_m: float
    """Side of a tile."""
    ground_radius_m: float
    """Beyond, the panorama shows."""
    backdrop: Float32[np.ndarray, "3"] | None
    """The colour (0 to 1, as displayed) of a car that was cut out; None: the surroundings show."""
    shadow: float
    """How much of the car's shadow there is on the ground, 0 to 1."""
    exposure: float
    """Of a grey card: what it looks like, 0 to 1."""


def read_panoramas(folder: Path) -> list[Panorama]:
    """High dynamic range maps: .exr and .hdr files, or EXR data in .js modules as npm packages carry them."""
    files = sorted(f for f in folder.rglob("*") if f.suffix in (".exr", ".hdr") or f.name.endswith(".exr.js"))
    if not files:
        raise KroncError(f"{folder} holds no .exr, .hdr or .exr.js file: expected high dynamic range panoramas")
    return [_read(file) for file in files]


def _read(file: Path) -> Panorama:
    data = file.read_bytes()
    if file.suffix == ".js":
        found = re.search(rb"base64,([A-Za-z0-9+/=]+)", data)
        if found is None:
            raise KroncError(f"{file} holds no base64 data: expected an EXR file in a module")
        data = base64.b64decode(found.group(1))
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise KroncError(f"{file} cannot be decoded: set OPENCV_IO_ENABLE_OPENEXR=1 before Python starts")
    larger = image.shape[1] < _WIDTH
    # some maps' suns are of one primary colour alone
    image = np.clip(np.maximum(image[..., 2::-1], image[..., :3].max(2, keepdims=True) / 12), 0, _SUN)
    root = np.sqrt(image).astype(np.float32)  # else lamps leave no half tones at their edges
    return cv2.resize(root, (_WIDTH, _HEIGHT), interpolation=cv2.INTER_LINEAR if larger else cv2.INTER_AREA) ** 2


def draw_surroundings(rng: np.random.Generator, panoramas: Sequence[Panorama]) -> Surroundings:
    """A studio, a hall, a street or a park, at any time of the day."""
    kind = rng.choice(["cutout", "studio", "map", "outdoor"], p=[0.18, 0.17, 0.3, 0.35])
    plain = kind in ("cutout", "studio")
    mapped = bool(panoramas) and (kind == "map" or (plain and rng.uniform() < 0.4))
    radiance = panoramas[int(rng.integers(len(panoramas)))] if mapped else _studio(rng) if plain else _outdoors(rng)
    radiance = np.roll(radiance, int(rng.integers(_WIDTH)), axis=1)
    radiance = radiance / max(float(radiance.mean()), 1e-6)
    sun, sun_rgb, radiance = _take_sun(radiance, rng)
    # cameras take most of the light's colour out
    grey = _irradiance(radiance)[0].mean(0) + max(float(sun[2]), 0.0) * sun_rgb
    balance = (grey / grey.mean()) ** np.float32(-rng.uniform(0.4, 1.0))
    radiance, sun_rgb = radiance * balance, sun_rgb * balance
    backdrop = None
    if kind == "cutout":
        shade = 1.0 if rng.uniform() < 0.6 else rng.uniform(0, 1)
        backdrop = np.full(3, shade, np.float32) if rng.uniform() < 0.8 else rng.uniform(0, 1, 3).astype(np.float32)
    return Surroundings(
        radiance,
        _blurred(radiance, 8, 3.0),
        _blurred(radiance, 16, 9.0),
        _irradiance(radiance),
        sun,
        sun_rgb,
        _ground(rng, plain),
        float(rng.uniform(1.5, 8.0)),
        float(rng.uniform(8, 40)),
        backdrop,
        float(rng.uniform(0.3, 1.0) if kind != "cutout" else rng.choice([0.0, rng.uniform(0.2, 0.9)])),
        float(np.clip(rng.normal(0.46, 0.09), 0.18, 0.75)),
    )


def _take_sun(radiance: Panorama, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, Panorama]:
    """The brightest direction as a light that casts shadows, where it outshines the rest; and the rest."""
    small = cv2.resize(radiance, (_WIDTH // 4, _HEIGHT // 4), interpolation=cv2.INTER_AREA)
    bright = cv2.GaussianBlur(small.mean(2), (0, 0), 1.5)
    row, column = np.unravel_index(int(bright[: _HEIGHT // 8].argmax()), (_HEIGHT // 8, _WIDTH // 4))
    polar, azimuth = np.pi * (row + 0.5) / (_HEIGHT // 4), 2 * np.pi * ((column + 0.5) / (_WIDTH // 4) - 0.5)
    sun = np.array([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], np.float32)
    strength = rng.uniform(0.8, 3.5) if bright[row, column] > 8 and sun[2] > 0.08 else 0.0
    tint = small[row, column] / max(float(small[row, column].mean()), 1e-6)
    return sun, (strength * np.clip(tint, 0.6, 1.4)).astype(np.float32), np.minimum(radiance, _BRIGHTEST)


def _blurred(radiance: Panorama, shrink: int, spread: float) -> Panorama:
    small = cv2.resize(radiance, (_WIDTH // shrink, _HEIGHT // shrink), interpolation=cv2.INTER_AREA)
    wrapped = np.concatenate([small, small, small], axis=1)
    blurred = cv2.GaussianBlur(wrapped, (0, 0), spread * 8 / shrink)
    return np.ascontiguousarray(blurred[:, small.shape[1] : 2 * small.shape[1]])


def _irradiance(radiance: Panorama) -> Panorama:
    small = cv2.resize(radiance, (32, 16), interpolation=cv2.INTER_AREA)
    return (_hemispheres() @ small.reshape(-1, 3)).reshape(16, 32, 3).astype(np.float32)


@lru_cache(maxsize=1)
def _hemispheres() -> Float32[np.ndarray, "512 512"]:
    """What each cell of a panorama of 16 rows gets from each other."""
    polar = np.pi * (np.arange(16) + 0.5) / 16
    azimuth = 2 * np.pi * ((np.arange(32) + 0.5) / 32 - 0.5)
    across = np.sin(polar)[:, None]
    up = np.broadcast_to(np.cos(polar)[:, None], (16, 32))
    direction = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), up], -1).reshape(-1, 3)
    share = np.clip(direction @ direction.T, 0, None) * np.repeat(np.sin(polar), 32)
    return (share / share.sum(1, keepdims=True)).astype(np.float32)


def smooth_noise(rng: np.random.Generator, height: int, width: int, cells: int) -> Float32[np.ndarray, "h w"]:
    """Random values with a standard deviation of 1 that vary over ``cells`` cells of the width."""
    rows = max(2, round(cells * height / width))
    coarse = rng.standard_normal((rows, max(2, cells)), dtype=np.float32)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.float32)


def _studio(rng: np.random.Generator) -> Panorama:
    """Walls of one colour, soft boxes above and beside, a floor that may end in an edge."""
    wall = rng.uniform(0.15, 1.0) * np.ones(3) * rng.uniform(0.93, 1.07, 3)
    image = np.empty((_HEIGHT, _WIDTH, 3), np.float32)
    image[:] = wall
    image *= np.linspace(rng.uniform(0.6, 1.6), rng.uniform(0.6, 1.4), _HEIGHT, dtype=np.float32)[:, None, None]
    for _ in range(int(rng.integers(1, 7))):
        row, column = int(rng.integers(0, 240)), int(rng.integers(0, _WIDTH))
        height, width = int(rng.integers(10, 100)), int(rng.integers(20, 320))
        image[row : row + height, column : column + width] = rng.uniform(2, 9)
    for _ in range(int(rng.integers(0, 8))):  # things that stand around
        column, width, top = int(rng.integers(0, _WIDTH)), int(rng.integers(4, 120)), int(rng.integers(180, 280))
        image[top:300, column : column + width] = rng.uniform(0.05, 1.0) * rng.uniform(0.8, 1.2, 3)
    image[int(rng.integers(256, 300)) :] *= rng.uniform(0.4, 1.3)
    return cv2.GaussianBlur(image, (0, 0), rng.uniform(0.7, 3.0))


def _outdoors(rng: np.random.Generator) -> Panorama:
    """Sky with clouds, a sun at times, a skyline of houses, trees, posts and other cars; more or less out of focus."""
    horizon = _HEIGHT // 2
    up = np.linspace(1, 0, horizon, dtype=np.float32)[:, None, None]
    zenith, low = rng.uniform([0.1, 0.25, 0.5], [0.6, 0.75, 1.1]), rng.uniform(0.6, 1.3) * rng.uniform(0.85, 1.1, 3)
    image = np.empty((_HEIGHT, _WIDTH, 3), np.float32)
    image[:horizon] = low * (1 - up**0.6) + zenith * up**0.6
    cloud = sum(smooth_noise(rng, horizon, _WIDTH, 6 * 2**k) / 2**k for k in range(4))
    cover = np.clip(cloud + rng.uniform(-1.5, 1.5), 0, 1)[..., None]
    image[:horizon] = image[:horizon] * (1 - cover) + cover * rng.uniform(0.7, 1.4)
    if rng.uniform() < 0.55:
        at = (int(rng.integers(_WIDTH)), int(rng.integers(30, horizon - 24)))
        cv2.circle(image, at, 8, tuple(float(v) for v in 120 * rng.uniform([1, 0.8, 0.6], [1, 1, 1])), -1)
    image[horizon:] = rng.uniform(0.1, 0.5) * rng.uniform(0.85, 1.15, 3)
    x = 0
    while x < _WIDTH:
        width, top = int(rng.integers(6, 140)), horizon - int(rng.integers(4, 150))
        if rng.uniform() < 0.6:
            _house(rng, image[top:horizon, x : x + width])
        x += width
    band = image[horizon - 160 : horizon + 8]
    band *= np.exp(0.12 * smooth_noise(rng, len(band), _WIDTH, 300))[..., None]
    for _ in range(int(rng.integers(0, 30))):  # trees
        foot, tall = int(rng.integers(_WIDTH)), int(rng.integers(15, 110))
        green = rng.uniform(0.04, 0.45) * np.array([rng.uniform(0.5, 1.2), 1.0, rng.uniform(0.3, 0.7)])
        trunk = int(rng.integers(1, 5))
        cv2.line(image, (foot, horizon), (foot, horizon - tall), (0.06, 0.05, 0.04), trunk)
        for _ in range(int(rng.integers(8, 45))):
            at = foot + rng.normal(0, 0.22) * tall, horizon - tall * rng.uniform(0.5, 1.1)
            leaf = tuple(float(v) for v in green * rng.uniform(0.5, 1.5))
            cv2.circle(image, (round(at[0]), round(at[1])), int(rng.integers(2, 8)), leaf, -1)
    for _ in range(int(rng.integers(0, 12))):  # posts
        column, top = int(rng.integers(_WIDTH)), horizon - int(rng.integers(20, 180))
        image[top : horizon + 6, column : column + int(rng.integers(1, 7))] = rng.uniform(0.02, 0.7)
    for _ in range(int(rng.integers(0, 9))):
        _car(rng, image, int(rng.integers(0, _WIDTH - 80)), horizon + int(rng.integers(0, 14)))
    return cv2.GaussianBlur(image, (0, 0), rng.uniform(0.6, 2.0))


def _house(rng: np.random.Generator, image: Float32[np.ndarray, "h w 3"]) -> None:
    """Fill a piece of a panorama with a wall with windows."""
    image[:] = rng.uniform(0.08, 0.9) * rng.uniform(0.8, 1.2, 3)
    step, size = rng.integers(8, 24, 2), rng.uniform(0.3, 0.8, 2)
    rows, columns = ((np.arange(n) + 3) % k < share * k for n, k, share in zip(image.shape, step, size, strict=False))
    image[np.ix_(rows, columns)] = rng.uniform(0.02, 0.5)


def _car(rng: np.random.Generator, image: Panorama, left: int, bottom: int) -> None:
    long, paint = int(rng.integers(16, 80)), rng.uniform(0.02, 0.9, 3)
    tall = max(6, long // 4)
    image[bottom - tall : bottom, left : left + long] = paint
    image[bottom - 2 * tall : bottom - tall, left + long // 5 : left + 4 * long // 5] = paint
    image[bottom - 2 * tall + 2 : bottom - tall, left + long // 4 : left + 3 * long // 4] = 0.1
    for wheel in (left + long // 5, left + 4 * long // 5):
        cv2.circle(image, (wheel, bottom), max(1, long // 10), (0.03, 0.03, 0.03), -1)


def _ground(rng: np.random.Generator, plain: bool) -> Float32[np.ndarray, "g g 3"]:
    """Asphalt, concrete, tiles, grass, gravel, with lines, patches and cracks."""
    size = 256
    base = rng.uniform(0.12, 0.75) * (1 + rng.uniform(-0.04, 0.14) * rng.uniform([0.4, 0.0, -1.2], [1.2, 0.4, -0.4]))
    if not plain and rng.uniform() < 0.15:
        base = np.array([0.12, 0.22, 0.06]) * rng.uniform(0.6, 1.6)
    image = np.empty((size, size, 3), np.float32)
    image[:] = base
    if plain and rng.uniform() < 0.7:
        return image
    for cells in (4, 16, 64, 256):
        image *= np.exp(rng.uniform(0, 0.12) * smooth_noise(rng, size, size, cells))[..., None]
    if rng.uniform() < 0.35:
        step = int(rng.integers(16, 128))
        image[::step] *= rng.uniform(0.5, 1.5)
        image[:, ::step] *= rng.uniform(0.5, 1.5)
    for _ in range(int(rng.integers(0, 5))):
        ends = [tuple(int(v) for v in rng.integers(0, size, 2)) for _ in range(2)]
        shade = float(rng.choice([0.05, 0.9])) * rng.uniform(0.8, 1.1)
        cv2.line(image, ends[0], ends[1], (shade, shade, shade * rng.uniform(0.4, 1)), int(rng.integers(1, 7)))
    return np.clip(image, 0.02, 0.95)
