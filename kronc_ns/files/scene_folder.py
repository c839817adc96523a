"""Scene folders: images, transforms.json, keypoints.json, masks and depth maps become a `Scene`, checked."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from kronc_ns.errors import KroncError
from kronc_ns.files.images import depth_under, read_depth
from kronc_ns.files.keypoints import Detections, match_keypoints, read_keypoints, sigma_of, under_file_names
from kronc_ns.files.output import read_json
from kronc_ns.files.record import left_out_views
from kronc_ns.files.transforms import cameras_and_frames, given_poses
from kronc_ns.geometry.camera import Camera, Lenses
from kronc_ns.scene import Scene

_UNDONE_PX, _FEW = 0.5, 0.05


def load_scene(folder: Path | str, keypoints: Path | None = None, keypoint_names: str | None = None) -> Scene:
    """Read a scene folder: ``transforms.json`` (intrinsics, frames) and ``keypoints.json`` (or ``keypoints``).

    ``keypoint_names`` says which points they are where their file does not (a known schema, or a file of names).
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
    cameras, frames = cameras_and_frames(content, file)
    lenses = Lenses.of(cameras)
    camera = cameras[0] if lenses is None else lenses.usual
    names = tuple(str(frame["file_path"]) for frame in frames)
    _check_images(folder, names)
    masks = tuple(str(frame.get("mask_path", "")) for frame in frames)
    if any(masks) and not all(masks):
        raise KroncError(f"{file}: frame {names[masks.index('')]} lacks a mask_path that others have: give all or none")
    is_solution = (folder / "kronc.json").exists()
    found = read_keypoints(keypoints or folder, keypoint_names)
    if is_solution:
        left_out = left_out_views(folder)
        found = _without(under_file_names(found, (*names, *left_out)), left_out)
    mask_files = [folder / mask for mask in masks] if all(masks) and masks else None
    sizes = [(one.width, one.height) for one in cameras]
    rows, note = match_keypoints(found, names, camera, mask_files, sizes)
    for own in set(cameras):
        _check_distortion(own, rows[[one == own for one in cameras]], file)
    return Scene(
        names=names,
        camera=camera,
        lenses=lenses,
        schema=found.schema,
        keypoints=rows,
        sigma_px=sigma_of(found, names, rows),
        given_c2w=None if is_solution else given_poses(frames, file),
        given_depths=_given_depths(folder, frames, rows, cameras),
        masks=masks if any(masks) else None,
        notes=(note,) if note else (),
    )


def masks_of(folder: Path, names: Sequence[str]) -> tuple[str, ...] | None:
    """``mask_path`` of the images of a solved folder; empty for views without a pose, None where there are no masks."""
    file = folder / "transforms.json"
    _, frames = cameras_and_frames(read_json(file), file)
    masks = {str(frame["file_path"]): str(frame.get("mask_path", "")) for frame in frames}
    return tuple(masks.get(name, "") for name in names) if any(masks.values()) else None


def _without(found: Detections, file_names: set[str]) -> Detections:
    kept = {key: rows for key, rows in found.frames.items() if PurePosixPath(key).name not in file_names}
    return replace(found, frames=kept)


def _check_distortion(camera: Camera, keypoints: Float[np.ndarray, "n j 3"], file: Path) -> None:
    """Distortion can be undone where keypoints are, but for a few in the corners."""
    uv = keypoints[..., :2]
    inside = (keypoints[..., 2] > 0) & (uv >= 0).all(-1) & (uv[..., 0] <= camera.width) & (uv[..., 1] <= camera.height)
    if not any(camera.distortion) or not inside.any():
        return
    off = np.linalg.norm(camera.distort(camera.undistort(uv[inside])) - uv[inside], axis=-1)
    lost = float((~(off < _UNDONE_PX)).mean())
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


def _given_depths(
    folder: Path, frames: list[dict[str, Any]], rows: Float[np.ndarray, "n j 3"], cameras: list[Camera]
) -> Float[np.ndarray, "n j"] | None:
    """Depth maps (nerfstudio's 16-bit millimetres, or .npy in metres) read under the keypoints."""
    if not all(frame.get("depth_file_path") for frame in frames):
        return None
    depths = [
        depth_under(row, read_depth(folder / str(frame["depth_file_path"])), camera)
        for frame, row, camera in zip(frames, rows, cameras, strict=True)
    ]
    return np.stack(depths)
