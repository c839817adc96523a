"""Published car captures as scene folders: CarPatch (NeRF-synthetic files) and videos posed by COLMAP.

Either becomes what every command reads: ``images/``, ``masks/``, ``keypoints.json``, ``transforms.json`` with
intrinsics only, and the poses that came along in ``reference.json``, for `kronc eval`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from PIL import Image

from kronc_ns.capture.images import copy_upright, upright_size
from kronc_ns.capture.photos import IMAGE_SUFFIXES, list_images
from kronc_ns.errors import KroncError
from kronc_ns.files.images import read_mask
from kronc_ns.files.keypoints import FORMATS, match_keypoints, read_keypoints, write_keypoints
from kronc_ns.files.output import claim_output, read_json, release_output, write_json
from kronc_ns.files.transforms import read_poses, transforms_dict
from kronc_ns.geometry.camera import Camera, Lenses
from kronc_ns.keypoints.schema import KeypointSchema

if TYPE_CHECKING:
    import pycolmap

_COLMAP_FOLDERS = ("sparse/0", "colmap/sparse/0", "sparse", "colmap", ".")
_COLMAP_MODELS = {  # parameters of COLMAP's camera models, by our names
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
}


@dataclass(frozen=True)
class Views:
    """N views of a data set, in order."""

    images: tuple[Path, ...]
    names: tuple[str, ...]
    """What keypoint files call them."""
    cameras: tuple[Camera, ...]
    """Of each view."""
    c2w: Float[np.ndarray, "n 3 4"]
    """Trusted poses, OpenCV axes; NaN where a view has none."""
    schema: KeypointSchema
    keypoints: Float[np.ndarray, "n j 3"]
    masks: tuple[Path, ...] | None
    """Mask files; None: the images' alpha, if they have any."""


def import_dataset(data: Path, output: Path, splits: Sequence[str] = ("train", "test")) -> int:
    """Write the scene folder ``output`` from a data set in ``data``; returns the number of views.

    CarPatch: ``transforms_SPLIT.json`` with ``camera_angle_x`` and camera-to-world matrices in OpenGL axes, images at
    their ``file_path`` (".png" is added), and for each split a keypoint file of any format that is read:
    ``keypoints_SPLIT.json``, ``SPLIT/keypoints.json``, or OpenPifPaf's predictions in ``SPLIT/``. The splits follow
    one another. Otherwise ``images/`` (or ``frames/``), a COLMAP model in ``sparse/0``, ``colmap/sparse/0`` or
    ``colmap``, keypoints in ``keypoints.json`` or ``keypoints/``, and optionally ``masks/``.
    """
    if not data.is_dir():
        raise KroncError(f"{data} is no folder: expected a CarPatch scene, or images with a COLMAP model")
    if any(data.glob("transforms_*.json")):
        views = _joined([_carpatch_split(data, split) for split in splits])
    else:
        views = _posed_by_colmap(data)
    claim_output(output, "capture")
    _write(output, views)
    release_output(output)
    return len(views.images)


def _carpatch_split(data: Path, split: str) -> Views:
    file = data / f"transforms_{split}.json"
    if not file.exists():
        found = sorted(f.stem.removeprefix("transforms_") for f in data.glob("transforms_*.json"))
        raise KroncError(f"{file} does not exist: expected the splits that are there, --splits {' '.join(found)}")
    poses = read_poses(file)
    content = read_json(file)
    if not poses or len(poses) != len(content["frames"]):
        raise KroncError(
            f"{file}: {len(poses)} of {len(content['frames'])} frames have a pose: expected all to have one"
        )
    names = tuple(
        str(PurePosixPath(name if name.lower().endswith(IMAGE_SUFFIXES) else f"{name}.png")) for name in poses
    )
    images = tuple(data / name for name in names)
    width, height = _size(images)
    angle = content.get("camera_angle_x")
    if not isinstance(angle, int | float) or not 0 < angle < math.pi:
        raise KroncError(f"{file}: camera_angle_x is {angle}: expected the field of view in radians, as Blender has it")
    focal = width / 2 / math.tan(angle / 2)
    cameras = (Camera(focal, focal, width / 2, height / 2, width, height),) * len(images)
    candidates = [data / f"keypoints_{split}.json", data / split / "keypoints.json", data / split]
    schema, keypoints = _keypoints(candidates, names, cameras)
    return Views(images, names, cameras, np.stack(list(poses.values())), schema, keypoints, None)


def _posed_by_colmap(data: Path) -> Views:
    folder = next((data / name for name in ("images", "frames") if (data / name).is_dir()), None)
    images = list_images(folder) if folder else ()
    if not images:
        raise KroncError(
            f"{data} holds neither transforms_train.json (CarPatch) nor images/ or frames/: expected one of them"
        )
    names = tuple(image.name for image in images)
    cameras, poses = _read_colmap(data, names)
    for image, camera in zip(images, cameras, strict=True):
        if (size := upright_size(image)) != (camera.width, camera.height):
            raise KroncError(
                f"{image} is {size[0]}x{size[1]}, COLMAP's camera {camera.width}x{camera.height}: "
                "expected the images that COLMAP was given"
            )
    none = np.full((3, 4), np.nan)
    c2w = np.stack([poses.get(name, none) for name in names])
    schema, keypoints = _keypoints([data / "keypoints.json", data / "keypoints", images[0].parent], names, cameras)
    masks = _masks(data / "masks", names) if (data / "masks").is_dir() else None
    return Views(images, names, cameras, c2w, schema, keypoints, masks)


def _masks(folder: Path, names: tuple[str, ...]) -> tuple[Path, ...]:
    """The mask of each image: of the same stem, or of the image's whole name and ``.png``, as COLMAP has it."""
    files = {file.name: file for file in list_images(folder)}
    by_stem = {file.stem: file for file in files.values()}
    found = [files.get(f"{name}.png") or by_stem.get(PurePosixPath(name).stem) for name in names]
    missing = [name for name, file in zip(names, found, strict=True) if file is None]
    if missing:
        raise KroncError(
            f"{folder} lacks a mask for {missing[0]} ({len(missing)} of {len(names)} are missing): "
            "expected one for every image"
        )
    return tuple(file for file in found if file is not None)


def _read_colmap(data: Path, names: Sequence[str]) -> tuple[tuple[Camera, ...], dict[str, Float[np.ndarray, "3 4"]]]:
    """The camera of each image of these names, and the poses (OpenCV c2w) of those that have one, by name."""
    import zlib  # noqa: F401 - pycolmap >= 4.1 aborts the process where zlib comes after it

    import pycolmap

    folders = [data / name for name in _COLMAP_FOLDERS]
    folder = next((f for f in folders for kind in ("bin", "txt") if (f / f"cameras.{kind}").exists()), None)
    if folder is None:
        raise KroncError(f"{data} holds no COLMAP model: expected cameras.bin or cameras.txt in {folders[0]}")
    try:
        model = pycolmap.Reconstruction(str(folder))
    except (OSError, ValueError, RuntimeError) as error:
        raise KroncError(f"{folder} cannot be read as a COLMAP model: {error}") from None
    images = {PurePosixPath(image.name).name: image for image in model.images.values()}
    unknown = sorted(set(images) - set(names))
    if unknown:
        raise KroncError(
            f"the COLMAP model in {data} has {unknown[0]}, which is not among the images: expected its images"
        )
    cameras = {number: _camera_of(camera, folder) for number, camera in model.cameras.items()}
    if not cameras:
        raise KroncError(f"{folder} has no camera: expected a COLMAP model of the images")
    unplaced = [name for name in names if name not in images]
    if unplaced and len({*cameras.values()}) > 1:
        raise KroncError(
            f"{folder} has {len(cameras)} cameras and does not say which took {unplaced[0]}, which it has not placed: "
            "leave that image out"
        )
    of_unplaced = next(iter(cameras.values()))
    each = tuple(cameras[images[name].camera_id] if name in images else of_unplaced for name in names)
    poses = {name: image.cam_from_world().inverse().matrix() for name, image in images.items() if image.has_pose}
    return each, poses


def _camera_of(camera: "pycolmap.Camera", folder: Path) -> Camera:
    kind = camera.model.name
    if kind not in _COLMAP_MODELS:
        raise KroncError(f"{folder}: camera model {kind} is not supported: expected {', '.join(_COLMAP_MODELS)}")
    values = dict(zip(_COLMAP_MODELS[kind], map(float, camera.params), strict=True))
    focal = values.pop("f", None)
    if focal is not None:
        values |= {"fx": focal, "fy": focal}
    return Camera(width=camera.width, height=camera.height, **values)


def _keypoints(
    candidates: Sequence[Path], names: tuple[str, ...], cameras: Sequence[Camera]
) -> tuple[KeypointSchema, Float[np.ndarray, "n j 3"]]:
    """Schema and rows from the first candidate that is a keypoint file, or a folder of predictions."""
    for path in candidates:
        if path.is_file() or any(path.glob("*.predictions.json")):
            found = read_keypoints(path)
            if found.notes:  # a data set is published whole
                raise KroncError(f"{'; '.join(found.notes)}: expected numbers, or confidence 0 for what is not seen")
            sizes = [(camera.width, camera.height) for camera in cameras]
            return found.schema, match_keypoints(found, names, cameras[0], sizes=sizes)[0]
    listed = ", ".join(map(str, candidates[:-1]))
    raise KroncError(f"no keypoints: expected {listed} or predictions in {candidates[-1]} ({FORMATS})")


def _size(images: tuple[Path, ...]) -> tuple[int, int]:
    """(width, height) of all images; an error that names two that differ."""
    sizes: dict[tuple[int, int], Path] = {}
    for image in images:
        sizes.setdefault(upright_size(image), image)
    if len(sizes) > 1:
        (one, first), (other, second), *_ = sizes.items()
        raise KroncError(
            f"{first} is {one[0]}x{one[1]}, {second} {other[0]}x{other[1]}: expected one camera and one size for all"
        )
    return next(iter(sizes))


def _joined(parts: Sequence[Views]) -> Views:
    """Several splits, one after the other."""
    first = parts[0]
    for part in parts[1:]:
        if part.schema != first.schema:
            raise KroncError(
                f"{len(first.schema)} keypoints for {first.images[0]}, {len(part.schema)} for {part.images[0]}: "
                "expected one keypoint schema for all splits"
            )
    return Views(
        tuple(image for part in parts for image in part.images),
        tuple(name for part in parts for name in part.names),
        tuple(camera for part in parts for camera in part.cameras),
        np.concatenate([part.c2w for part in parts]),
        first.schema,
        np.concatenate([part.keypoints for part in parts]),
        None,
    )


def _write(output: Path, views: Views) -> None:
    for folder in ("images", "masks"):
        (output / folder).mkdir(exist_ok=True)
    stems = ["_".join(PurePosixPath(name).with_suffix("").parts) for name in views.names]
    names = [f"images/{stem}{file.suffix.lower()}" for stem, file in zip(stems, views.images, strict=True)]
    masks = [f"masks/{stem}.png" for stem in stems]
    sizes = [(camera.width, camera.height) for camera in views.cameras]
    for i, (source, name) in enumerate(zip(views.images, names, strict=True)):
        image = copy_upright(source, output / name)
        if views.masks is not None:
            Image.fromarray(read_mask(views.masks[i], sizes[i])).save(output / masks[i])
        elif "A" in image.getbands():
            opaque = np.asarray(image.getchannel("A")) > 127
            Image.fromarray(np.where(opaque, 255, 0).astype(np.uint8)).save(output / masks[i])
    masked = masks if all((output / mask).exists() for mask in masks) else None
    rows = dict(zip(names, views.keypoints, strict=True))
    write_keypoints(output / "keypoints.json", views.schema, sizes[0] if len({*sizes}) == 1 else None, rows)
    lenses = Lenses.of(views.cameras)
    for file, poses in (("reference.json", views.c2w), ("transforms.json", None)):
        write_json(output / file, transforms_dict(views.cameras[0], names, poses, masked, lenses=lenses))
