"""One capture on this machine: from its files in a folder to its folder of results."""

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import fields
from io import StringIO
from pathlib import Path, PurePosixPath
from statistics import median
from typing import TYPE_CHECKING, Any

from kronc_ns.errors import KroncError
from kronc_ns.files.output import REPORT_FILE
from kronc_ns.fleet.items import VIDEO_SUFFIXES, Kind
from kronc_ns.fleet.job import Job
from kronc_ns.fleet.options import FleetOptions
from kronc_ns.fleet.storage import Stored

if TYPE_CHECKING:
    from kronc_ns.scene import Scene
    from kronc_ns.solution import Solution

_PHOTO_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".heic", ".heif")
_POSES_ONLY = ("transforms.json", "kronc.json", "keypoints.json", "keypoints.ply", REPORT_FILE)


def kind_of(files: Sequence[Stored], is_video: bool) -> Kind:
    """What a capture's files make it."""
    names = [PurePosixPath(file.name) for file in files]
    if is_video:
        return "video"
    if any(name.suffix.lower() in _PHOTO_SUFFIXES and name.parts[0] not in ("masks", "depths") for name in names):
        return "images"
    if has_keypoints(files):
        return "keypoints"
    videos = [name for name in names if name.suffix.lower() in VIDEO_SUFFIXES and len(name.parts) == 1]
    return "video" if len(videos) == 1 else "unknown"


def has_keypoints(files: Sequence[Stored]) -> bool:
    """Whether a capture's files can be solved as they are: intrinsics and keypoints."""
    names = {file.name for file in files}
    return "transforms.json" in names and any(
        name == "keypoints.json" or name.endswith(".predictions.json") for name in names
    )


def without_images(files: Sequence[Stored]) -> list[Stored]:
    """The files that a solve of given keypoints reads."""
    return [file for file in files if not (file.name.startswith("images") and "/" in file.name)
            or file.name.endswith(".json")]  # fmt: skip


def make_poses(data: Path, out: Path, job: Job, options: FleetOptions) -> dict[str, float]:
    """Solve a scene folder in one thread; the seconds of each stage."""
    from kronc_ns.capture.depth import with_depths
    from kronc_ns.files.cache import fingerprint
    from kronc_ns.files.output import claim_output
    from kronc_ns.files.record import write_solution
    from kronc_ns.files.scene_folder import load_scene

    begin = time.perf_counter()
    with _quietly(job):
        scene = load_scene(data, keypoint_names=options.keypoint_names)
        scene = with_depths(scene, data, job.config, options.depth_weights)
        claim_output(out)
        solution = _in_one_thread(scene, job)
        report = write_solution(out, scene, solution, data, fingerprint(scene, job.config))
    solved = time.perf_counter()
    if _wants_report(options, report):
        from kronc_ns.show.report import write_report

        write_report(out)
    return {"work_s": solved - begin, "report_s": time.perf_counter() - solved}


def make_data_set(data: Path, out: Path, job: Job, options: FleetOptions) -> dict[str, float]:
    """What `ns-process-data kronc` does with a video or a folder of photos; the seconds of each stage."""
    from kronc_ns.capture.segmentation.choice import SegmenterOptions
    from kronc_ns.files.record import read_record
    from kronc_ns.plugin.process_data import KroncToNerfstudio

    begin = time.perf_counter()
    videos = [file for file in data.iterdir() if file.suffix.lower() in VIDEO_SUFFIXES] if data.is_dir() else []
    if len(videos) == 1 and not any(file.suffix.lower() in _PHOTO_SUFFIXES for file in data.rglob("*")):
        data = videos[0]
    known = {f.name for f in fields(KroncToNerfstudio)}
    same = {f.name: getattr(options, f.name) for f in fields(options) if f.name in known}
    segmentation = SegmenterOptions(options.segmenter, options.segmenter_weights)
    process = KroncToNerfstudio(data, out, **same, segmentation=segmentation, solve=options, images=options)
    with _quietly(job):
        process.run()
    if not (out / "kronc.json").exists():
        raise KroncError("it has no keypoints, and --detector none finds none: choose another detector")
    if not _wants_report(options, read_record(out)):
        (out / REPORT_FILE).unlink(missing_ok=True)
    return {"work_s": time.perf_counter() - begin}


def keep_poses_only(out: Path) -> None:
    """Delete of a data set what --poses-only does not ask for."""
    import shutil

    for path in out.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name not in _POSES_ONLY:
            path.unlink()


def facts(out: Path) -> dict[str, Any]:
    """What kronc.json of a result has for the table."""
    from kronc_ns.files.record import read_record

    record = read_record(out)
    views = record["views"]
    solved = [view for view in views if view["status"] == "solved"]
    middle = {
        key: median(known) if (known := [view[key] for view in solved if view[key] is not None]) else None
        for key in ("sigma_rot_deg", "sigma_trans_m")
    }
    return {
        **{key: record[key] for key in ("status", "reason", "rmse_px", "median_px")},
        **middle,
        "focal_px": record["focal_px"][0],
        "views": len(views),
        "solved": len(solved),
        "completed": sum(view["status"] == "completed" for view in views),
    }


def _wants_report(options: FleetOptions, record: dict[str, Any]) -> bool:
    return options.reports == "all" or (options.reports == "doubtful" and record["status"] != "converged")


def _in_one_thread(scene: "Scene", job: Job) -> "Solution":
    """`solve_scene` as one of many that are solved side by side: its parts do not spread over other tasks' cores."""
    from kronc_ns.fit.pipeline import solve_scene
    from kronc_ns.solve.threads import side_by_side

    (solution,) = side_by_side(lambda one: solve_scene(one, job.config), [scene])
    return solution


@contextmanager
def _quietly(job: Job) -> Iterator[None]:
    """Results speak of the command that the user gave; what is said on the way is for nobody."""
    before = sys.argv
    sys.argv = list(job.command)
    try:
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            yield
    finally:
        sys.argv = before
