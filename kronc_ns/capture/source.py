"""What the user points at: a scene folder, a folder of photos, or a video."""

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from jaxtyping import Float

from kronc_ns.capture.images import HEIF_SUFFIXES, read_heif
from kronc_ns.capture.photos import PHOTO_SUFFIXES, find_photos, relative_names, told_of
from kronc_ns.errors import KroncError
from kronc_ns.files.output import read_json
from kronc_ns.files.transforms import cameras_and_frames, read_poses
from kronc_ns.geometry.camera import Camera

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
    cameras: tuple[Camera, ...] | None = None
    """Intrinsics of each image, as transforms.json has them."""
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
    note: str = ""
    """What of the folder was left out and why."""
    left_out: tuple[Path, ...] = ()
    """Photos that are not among `images`, since they show nothing new."""


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


def _photos(data: Path) -> Source:
    folder, images = find_photos(data)
    masks = data / "masks"
    return Source(
        data,
        "photos",
        images,
        relative_names(folder, images),
        masks=masks if masks.is_dir() else None,
        keypoints=_own_keypoints(data, folder),
        reference=_if_file(data / "reference.json"),
        note=told_of(folder, images),
    )


def _scene(data: Path) -> Source:
    file = data / "transforms.json"
    cameras, frames = cameras_and_frames(read_json(file), file)
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
        cameras=tuple(cameras),
        c2w=np.stack([poses[name] for name in names]) if posed else None,
        masks=masks or (data / "masks" if (data / "masks").is_dir() else None),
        depths=_listed(data, frames, "depth_file_path"),
        keypoints=_own_keypoints(data, images[0].parent),
        reference=_if_file(data / "reference.json"),
    )


def _listed(data: Path, frames: list[dict], key: str) -> tuple[Path, ...] | None:
    """Paths under ``key``; None where no frame has one. Some without, or a file that is missing, is an error."""
    without = [frame for frame in frames if not frame.get(key)]
    if len(without) == len(frames):
        return None
    if without:
        raise KroncError(
            f"{data / 'transforms.json'}: frame {without[0]['file_path']} lacks a {key} that others have "
            f"({len(without)} of {len(frames)} lack it): give all or none"
        )
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
