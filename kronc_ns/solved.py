"""A solved folder read back: the inverse of `export.write_solution`."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from kronc_ns.errors import KroncError
from kronc_ns.export import relative_path
from kronc_ns.keypoints.io import read_json, read_keypoints
from kronc_ns.scene import Scene, camera_and_frames, match_keypoints, read_poses
from kronc_ns.solve.solution import Solution, Status, ViewReport, ViewStatus
from kronc_ns.starts import mirrored


def read_record(folder: Path) -> dict[str, Any]:
    """kronc.json of a solved ``folder``; raises `KroncError` where there is none or it is broken."""
    file = folder / "kronc.json"
    if not file.exists():
        raise KroncError(f"{file} does not exist: expected a folder solved by `kronc solve` or `ns-process-data kronc`")
    record = read_json(file)
    if not isinstance(record, dict):
        raise KroncError(f"{file}: expected an object, as `kronc solve` writes it: solve again")
    return record


def read_solution(folder: Path) -> tuple[Scene, Solution]:
    """Scene and solution of a folder that `kronc solve` or `ns-process-data kronc` wrote, failed views included.

    Both ``names`` are paths as seen from ``folder``, those of the view reports as in the scene that was solved. The
    scene's camera is the solved one, and its keypoints are the detections as the solver took them (left and right put
    right). Raises `KroncError` naming the file that is missing or broken.
    """
    record, file = read_record(folder), folder / "kronc.json"
    try:
        names = tuple(relative_path(folder / record["data"], view["file_path"], folder) for view in record["views"])
        views = tuple(_view(view) for view in record["views"])
        points = _array(record["points"], (-1, 3))
        initial = _poses(record["initial_c2w"], len(views))
        path = torch.stack([initial, *(_poses(step, len(views)) for step in record.get("path_c2w", []))])[1:]
        history = {key: [float(value) for value in values] for key, values in record["history"].items()}
        overall: dict[str, Any] = {key: record[key] for key in ("reason", "solver", "init", "iterations", "seconds")}
        for key in ("rmse_px", "median_px"):
            overall[key] = math.nan if record[key] is None else float(record[key])
        status = Status(record["status"])
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise KroncError(f"{file} is not as `kronc solve` writes it ({error!r}): solve again") from None

    transforms = folder / "transforms.json"
    # of failed views transforms.json says nothing
    camera, _ = camera_and_frames({**read_json(transforms), "frames": record["views"]}, transforms)
    poses = read_poses(transforms)
    without = torch.full((3, 4), math.nan, dtype=torch.float64)
    c2w = torch.stack([poses.get(name, without) for name in names])
    found = read_keypoints(folder / "keypoints.json")
    if len(points) != len(found.schema):
        raise KroncError(f"{file} has {len(points)} points, keypoints.json {len(found.schema)}: solve again")
    keypoints = torch.from_numpy(match_keypoints(found, names, camera)[0])
    swapped = torch.tensor([view.swapped for view in views])
    keypoints = torch.where(swapped[:, None, None], mirrored(keypoints, found.schema), keypoints)
    solved = torch.tensor([view.status is ViewStatus.SOLVED for view in views])
    depths = ((points - c2w[:, None, :, 3]) * c2w[:, None, :, 2]).sum(-1)
    solution = Solution(
        status=status,
        names=names,
        camera=camera,
        c2w=c2w,
        points=points,
        depths=torch.where((keypoints[..., 2] > 0) & solved[:, None], depths, math.nan),
        views=views,
        initial_c2w=initial,
        history=history,
        path=path,
        **overall,
    )
    return Scene(names, camera, found.schema, keypoints), solution


def _view(view: dict[str, Any]) -> ViewReport:
    evidence = {key: value for key, value in view.items() if key != "file_path"}
    return ViewReport(**{**evidence, "name": view["file_path"], "status": ViewStatus(view["status"])})


def _poses(poses: list[list[float] | None], count: int) -> Float[Tensor, "n 3 4"]:
    """Rows of twelve numbers, null where there is no pose."""
    return _array([pose or [None] * 12 for pose in poses], (count, 3, 4))


def _array(values: Any, shape: tuple[int, ...]) -> Float[Tensor, "..."]:
    """Nested lists as float64, null as NaN."""
    return torch.from_numpy(np.array(values, dtype=np.float64).reshape(shape))
