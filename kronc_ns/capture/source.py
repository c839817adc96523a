"""What the user points at: a scene folder, a folder of photos, or a video."""

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from jaxtyping import Float

from kronc_ns.capture.images import HEIF_SUFFIXES, read_heif
from kronc_ns.errors import KroncError
from kronc_ns.files.output import read_json
from kronc_ns.files.transforms import camera_and_frames, read_poses
from kronc_ns.geometry.camera import Camera

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
"""Image files that are taken, in lower case."""
PHOTO_SUFFIXES = (*IMAGE_SUFFIXES, *HEIF_SUFFIXES)
"""What is taken of a folder of photos."""
MIN_FRAMES = 3
"""Fewer views cannot be solved."""


@dataclass(frozen=True)
class Source:
    """A capture as it was found; nothing of it is ever written."""

    path: Path
    kind: Literal["scene folder", "photos", "video"]
    images: tuple[Path, ...]
    """Image files in capture order; empty for a video, whose frames have to be extracted."""
    names: tuple[str, ...]
    """What keypoint files may call the images."""
    camera: Camera | None = None
    """Intrinsics of transforms.json."""
    c2w: Float[np.ndarray, "n 3 4"] | None = None
    """Poses of transforms.json (OpenCV axes), where every frame has one."""
    masks: Path | tuple[Path, ...] | None = None
    """Mask of each image as transforms.json says, or a folder ``masks`` beside the images."""
    depths: tuple[Path, ...] | None = None
    """Depth map of each image."""
    keypoints: Path | None = None
    """Keypoint file or folder that lies with the images."""
    reference: Path | None = None
    """``reference.json``: trusted poses, for `kronc eval`."""


def find_source(data: Path) -> Source:
    """Look at ``data`` and say what it is; raises `KroncError` where it is nothing that can be used."""
    if not data.exists():
        raise KroncError(f"{data} does not exist: expected a scene folder, a folder of photos or a video")
    if data.is_dir():
        return _scene(data) if (data / "transforms.json").exists() else _photos(data)
    if data.suffix.lower() in PHOTO_SUFFIXES:
        raise KroncError(f"{data} is a single image: give the folder of at least {MIN_FRAMES} photos, or a video")
    if data.suffix.lower() == ".json":
        raise KroncError(f"{data} is a JSON file: give the folder that holds it")
    return Source(data, "video", (), ())


def find_images(data: Path) -> Source:
    """`find_source` of images that need not make a scene: a single photo will do."""
    if data.is_file() and data.suffix.lower() in PHOTO_SUFFIXES:
        if data.suffix.lower() in HEIF_SUFFIXES:
            read_heif(data)
        return Source(data, "photos", (data,), (data.name,))
    return find_source(data)


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key under which img2 comes before img10."""
    return [
        (0, int(part), "") if part.isdecimal() else (1, 0, part.lower()) for part in re.split(r"(\d+)", name) if part
    ]


def list_images(folder: Path, suffixes: tuple[str, ...] = IMAGE_SUFFIXES) -> tuple[Path, ...]:
    """Image files of a folder (no subfolders, no hidden files), naturally sorted."""
    files = [f for f in folder.iterdir() if f.suffix.lower() in suffixes and not f.name.startswith(".") and f.is_file()]
    return tuple(sorted(files, key=lambda file: natural_key(file.name)))


def _photos(data: Path) -> Source:
    folder = data
    images = list_images(data, PHOTO_SUFFIXES)
    if not images and (data / "images").is_dir():
        folder = data / "images"
        images = list_images(folder, PHOTO_SUFFIXES)
    if not images:
        others = Counter(f.suffix.lower() for f in folder.iterdir() if f.is_file() and f.suffix)
        found = ", ".join(f"{count} {suffix}" for suffix, count in others.most_common(3)) or "no files"
        raise KroncError(
            f"{folder} holds no images that can be read ({found}): expected {', '.join(PHOTO_SUFFIXES)}, "
            "a transforms.json, or as --data a video file itself"
        )
    if heif := next((image for image in images if image.suffix.lower() in HEIF_SUFFIXES), None):
        read_heif(heif)
    names = tuple(image.name for image in images)
    masks = data / "masks"
    return Source(
        data,
        "photos",
        images,
        names,
        masks=masks if masks.is_dir() else None,
        keypoints=_own_keypoints(data, folder),
        reference=_if_file(data / "reference.json"),
    )


def _scene(data: Path) -> Source:
    file = data / "transforms.json"
    camera, frames = camera_and_frames(read_json(file), file)
    names = tuple(str(frame["file_path"]) for frame in frames)
    images = tuple(data / name for name in names)
    missing = [image for image in images if not image.is_file()]
    if missing:
        raise KroncError(
            f"{missing[0]} does not exist ({len(missing)} images of {file} are missing): expected the images, "
            "or use `kronc solve` on a scene of keypoints only"
        )
    poses = read_poses(file)
    posed = len(poses) == len(frames) and not (data / "kronc.json").exists()
    masks = _listed(data, frames, "mask_path")
    return Source(
        data,
        "scene folder",
        images,
        names,
        camera=camera,
        c2w=np.stack([poses[name] for name in names]) if posed else None,
        masks=masks or (data / "masks" if (data / "masks").is_dir() else None),
        depths=_listed(data, frames, "depth_file_path"),
        keypoints=_own_keypoints(data, images[0].parent),
        reference=_if_file(data / "reference.json"),
    )


def _listed(data: Path, frames: list[dict], key: str) -> tuple[Path, ...] | None:
    """Paths under ``key``; None unless every frame has one. A listed file that is missing is an error."""
    if not all(frame.get(key) for frame in frames):
        return None
    paths = tuple(data / PurePosixPath(str(frame[key])) for frame in frames)
    missing = [path for path in paths if not path.is_file()]
    if missing:
        raise KroncError(
            f"{missing[0]} does not exist, but {data / 'transforms.json'} lists it as {key}: add it or remove all"
        )
    return paths


def _own_keypoints(data: Path, images: Path) -> Path | None:
    for folder in (data, images):
        if (folder / "keypoints.json").exists() or any(folder.glob("*.predictions.json")):
            return folder
    return None


def _if_file(path: Path) -> Path | None:
    return path if path.is_file() else None
