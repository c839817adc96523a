"""The scene: everything a solver may know about a capture, read from a scene folder and checked."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from kronc_ns.errors import KroncError
from kronc_ns.geometry.camera import Camera
from kronc_ns.geometry.poses import flip_camera_axes
from kronc_ns.keypoints.io import Detections, read_json, read_keypoints
from kronc_ns.keypoints.schema import KeypointSchema
from kronc_ns.keypoints.select import select_instances

_INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2")
_UNDONE_PX, _FEW = 0.5, 0.05
_DEPTH_UNIT_M = 1e-3  # nerfstudio's depth maps are 16-bit millimetres


@dataclass(frozen=True)
class Scene:
    """N views of one object by one camera, with J keypoints; immutable, made by `load_scene` or by hand."""

    names: tuple[str, ...]
    """``file_path`` of each view, relative to the folder, in capture order."""
    camera: Camera
    schema: KeypointSchema
    keypoints: Float[Tensor, "n j 3"]
    """(u, v, confidence) in pixels as detected (distorted); confidence 0: not seen."""
    given_c2w: Float[Tensor, "n 3 4"] | None = None
    """Poses that came with the images (OpenCV axes), for ``init="given"``."""
    given_depths: Float[Tensor, "n j"] | None = None
    """z-depth under each keypoint, in any unit common to all views; NaN where there is none."""
    masks: tuple[str, ...] | None = None
    """``mask_path`` of each view, or None."""
    notes: tuple[str, ...] = ()
    """What loading decided that the user may want to know."""

    def __post_init__(self) -> None:
        if self.keypoints.shape != (len(self.names), len(self.schema), 3):
            raise KroncError(
                f"keypoints have shape {tuple(self.keypoints.shape)}: "
                f"expected ({len(self.names)}, {len(self.schema)}, 3)"
            )

    def __len__(self) -> int:
        return len(self.names)

    @cached_property
    def visibility(self) -> Float[Tensor, "n j"]:
        """The paper's m: 1 where a keypoint was found, else 0."""
        return (self.keypoints[..., 2] > 0).to(self.keypoints.dtype)

    @cached_property
    def uv(self) -> Float[Tensor, "n j 2"]:
        """Pixels with lens distortion removed."""
        return self.camera.undistort(self.keypoints[..., :2])


def load_scene(folder: Path | str, keypoints: Path | None = None) -> Scene:
    """Read a scene folder: ``transforms.json`` (intrinsics, frames) and ``keypoints.json`` (or ``keypoints``).

    Raises `KroncError` naming the file and the remedy for anything that is missing, malformed or inconsistent.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise KroncError(f"{folder} is no folder: expected a scene folder with transforms.json and keypoints.json")
    file = folder / "transforms.json"
    if not file.exists():
        raise KroncError(
            f"{file} does not exist: a scene folder needs it for the intrinsics; "
            "`ns-process-data kronc` makes one from photos or a video"
        )
    content = read_json(file)
    camera, frames = camera_and_frames(content, file)
    names = tuple(str(frame["file_path"]) for frame in frames)
    _check_images(folder, names)
    masks = tuple(str(frame.get("mask_path", "")) for frame in frames)
    if any(masks) and not all(masks):
        raise KroncError(f"{file}: frame {names[masks.index('')]} lacks a mask_path that others have: give all or none")
    is_solution = (folder / "kronc.json").exists()
    found = read_keypoints(keypoints or folder)
    if is_solution:
        found = _without(found, left_out_views(folder))
    rows, note = match_keypoints(found, names, camera, [folder / m for m in masks] if all(masks) and masks else None)
    _check_distortion(camera, torch.from_numpy(rows), file)
    return Scene(
        names=names,
        camera=camera,
        schema=found.schema,
        keypoints=torch.from_numpy(rows),
        given_c2w=None if is_solution else _given_poses(frames, file),
        given_depths=_given_depths(folder, frames, rows, camera),
        masks=masks if any(masks) else None,
        notes=(note,) if note else (),
    )


def camera_and_frames(content: Any, file: Path) -> tuple[Camera, list[dict[str, Any]]]:
    """The shared camera and the frames of a nerfstudio transforms file."""
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not all(isinstance(f, dict) and "file_path" in f for f in frames):
        raise KroncError(f'{file}: expected "frames", a list of objects with "file_path", as nerfstudio writes it')
    if not frames:
        raise KroncError(f"{file}: no frames: expected at least 3 views")
    twice = [name for name, count in Counter(str(f["file_path"]) for f in frames).items() if count > 1]
    if twice:
        raise KroncError(f"{file}: {twice[0]} is listed twice: expected one frame per image")
    if content.get("camera_model", "OPENCV") not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE"):
        raise KroncError(
            f"{file}: camera_model {content['camera_model']!r} is not supported: expected OPENCV or PINHOLE"
        )
    cameras = set()
    for frame in frames:
        merged = {key: frame.get(key, content.get(key)) for key in _INTRINSICS}
        merged["fl_y"] = merged["fl_x"] if merged["fl_y"] is None else merged["fl_y"]
        missing = [key for key in _INTRINSICS[:6] if merged[key] is None]
        if missing:
            raise KroncError(f"{file}: {', '.join(missing)} missing: expected the intrinsics at the top level")
        try:
            numbers = [float(0.0 if merged[key] is None else merged[key]) for key in _INTRINSICS]
            width, height = map(int, numbers[4:6])
        except (TypeError, ValueError, OverflowError):
            raise KroncError(f"{file}: intrinsics {merged} are not all finite numbers") from None
        fx, fy, cx, cy = numbers[:4]
        cameras.add(Camera(fx, fy, cx, cy, width, height, *numbers[6:]))
    if len(cameras) > 1:
        sizes = sorted({(c.width, c.height) for c in cameras})
        what = f"images of different sizes {sizes}" if len(sizes) > 1 else "frames with different intrinsics"
        raise KroncError(f"{file}: {what}: expected one camera and one size for all views")
    return cameras.pop(), frames


def check_file_names(names: Sequence[str], file: Path) -> None:
    """Raise `KroncError` where folders alone tell images apart, for what knows them by file name."""
    (name, count), *_ = Counter(PurePosixPath(name).name for name in names).most_common(1)
    if count > 1:
        raise KroncError(
            f"{file}: {count} images in different folders are called {name}: here views are told apart by file name, "
            "give each its own"
        )


def match_keypoints(
    found: Detections, names: tuple[str, ...], camera: Camera, masks: list[Path] | None = None
) -> tuple[Float[np.ndarray, "n j 3"], str]:
    """Rows for each view from a keypoint file, matched by path or else by file name; and a note on choices made."""
    if found.size is not None and found.size != (camera.width, camera.height):
        raise KroncError(
            f"{found.source} is for {found.size[0]}x{found.size[1]} images, the camera says "
            f"{camera.width}x{camera.height}: expected keypoints in the pixels of the images"
        )
    by_name: dict[str, str] = {}
    for name in names:
        by_name[PurePosixPath(name).name] = "" if PurePosixPath(name).name in by_name else name
    matched: dict[str, np.ndarray] = {}
    unknown = []
    for key, instances in found.frames.items():
        name = key if key in names else by_name.get(PurePosixPath(key).name, "")
        if name:
            matched[name] = instances
        else:
            unknown.append(key)
    if unknown:
        raise KroncError(
            f"{found.source} has keypoints for {len(unknown)} images that do not exist ({unknown[0]}): "
            f"expected names like {names[0]}"
        )
    empty = np.zeros((0, len(found.schema), 3))
    instances = [matched.get(name, empty) for name in names]
    if not any((rows[..., 2] > 0).any() for rows in instances):
        raise KroncError(
            f"{found.source}: no keypoints for any of the {len(names)} images: expected at least 4 in 3 views"
        )
    several = [i for i, rows in enumerate(instances) if len(rows) > 1]
    read = [_read_mask(path) if i in several else None for i, path in enumerate(masks)] if masks and several else None
    rows, note = select_instances(instances, (camera.width, camera.height), read)
    return rows, note if several else ""


def left_out_views(folder: Path) -> set[str]:
    """File names of the views that a solved folder's transforms.json no longer lists because they failed."""
    file = folder / "kronc.json"
    try:
        views = read_json(file)["views"]
        return {PurePosixPath(view["file_path"]).name for view in views if view["status"] == "failed"}
    except (KeyError, TypeError):
        raise KroncError(f'{file}: expected "views", as `kronc solve` writes them: solve again') from None


def _without(found: Detections, file_names: set[str]) -> Detections:
    kept = {key: rows for key, rows in found.frames.items() if PurePosixPath(key).name not in file_names}
    return replace(found, frames=kept)


def read_poses(file: Path) -> dict[str, Float[Tensor, "3 4"]]:
    """Camera-to-world poses (OpenCV axes) by ``file_path``, of the frames that have one, from a transforms file."""
    content = read_json(file)
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not all(isinstance(f, dict) and "file_path" in f for f in frames):
        raise KroncError(f'{file}: expected "frames", a list of objects with "file_path", as nerfstudio writes it')
    posed = [frame for frame in frames if frame.get("transform_matrix") is not None]
    return {str(frame["file_path"]): _pose(frame, file) for frame in posed}


def _check_distortion(camera: Camera, keypoints: Float[Tensor, "n j 3"], file: Path) -> None:
    """Distortion can be undone where keypoints are, but for a few in the corners."""
    uv = keypoints[..., :2]
    inside = (keypoints[..., 2] > 0) & (uv >= 0).all(-1) & (uv[..., 0] <= camera.width) & (uv[..., 1] <= camera.height)
    if not any(camera.distortion) or not inside.any():
        return
    off = (camera.distort(camera.undistort(uv[inside])) - uv[inside]).norm(dim=-1)
    lost = float((~(off < _UNDONE_PX)).double().mean())
    if lost > _FEW:
        raise KroncError(
            f"{file}: distortion (k1, k2, p1, p2) = {camera.distortion} cannot be undone for {100 * lost:.0f} % of the "
            "keypoints: expected OpenCV's coefficients of this camera, or none"
        )


def _check_images(folder: Path, names: tuple[str, ...]) -> None:
    """Every listed image exists, unless the scene has keypoints only (no image folder at all)."""
    if not any((folder / name).parent.is_dir() and any((folder / name).parent.iterdir()) for name in names[:1]):
        return
    missing = [name for name in names if not (folder / name).exists()]
    if missing:
        raise KroncError(f"{folder / missing[0]} does not exist ({len(missing)} images of transforms.json are missing)")


def _pose(frame: dict[str, Any], file: Path) -> Float[Tensor, "3 4"]:
    where = f"{file}, {frame['file_path']}"
    try:
        matrix = np.asarray(frame["transform_matrix"], dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise KroncError(f"{where}: transform_matrix must be 4x4 finite numbers (camera to world)")
    rotation = matrix[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise KroncError(f"{where}: transform_matrix holds no rotation: expected an orthonormal, right-handed 3x3 part")
    u, _, vh = np.linalg.svd(rotation)
    clean = np.concatenate([u @ vh, matrix[:3, 3:]], axis=1)
    return flip_camera_axes(torch.from_numpy(clean))


def _given_poses(frames: list[dict[str, Any]], file: Path) -> Float[Tensor, "n 3 4"] | None:
    if not all(frame.get("transform_matrix") is not None for frame in frames):
        return None
    return torch.stack([_pose(frame, file) for frame in frames])


def _given_depths(
    folder: Path, frames: list[dict[str, Any]], rows: Float[np.ndarray, "n j 3"], camera: Camera
) -> Float[Tensor, "n j"] | None:
    """Depth maps (nerfstudio's 16-bit millimetres, or .npy in metres) read under the keypoints."""
    if not all(frame.get("depth_file_path") for frame in frames):
        return None
    depths = [
        depth_under(row, read_depth(folder / str(frame["depth_file_path"])), camera)
        for frame, row in zip(frames, rows, strict=True)
    ]
    return torch.from_numpy(np.stack(depths))


def depth_under(
    row: Float[np.ndarray, "j 3"], depth_map: Float[np.ndarray, "h w"], camera: Camera
) -> Float[np.ndarray, "j"]:
    """Depth in the pixel of each keypoint (u, v, confidence) of one view; NaN where not seen or not above 0.

    The map covers the whole image of ``camera`` at any resolution.
    """
    scale = np.array([depth_map.shape[1] / camera.width, depth_map.shape[0] / camera.height])
    column, line = np.floor(row[:, :2] * scale).astype(int).T
    inside = (column >= 0) & (line >= 0) & (column < depth_map.shape[1]) & (line < depth_map.shape[0])
    seen = inside & (row[:, 2] > 0)
    depth = np.zeros(len(row))
    depth[seen] = depth_map[line[seen], column[seen]]
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)


def read_depth(path: Path) -> Float[np.ndarray, "h w"]:
    """Depth map in metres from a .npy of metres or a 16-bit image of millimetres; 0 where unknown."""
    try:
        if path.suffix == ".npy":
            return np.load(path).astype(np.float64)
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except (OSError, ValueError):
        image = None
    if image is None or image.ndim != 2:
        raise KroncError(
            f"{path} is no depth map: expected a 16-bit single-channel image in millimetres or .npy in metres"
        )
    return image.astype(np.float64) * _DEPTH_UNIT_M


def _read_mask(path: Path) -> np.ndarray:
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if mask is None:
        raise KroncError(f"{path} is no image: expected a mask with 0 outside the car")
    return mask
