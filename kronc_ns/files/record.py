"""kronc.json, the evidence beside a solution's transforms.json: a solved folder written, and read back."""

import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float

import kronc_ns
from kronc_ns.errors import KroncError
from kronc_ns.files.cloud import read_cloud, write_cloud
from kronc_ns.files.keypoints import match_keypoints, read_keypoints, sigma_of, write_keypoints
from kronc_ns.files.output import read_json, relative_path, release_output, write_json
from kronc_ns.files.ply import write_points
from kronc_ns.files.provenance import provenance
from kronc_ns.files.transforms import (
    INTRINSICS,
    cameras_and_frames,
    intrinsics_dict,
    read_poses,
    read_transforms,
    transforms_dict,
)
from kronc_ns.geometry.camera import Lenses
from kronc_ns.geometry.poses import camera_z
from kronc_ns.scene import Scene
from kronc_ns.solution import ImageEvidence, Solution, Status, ViewReport, ViewStatus

_NUMBER_OR_NONE = (int, float, type(None))
_EVIDENCE = {
    "visible": (int,),
    "inliers": (int,),
    "rmse_px": _NUMBER_OR_NONE,
    "sigma_rot_deg": _NUMBER_OR_NONE,
    "sigma_trans_m": _NUMBER_OR_NONE,
    "swapped": (bool,),
}
"""Kinds of what kronc.json says of a view; all else is text."""
KEYPOINT_COLOUR = np.array([200, 40, 40], dtype=np.uint8)


def write_solution(folder: Path, scene: Scene, solution: Solution, data: Path, inputs: str) -> dict[str, Any]:
    """Write transforms.json, kronc.json, keypoints.json and the keypoint cloud of a claimed ``folder``; release it.

    ``data`` is the folder that ``scene`` was read from (image paths are written relative to ``folder``);
    ``inputs`` is the `fingerprint` of what was solved. Returns the content of kronc.json.
    """
    names = [relative_path(data, name, folder) for name in solution.names]
    masks = [relative_path(data, mask, folder) for mask in scene.masks] if scene.masks else None
    content = transforms_dict(solution.camera, names, solution.c2w, masks, lenses=solution.lenses)
    known = solution.points[np.isfinite(solution.points).all(-1)]
    colours = np.tile(KEYPOINT_COLOUR, (len(known), 1))
    if solution.cloud is not None:
        known, colours = (
            np.concatenate(of) for of in ((known, solution.cloud.points), (colours, solution.cloud.colours))
        )
    (folder / "keypoints.ply").unlink(missing_ok=True)
    if len(known):
        content["ply_file_path"] = "keypoints.ply"
        write_points(folder / "keypoints.ply", known, colours)
    write_cloud(folder, solution.cloud)
    write_json(folder / "transforms.json", content)
    if folder.resolve() != data.resolve():  # where they stand already
        rows = dict(zip(names, scene.keypoints, strict=True))
        size = None if scene.lenses else (scene.camera.width, scene.camera.height)
        write_keypoints(folder / "keypoints.json", scene.schema, size, rows, scene.sigma_px)
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
            {
                **{"file_path" if k == "name" else k: v for k, v in asdict(view).items()},
                "status": view.status.value,
                **({} if solution.lenses is None else intrinsics_dict(solution.camera_of(i))),
            }
            for i, view in enumerate(solution.views)
        ],
        "images": None if solution.images is None else asdict(solution.images),
        "points": [[_number(x) for x in point] for point in solution.points.tolist()],
        "history": {key: [_number(x) for x in values] for key, values in solution.history.items()},
        "initial_c2w": [_rounded(pose) for pose in _flat(solution.initial_c2w)],
        "path_c2w": [[_rounded(pose) for pose in step] for step in _flat(solution.path)],
    }


def read_record(folder: Path) -> dict[str, Any]:
    """kronc.json of a solved ``folder``; raises `KroncError` where there is none or it is broken."""
    file = folder / "kronc.json"
    if not file.exists():
        raise KroncError(f"{file} does not exist: expected a folder solved by `kronc solve` or `ns-process-data kronc`")
    record = read_json(file)
    if not isinstance(record, dict):
        raise KroncError(f"{file}: expected an object, as `kronc solve` writes it: solve again")
    for key, kind in {"version": str, "inputs": str, "command": str, "versions": dict}.items():
        if not isinstance(record.get(key, kind()), kind):  # no solution needs them
            raise _lacks(folder, key)
    return record


def read_solution(folder: Path) -> tuple[Scene, Solution]:
    """Scene and solution of a folder that `kronc solve` or `ns-process-data kronc` wrote, failed views included.

    Both ``names`` are paths as seen from ``folder``, or as somebody has rewritten them in transforms.json since (told
    by file name); those of the view reports are as in the scene that was solved. The
    scene's camera is the solved one, and its keypoints are the detections as the solver took them (left and right put
    right). Raises `KroncError` naming the file that is missing or broken.
    """
    record, file = read_record(folder), folder / "kronc.json"
    try:
        names = tuple(relative_path(folder / record["data"], view["file_path"], folder) for view in record["views"])
        views = tuple(_view(view) for view in record["views"])
        points = _array(record["points"], (-1, 3))
        initial = _poses(record["initial_c2w"], len(views))
        path = np.stack([initial, *(_poses(step, len(views)) for step in record.get("path_c2w", []))])[1:]
        history = {key: _array(values, (-1,)).tolist() for key, values in record["history"].items()}
        overall: dict[str, Any] = {key: _checked(record[key], key, str) for key in ("reason", "solver", "init")}
        overall |= {"iterations": _checked(record["iterations"], "iterations", int)}
        overall |= {"seconds": _checked(record["seconds"], "seconds", int, float)}
        for key in ("rmse_px", "median_px"):
            overall[key] = math.nan if record[key] is None else float(_checked(record[key], key, int, float))
        status = Status(record["status"])
        images = record.get("images")
        images = None if images is None else _images(images)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise KroncError(f"{file} is not as `kronc solve` writes it ({error!r:.200}): solve again") from None

    transforms = folder / "transforms.json"
    # of failed views transforms.json says nothing
    content = {**read_transforms(transforms), "frames": record["views"]}
    cameras, _ = cameras_and_frames(content, file if any("fl_x" in view for view in record["views"]) else transforms)
    lenses = Lenses.of(cameras)
    camera = cameras[0] if lenses is None else lenses.usual
    poses = read_poses(transforms)
    names = _as_listed(names, poses)
    c2w = np.stack([poses.get(name, np.full((3, 4), np.nan)) for name in names])
    found = read_keypoints(folder / "keypoints.json")
    if len(points) != len(found.schema):
        raise KroncError(f"{file} has {len(points)} points, keypoints.json {len(found.schema)}: solve again")
    rows = match_keypoints(found, names, camera)[0]
    detected = Scene(names, camera, found.schema, rows, sigma_px=sigma_of(found, names, rows), lenses=lenses)
    scene = detected.with_sides_swapped(np.array([view.swapped for view in views]))
    solved = np.array([view.status is ViewStatus.SOLVED for view in views])
    depths = camera_z(c2w, points)
    solution = Solution(
        status=status,
        names=names,
        camera=camera,
        c2w=c2w,
        points=points,
        depths=np.where(scene.seen & solved[:, None], depths, math.nan),
        views=views,
        initial_c2w=initial,
        history=history,
        path=path,
        lenses=lenses,
        images=images,
        cloud=read_cloud(folder, len(views)),
        **overall,
    )
    return scene, solution


def solved_points(folder: Path) -> Float[np.ndarray, "j 3"]:
    """The keypoints of a solved folder that have a place."""
    record = read_record(folder)
    try:
        return _array([point for point in record["points"] if None not in point], (-1, 3))
    except (KeyError, TypeError, ValueError, OverflowError):
        raise _lacks(folder, "points") from None


def left_out_views(folder: Path) -> set[str]:
    """File names of the views that a solved folder's transforms.json no longer lists because they failed."""
    record = read_record(folder)
    try:
        failed = [view["file_path"] for view in record["views"] if view["status"] == ViewStatus.FAILED.value]
        return {PurePosixPath(name).name for name in failed}
    except (KeyError, TypeError):
        raise _lacks(folder, "views") from None


def _lacks(folder: Path, key: str) -> KroncError:
    return KroncError(f'{folder / "kronc.json"}: expected "{key}", as `kronc solve` writes them: solve again')


def _as_listed(names: Sequence[str], listed: Iterable[str]) -> tuple[str, ...]:
    """Paths as they are listed, matched by file name where that tells them apart."""
    listed = {*listed}
    by_file_name = {PurePosixPath(path).name: path for path in listed}
    if len({PurePosixPath(name).name for name in names}) < len(names):
        return tuple(names)
    return tuple(name if name in listed else by_file_name.get(PurePosixPath(name).name, name) for name in names)


def _view(view: dict[str, Any]) -> ViewReport:
    evidence = {key: value for key, value in view.items() if key not in ("file_path", *INTRINSICS)}
    for key, value in evidence.items():
        _checked(value, key, *_EVIDENCE.get(key, (str,)))
    return ViewReport(**{**evidence, "name": view["file_path"], "status": ViewStatus(view["status"])})


def _images(said: dict[str, Any]) -> ImageEvidence:
    """Evidence of image features; `TypeError` or `ValueError` where it is not as it was written."""
    kinds = {"accepted": (bool,), "background_still": (bool,), "reason": (str,), "region": (str,), "held_out": (int,)}
    lists = ("tracks_by_length", "observations")
    for key, value in said.items():
        if key in lists:
            said = {**said, key: tuple(_checked(count, key, int) for count in value)}
        else:
            _checked(value, key, *kinds.get(key, _NUMBER_OR_NONE))
    return ImageEvidence(**said)


def _poses(poses: list[list[float] | None], count: int) -> Float[np.ndarray, "n 3 4"]:
    """Rows of twelve numbers, null where there is no pose."""
    return _array([pose or [None] * 12 for pose in poses], (count, 3, 4))


def _checked(value: Any, key: str, *kinds: type) -> Any:
    """A value of just one of these ``kinds``, and finite if it is a number; else `ValueError`."""
    endless = isinstance(value, int | float) and not abs(value) <= sys.float_info.max  # also of NaN
    if endless or type(value) not in kinds:
        raise ValueError(f"{key} is {value!r:.100}")
    return value


def _array(values: Any, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    """Nested lists as float64, null as NaN."""
    return np.array(values, dtype=np.float64).reshape(shape)


def _flat(poses: Float[np.ndarray, "*n 3 4"] | None) -> list[Any]:
    """Twelve numbers a pose, row by row."""
    return [] if poses is None else poses.reshape(*poses.shape[:-2], 12).tolist()


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _rounded(pose: list[float]) -> list[float] | None:
    """The twelve numbers of a pose, row by row, as exact as a picture needs them; None where there is none."""
    return [round(x, 5) for x in pose] if all(map(math.isfinite, pose)) else None
