"""Images of a mesh by Blender's path tracer (Cycles on the CPU), which runs as a process of its own."""

import json
import subprocess
import sys
from collections.abc import Generator
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from kronc_ns.errors import KroncError
from kronc_ns.geometry.camera import Camera
from kronc_ns.geometry.poses import flip_camera_axes
from kronc_ns.synthetic.mesh import MeshCar
from kronc_ns.synthetic.surroundings import (
    GROUND_HALF_M,
    SUN,
    WALL_HEIGHT_M,
    WALL_RADIUS_M,
    ground_levels,
    sky_colour,
    wall_levels,
)

SAMPLES = 4
"""Paths a pixel, before denoising: 39 dB from 64 of them, in a twelfth of the time."""
_WORKER = Path(__file__).with_name("blender_worker.py")
_SKY_HEIGHT = 256
_WALL_SEGMENTS = 128


def blender_views(
    car: MeshCar, c2w: Float[np.ndarray, "n 3 4"], camera: Camera, ground: bool
) -> Generator[UInt8[np.ndarray, "h w 4"], None, None]:
    """RGBA (straight alpha) of each view in turn: with the car park and its sun, or the car alone.

    Raises `KroncError` where Blender is not installed or stops; ends it when the generator is closed.
    """
    if find_spec("bpy") is None:
        raise KroncError(
            f"--renderer blender needs Blender as a Python module, which exists for Python 3.11 (this is "
            f"{sys.version_info.major}.{sys.version_info.minor}): pip install 'kronc-ns[blender]' there"
        )
    with TemporaryDirectory(prefix="kronc-blender-") as place:
        folder = Path(place)
        job = folder / "job.json"
        job.write_text(json.dumps(_job(car, c2w, camera, ground, folder)), encoding="utf-8")
        log = folder / "blender.log"
        with log.open("wb") as errors:
            process = subprocess.Popen(
                [sys.executable, "-P", str(_WORKER), str(job)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
            )
        try:
            assert process.stdout is not None
            for line in process.stdout:
                yield _read_rgba(Path(line.strip()))
            if process.wait():
                why = _last_line(log) or f"exit status {process.returncode}"
                raise KroncError(f"Blender stopped while it drew {car.file}: {why}")
        finally:
            process.kill()
            process.wait()


def _job(car: MeshCar, c2w: Float[np.ndarray, "n 3 4"], camera: Camera, ground: bool, folder: Path) -> dict[str, Any]:
    """What the worker reads, and the pictures that it names."""
    if any(camera.distortion):
        raise KroncError(f"lens distortion {camera.distortion}: Blender renders pinhole cameras only")
    job: dict[str, Any] = {
        "mesh": str(car.file.resolve()),
        "samples": SAMPLES,
        "camera": {key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")},
        "sun": SUN.tolist(),
        "sky": str(folder / "sky.png"),
        "ground": None,
        "frames": [
            {"file": str(folder / f"{i:05d}.png"), "c2w_opengl": [*pose, [0, 0, 0, 1]]}
            for i, pose in enumerate(flip_camera_axes(c2w).tolist())
        ],
    }
    cv2.imwrite(job["sky"], np.round(255 * _sky_panorama()[..., ::-1]).astype(np.uint8))
    if ground:
        job["ground"] = {"texture": str(folder / "ground.png"), "half_m": GROUND_HALF_M}
        job["wall"] = {"texture": str(folder / "wall.png"), **_wall()}
        cv2.imwrite(job["ground"]["texture"], cv2.cvtColor(ground_levels()[0], cv2.COLOR_RGB2BGR))
        cv2.imwrite(job["wall"]["texture"], cv2.cvtColor(wall_levels()[0], cv2.COLOR_RGBA2BGRA))
    return job


def _sky_panorama() -> Float[np.ndarray, "h w 3"]:
    """The whole sky as Blender wraps it: azimuth from -180 degrees, rightwards and clockwise; the zenith on top."""
    azimuth = np.pi * (1 - 2 * (np.arange(2 * _SKY_HEIGHT) + 0.5) / (2 * _SKY_HEIGHT))
    elevation = np.pi * (0.5 - (np.arange(_SKY_HEIGHT) + 0.5) / _SKY_HEIGHT)
    azimuth, elevation = np.meshgrid(azimuth, elevation)
    flat = np.cos(elevation)
    ray = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
    return np.clip(sky_colour(ray.reshape(-1, 3)), 0, 1).reshape(*ray.shape)


def _wall() -> dict[str, list]:
    """The cylinder of buildings: its picture starts behind (-x) and runs counterclockwise, seen from above."""
    share = np.linspace(0, 1, _WALL_SEGMENTS + 1)
    angle = 2 * np.pi * (share - 0.5)
    ring = WALL_RADIUS_M * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    low = np.arange(_WALL_SEGMENTS)
    high = low + _WALL_SEGMENTS + 1
    vertices = np.concatenate([np.insert(ring, 2, z, axis=1) for z in (0.0, WALL_HEIGHT_M)])
    uv = np.concatenate([np.stack([share, np.full_like(share, v)], axis=1) for v in (0.0, 1.0)])
    faces = np.stack([low, low + 1, high + 1, high], axis=1)
    return {"vertices": vertices.tolist(), "faces": faces.tolist(), "uv": uv.tolist()}


def _read_rgba(file: Path) -> UInt8[np.ndarray, "h w 4"]:
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise KroncError(f"{file} cannot be read: is the disk full?")
    file.unlink()
    return cv2.cvtColor(image, cv2.COLOR_BGRA2RGBA)


def _last_line(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1].strip() if lines else ""
