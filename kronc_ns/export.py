"""Solutions to files: nerfstudio's transforms.json (only here), kronc.json, COLMAP models and PLY.

An output folder is claimed with a marker file before anything is written and released with kronc.json as the
last file, so that an interrupted run is never taken for a result and somebody else's folder is never touched.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

import kronc_ns
from kronc_ns.errors import KroncError
from kronc_ns.files import atomic_path, write_json
from kronc_ns.geometry.camera import Camera
from kronc_ns.geometry.poses import flip_camera_axes, invert
from kronc_ns.keypoints.io import read_json, write_keypoints
from kronc_ns.provenance import provenance
from kronc_ns.scene import Scene, camera_and_frames, check_file_names, read_poses
from kronc_ns.solve.solution import Solution

MARKER = ".kronc-incomplete"
"""Present in an output folder from the first byte until kronc.json is written."""


REPORT_FILE = "report.html"
_REPORT_MARK = '<meta name="generator" content="kronc_ns'


def is_report(file: Path) -> bool:
    """Whether ``file`` is an HTML report of ours."""
    with file.open(encoding="utf-8", errors="replace") as start:
        return _REPORT_MARK in start.read(1000)


Kind = Literal["solution", "data set", "capture"]
"""What an output folder holds: poses alone; poses with the frames and detections they came from; a scene to solve."""


def claim_output(folder: Path, kind: Kind = "solution") -> None:
    """Make ``folder`` ours to write: new, empty, or holding an earlier (also an interrupted) result of this ``kind``.

    Raises `KroncError` where it holds anything else.
    """
    if folder.exists() and not folder.is_dir():
        raise KroncError(f"{folder} is a file: expected a folder for the output")
    if folder.is_dir() and any(folder.iterdir()) and (held := _held(folder)) not in (kind, ""):
        what = "data that kronc did not write" if held is None else f"a {held}, which is not for a {kind} to replace"
        raise KroncError(f"{folder} already holds {what}: choose a new or empty folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / MARKER).write_text(kind)
        (folder / "kronc.json").unlink(missing_ok=True)
        report = folder / REPORT_FILE
        if report.is_file() and is_report(report):  # of the earlier result
            report.unlink()
    except OSError as error:
        raise KroncError(f"{folder} cannot be written: {error.strerror}") from None


def _held(folder: Path) -> str | None:
    """The kind of the result, whole or interrupted, that kronc left in a folder; None where it left none.

    Empty where a version interrupted there did not say.
    """
    if (folder / MARKER).exists():
        return (folder / MARKER).read_text()
    if not (folder / "kronc.json").exists():
        return None
    try:
        record = read_json(folder / "kronc.json")
    except KroncError:  # broken
        return "solution"
    return "data set" if isinstance(record, dict) and record.get("data") == "." else "solution"


def release_output(folder: Path) -> None:
    """The output is whole: take the marker away."""
    (folder / MARKER).unlink(missing_ok=True)


def transforms_dict(
    camera: Camera,
    names: Sequence[str],
    c2w: Float[Tensor, "n 3 4"] | None,
    masks: Sequence[str] | None = None,
    depths: Sequence[str] | None = None,
) -> dict[str, Any]:
    """nerfstudio's transforms.json (OpenGL axes) as a dictionary; views with NaN poses are left out."""
    content: dict[str, Any] = {
        "camera_model": "OPENCV",
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
        "k1": camera.k1,
        "k2": camera.k2,
        "p1": camera.p1,
        "p2": camera.p2,
    }
    frames = []
    opengl = None if c2w is None else flip_camera_axes(c2w.double())
    for i, name in enumerate(names):
        frame: dict[str, Any] = {"file_path": name}
        if masks is not None:
            frame["mask_path"] = masks[i]
        if depths is not None:
            frame["depth_file_path"] = depths[i]
        if opengl is not None:
            if not opengl[i].isfinite().all():
                continue
            frame["transform_matrix"] = [*opengl[i].tolist(), [0.0, 0.0, 0.0, 1.0]]
        frames.append(frame)
    content["frames"] = frames
    return content


def write_solution(folder: Path, scene: Scene, solution: Solution, data: Path, inputs: str) -> dict[str, Any]:
    """Write transforms.json, kronc.json, keypoints.json and the keypoint cloud of a claimed ``folder``; release it.

    ``data`` is the folder that ``scene`` was read from (image paths are written relative to ``folder``);
    ``inputs`` is the `fingerprint` of what was solved. Returns the content of kronc.json.
    """
    names = [relative_path(data, name, folder) for name in solution.names]
    masks = [relative_path(data, mask, folder) for mask in scene.masks] if scene.masks else None
    content = transforms_dict(solution.camera, names, solution.c2w, masks)
    known = solution.points[solution.points.isfinite().all(-1)]
    (folder / "keypoints.ply").unlink(missing_ok=True)
    if len(known):
        content["ply_file_path"] = "keypoints.ply"
        with atomic_path(folder / "keypoints.ply") as path:
            trimesh.PointCloud(known.numpy(), colors=np.tile([[200, 40, 40, 255]], (len(known), 1))).export(path)
    write_json(folder / "transforms.json", content)
    if folder.resolve() != data.resolve():  # where they stand already
        rows = dict(zip(names, scene.keypoints.numpy(), strict=True))
        write_keypoints(folder / "keypoints.json", scene.schema, (scene.camera.width, scene.camera.height), rows)
    report = {
        **solution_dict(solution),
        "keypoint_schema": scene.schema.name,
        "inputs": inputs,
        "data": relative_path(data, ".", folder),
        **provenance(),
    }
    write_json(folder / "kronc.json", report)
    release_output(folder)
    return report


def solution_dict(solution: Solution) -> dict[str, Any]:
    """What kronc.json says about a solution; NaN becomes null."""
    return {
        "version": kronc_ns.__version__,
        "status": solution.status.value,
        "reason": solution.reason,
        "solver": solution.solver,
        "init": solution.init,
        "iterations": solution.iterations,
        "seconds": round(solution.seconds, 3),
        "rmse_px": _number(solution.rmse_px),
        "median_px": _number(solution.median_px),
        "focal_px": [solution.camera.fx, solution.camera.fy],
        "views": [
            {**{"file_path" if k == "name" else k: v for k, v in asdict(view).items()}, "status": view.status.value}
            for view in solution.views
        ],
        "points": [[_number(x) for x in point] for point in solution.points.tolist()],
        "history": {key: [_number(x) for x in values] for key, values in solution.history.items()},
        "initial_c2w": [_rounded(pose) for pose in solution.initial_c2w.flatten(1).tolist()],
        "path_c2w": [[_rounded(pose) for pose in step] for step in _steps(solution).flatten(2).tolist()],
    }


def _steps(solution: Solution) -> Float[Tensor, "s n 3 4"]:
    initial = solution.initial_c2w
    return initial.new_empty(0, *initial.shape) if solution.path is None else solution.path


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _rounded(pose: list[float]) -> list[float] | None:
    """The twelve numbers of a pose, row by row, as exact as a picture needs them; None where there is none."""
    return [round(x, 5) for x in pose] if all(map(math.isfinite, pose)) else None


def relative_path(data: Path, name: str, folder: Path) -> str:
    """The path ``name`` of a scene in ``data``, as seen from ``folder``."""
    return Path(os.path.relpath((data / name).resolve(), folder.resolve())).as_posix()


def write_colmap(folder: Path, solved: Path) -> int:
    """Write the COLMAP model (binary) of a solved folder: camera, images with poses, keypoints as 3D points.

    Returns the number of images. Positions, axes and the half-pixel convention are COLMAP's.
    """
    import zlib  # noqa: F401 - pycolmap >= 4.1 aborts the process where zlib comes after it

    import pycolmap

    transforms = solved / "transforms.json"
    camera, frames = camera_and_frames(read_json(transforms), transforms)
    check_file_names([frame["file_path"] for frame in frames], transforms)
    poses = read_poses(transforms)
    points = _solved_points(solved)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            camera_id=1,
            model="OPENCV",
            width=camera.width,
            height=camera.height,
            params=[camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion],
        )
    )
    for number, frame in enumerate(frames, start=1):
        w2c = invert(poses[frame["file_path"]])
        image = pycolmap.Image(name=Path(frame["file_path"]).name, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(w2c.numpy()))
    for point in points:
        model.add_point3D(point, pycolmap.Track(), np.array([200, 40, 40], dtype=np.uint8))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        model.write_binary(str(folder))
    except (OSError, ValueError) as error:  # ValueError: pycolmap could not open or write a file
        raise KroncError(f"{folder} cannot be written: {getattr(error, 'strerror', None) or error}") from None
    return len(frames)


def write_ply(path: Path, solved: Path) -> int:
    """Write camera centres (blue) and keypoints (red) of a solved folder as a point cloud; returns their number."""
    poses = read_poses(solved / "transforms.json")
    points = _solved_points(solved)
    if not poses:
        raise KroncError(f"{solved / 'transforms.json'}: no view has a pose, there is nothing to export")
    centres = torch.stack(list(poses.values()))[..., 3].numpy()
    cloud = np.concatenate([centres, points])
    colours = np.array([[40, 80, 200, 255]] * len(centres) + [[200, 40, 40, 255]] * len(points), dtype=np.uint8)
    with atomic_path(path) as temporary:
        trimesh.PointCloud(cloud, colors=colours).export(temporary, file_type="ply")
    return len(cloud)


def _solved_points(solved: Path) -> Float[np.ndarray, "j 3"]:
    """The keypoints of a kronc.json that were solved."""
    file = solved / "kronc.json"
    content = read_json(file)
    try:
        return np.array([point for point in content["points"] if None not in point], dtype=float).reshape(-1, 3)
    except (KeyError, TypeError, ValueError):
        raise KroncError(f'{file}: expected "points", as `kronc solve` writes them: solve again') from None
