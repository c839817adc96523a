"""nerfstudio's transforms.json: the cameras and the frames, read and written (OpenGL axes in the file)."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

from kronc_ns.errors import KroncError
from kronc_ns.files.output import read_json
from kronc_ns.geometry.camera import Camera, Lenses
from kronc_ns.geometry.poses import flip_camera_axes

INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2")
"""nerfstudio's names of a camera's numbers."""
_LARGEST = 1e9


def transforms_dict(
    camera: Camera,
    names: Sequence[str],
    c2w: Float[np.ndarray, "n 3 4"] | None,
    masks: Sequence[str] | None = None,
    depths: Sequence[str] | None = None,
    lenses: Lenses | None = None,
) -> dict[str, Any]:
    """nerfstudio's transforms.json (OpenGL axes) as a dictionary; views with NaN poses are left out.

    With ``lenses`` every frame has its own intrinsics, for what stands at the top level holds for all.
    """
    content: dict[str, Any] = {"camera_model": "OPENCV"}
    if lenses is None:
        content |= intrinsics_dict(camera)
    frames = []
    opengl = None if c2w is None else flip_camera_axes(c2w)
    for i, name in enumerate(names):
        frame: dict[str, Any] = {"file_path": name}
        if lenses is not None:
            frame |= intrinsics_dict(lenses.cameras[lenses.of_view[i]])
        if masks is not None:
            frame["mask_path"] = masks[i]
        if depths is not None:
            frame["depth_file_path"] = depths[i]
        if opengl is not None:
            if not np.isfinite(opengl[i]).all():
                continue
            frame["transform_matrix"] = [*opengl[i].tolist(), [0.0, 0.0, 0.0, 1.0]]
        frames.append(frame)
    content["frames"] = frames
    return content


def intrinsics_dict(camera: Camera) -> dict[str, float]:
    """A camera under nerfstudio's names."""
    values = (camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, *camera.distortion)
    return dict(zip(INTRINSICS, values, strict=True))


def camera_and_frames(content: Any, file: Path) -> tuple[Camera, list[dict[str, Any]]]:
    """The shared camera and the frames of a nerfstudio transforms file; `KroncError` where there are several."""
    cameras, frames = cameras_and_frames(content, file)
    if len(set(cameras)) > 1:
        sizes = sorted({(c.width, c.height) for c in cameras})
        what = f"images of different sizes {sizes}" if len(sizes) > 1 else "frames with different intrinsics"
        raise KroncError(f"{file}: {what}: expected one camera and one size for all views")
    return cameras[0], frames


def cameras_and_frames(content: Any, file: Path) -> tuple[list[Camera], list[dict[str, Any]]]:
    """The camera of every frame, and the frames, of a nerfstudio transforms file."""
    frames = _frames(content, file)
    if not frames:
        raise KroncError(f"{file}: no frames: expected at least 3 views")
    twice = [name for name, count in Counter(str(f["file_path"]) for f in frames).items() if count > 1]
    if twice:
        raise KroncError(f"{file}: {twice[0]} is listed twice: expected one frame per image")
    if content.get("camera_model", "OPENCV") not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE"):
        raise KroncError(
            f"{file}: camera_model {content['camera_model']!r} is not supported: expected OPENCV or PINHOLE"
        )
    cameras = []
    for frame in frames:
        merged = {key: frame.get(key, content.get(key)) for key in INTRINSICS}
        merged["fl_y"] = merged["fl_x"] if merged["fl_y"] is None else merged["fl_y"]
        missing = [key for key in INTRINSICS[:6] if merged[key] is None]
        if missing:
            raise KroncError(
                f"{file}: {', '.join(missing)} missing: expected the intrinsics at the top level, or in every frame"
            )
        try:
            numbers = [float(0.0 if merged[key] is None else merged[key]) for key in INTRINSICS]
            width, height = map(int, numbers[4:6])
            if max(map(abs, numbers)) > _LARGEST:  # whose squares may overflow
                raise ValueError
        except (TypeError, ValueError, OverflowError):
            raise KroncError(
                f"{file}: intrinsics {_short(merged)} are not all finite numbers: expected pixels, and coefficients"
            ) from None
        fx, fy, cx, cy = numbers[:4]
        cameras.append(Camera(fx, fy, cx, cy, width, height, *numbers[6:]))
    return cameras, frames


def read_transforms(file: Path) -> dict[str, Any]:
    """Content of a transforms file, of which "frames" are known to be objects with a "file_path", and no more."""
    content = read_json(file)
    _frames(content, file)
    return content


def read_poses(file: Path) -> dict[str, Float[np.ndarray, "3 4"]]:
    """Camera-to-world poses (OpenCV axes) by ``file_path``, of the frames that have one, from a transforms file."""
    posed = [frame for frame in read_transforms(file)["frames"] if frame.get("transform_matrix") is not None]
    return {str(frame["file_path"]): _pose(frame, file) for frame in posed}


def given_poses(frames: list[dict[str, Any]], file: Path) -> Float[np.ndarray, "n 3 4"] | None:
    """Poses (OpenCV c2w) of all frames; None unless every frame has one."""
    if not all(frame.get("transform_matrix") is not None for frame in frames):
        return None
    return np.stack([_pose(frame, file) for frame in frames])


def _frames(content: Any, file: Path) -> list[dict[str, Any]]:
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not all(isinstance(f, dict) and "file_path" in f for f in frames):
        raise KroncError(
            f'{file}: expected "frames", a list of objects with "file_path", as nerfstudio writes it: '
            "restore the file or write it anew"
        )
    odd = [frame["file_path"] for frame in frames if not isinstance(frame["file_path"], str) or not frame["file_path"]]
    if odd:
        raise KroncError(f"{file}: file_path {_short(odd[0])} is no path: expected that of an image, as text")
    return frames


def _short(value: Any) -> str:
    """A value of a file in an error, which is to stay on a line."""
    text = repr(value)
    return text if len(text) <= 200 else f"{text[:200]}..."


def _pose(frame: dict[str, Any], file: Path) -> Float[np.ndarray, "3 4"]:
    where = f"{file}, {frame['file_path']}"
    try:
        matrix = np.asarray(frame["transform_matrix"], dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise KroncError(f"{where}: transform_matrix must be 4x4 finite numbers (camera to world)")
    rotation = matrix[:3, :3]
    larger = np.abs(rotation).max() > 2  # than any entry of a rotation; its square may overflow
    if larger or np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise KroncError(f"{where}: transform_matrix holds no rotation: expected an orthonormal, right-handed 3x3 part")
    u, _, vh = np.linalg.svd(rotation)
    clean = np.concatenate([u @ vh, matrix[:3, 3:]], axis=1)
    return flip_camera_axes(clean)


def check_file_names(names: Sequence[str], file: Path) -> None:
    """Raise `KroncError` where folders alone tell images apart, for what knows them by file name."""
    (name, count), *_ = Counter(PurePosixPath(name).name for name in names).most_common(1)
    if count > 1:
        raise KroncError(
            f"{file}: {count} images in different folders are called {name}: here views are told apart by file name, "
            "give each its own"
        )
