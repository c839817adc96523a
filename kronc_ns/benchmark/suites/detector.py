"""The suite of the detector: points and poses from bare photos, on data that it was not trained on."""

import json
import subprocess
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeAlias

import numpy as np
from jaxtyping import Float

from kronc_ns.benchmark.figures import Figures, pose_figures
from kronc_ns.benchmark.photos import (
    main_car,
    part_errors,
    photos_in,
    read_part_photos,
    solve_photos,
    takes_left_for_right,
    turn_steps,
    wheel_errors,
)
from kronc_ns.benchmark.suites.rows import Limit, Row, Statistic
from kronc_ns.capture.detection.builtin.detector import BuiltinDetector
from kronc_ns.capture.detection.detector import CarImage, Detector
from kronc_ns.errors import KroncError
from kronc_ns.files.images import read_mask
from kronc_ns.files.keypoints import read_keypoints
from kronc_ns.files.output import read_json
from kronc_ns.files.transforms import camera_and_frames, read_poses
from kronc_ns.solution import Solution, Status, ViewStatus

Shown: TypeAlias = Mapping[Statistic, tuple[str, ...]]
_TURNS = ("spin_duster_turntable", "spin_evox_stinger_blue", "spin_ertiga", "orbit_asx_park")
_BEFORE = ("keypoints_deg", "keypoints_cm", "refined")
_NOTHINGS = 20
_CALIBRATION_PICTURES, _WALK_VIEWS = 120, 36
_CALIBRATED = Limit("ece", at_most=0.05)
_FRAMES, _FRAME_SIZE = 100, (1920, 1080)


def detector_rows(photos: Path, weights: Path | None) -> tuple[list[Row], list[str]]:
    """Rows of which ``photos`` holds the data, and why others are left out."""
    detector = BuiltinDetector(weights)
    rows: list[Row] = []
    missing: list[str] = []
    for folder, make in (
        ("spin_suv", _turntable_rows),
        *((f"captures/{name}", _turn_row) for name in _TURNS),
        ("car_parts", _part_rows),
        ("cars", _render_rows),
    ):
        if (photos / folder).is_dir():
            rows += make(detector, photos / folder)
        else:
            missing.append(f"{photos / folder} is not there: its rows are left out")
    rows += [
        Row(
            f"no car: {kind}",
            f"{_NOTHINGS} rendered pictures without a car",
            1,
            partial(_false_alarms, detector, kind),
            (Limit("cars", "total", at_most=0.0),),
        )
        for kind in ("surroundings", "object")
    ]
    rows.append(
        Row(
            "calibration: drawn cars",
            f"{_CALIBRATION_PICTURES} renders of procedural sports cars and people carriers",
            1,
            partial(_drawn_calibration, detector),
            (_CALIBRATED,),
            {"mean": ("points",)},
        )
    )
    rows.append(
        Row(
            "time and memory",
            f"{_FRAMES} photos of {_FRAME_SIZE[0]}x{_FRAME_SIZE[1]} of a car, a process of its own",
            1,
            partial(_time, weights),
            (Limit("seconds_taken", at_most=25.0), Limit("memory_gb", at_most=1.2)),
        )
    )
    return rows, missing


def _turntable_rows(detector: Detector, folder: Path) -> list[Row]:
    return [
        Row(
            "spin_suv: points",
            "36 studio photos, 806 measured points; distances in box diagonals",
            1,
            partial(_points, detector, folder),
            (
                Limit("median_percent", at_most=1.2),
                Limit("within_3_percent", at_least=85.0),
                Limit("found", at_least=70.0),
            ),
        ),
        Row(
            "spin_suv: poses, focal length given",
            "36 bare photos against the reference poses",
            1,
            partial(_poses, detector, folder, True),
            (Limit("solved", at_least=36.0), Limit("median_deg", at_most=1.5), Limit("median_cm", at_most=25.0)),
            {"mean": _BEFORE},
        ),
        Row(
            "spin_suv: poses, focal length unknown",
            "36 bare photos against the reference poses",
            1,
            partial(_poses, detector, folder, False),
            (Limit("solved", at_least=36.0), Limit("median_deg", at_most=2.5)),
            {"mean": ("median_cm", *_BEFORE)},
        ),
    ]


def _turn_row(detector: Detector, folder: Path) -> list[Row]:
    limits = (
        Limit("converged", at_least=1.0),
        Limit("step_rms_deg", at_most=1.5),
        Limit("sides_confused", "total", at_most=0.0),
    )
    shown: Shown = {
        "mean": ("keypoints_step_rms_deg", "refined", "solved", "views", "radius_rms_percent", "height_rms_percent")
    }
    measure = partial(_turn, detector, folder)
    return [Row(folder.name, "photos at equal steps, focal length unknown, no labels", 1, measure, limits, shown)]


def _part_rows(detector: Detector, folder: Path) -> list[Row]:
    limits = (
        Limit("wheels_within_4_percent", at_least=85.0),
        Limit("corners_within_4_percent", at_least=75.0),
        Limit("photos_confused_percent", at_most=3.0),
    )
    shown: Shown = {"mean": ("photos_with_car", "points_a_photo")}
    return [Row("car_parts", "100 photos of many cars", 1, partial(_parts, detector, folder), limits, shown)]


def _render_rows(detector: Detector, folder: Path) -> list[Row]:
    from kronc_ns.benchmark.renders import UNSEEN

    limits = (
        Limit("converged", "worst", at_least=1.0),
        Limit("median_deg", at_most=1.0),
        Limit("median_cm", at_most=8.0),
    )
    rows = [
        Row(
            f"rendered walk: {name}",
            f"a car never trained on, {_WALK_VIEWS} views of 480x352, focal length given",
            3,
            partial(_walk, detector, folder / name),
            limits,
            {"mean": ("solved", *_BEFORE)},
        )
        for name in UNSEEN
    ]
    note = f"{_CALIBRATION_PICTURES} renders of the cars never trained on; beside it, calibrated on one for the other"
    shown: Shown = {"mean": ("ece_by_other_car", "points")}
    rows.append(Row("calibration", note, 1, partial(_calibration, detector, folder), (_CALIBRATED,), shown))
    return rows


def _points(detector: Detector, folder: Path, _: int) -> Figures:
    measured, errors, labelled = read_keypoints(folder / "keypoints.json"), [], 0
    for name, instances in measured.frames.items():
        rows = instances[0]
        known = rows[:, 2] > 0
        labelled += int(known.sum())
        car = main_car(detector, folder / name)
        if car is None:
            continue
        mask = read_mask(folder / "masks" / Path(name).name, measured.size or (1024, 512))
        down, across = np.nonzero(mask)
        diagonal = float(np.hypot(np.ptp(across) + 1, np.ptp(down) + 1))
        both = known & (car.confidence > 0)
        errors.append(np.linalg.norm(car.uv - rows[:, :2], axis=1)[both] / diagonal)
    distance = 100 * np.concatenate(errors)
    return {
        "median_percent": float(np.median(distance)),
        "within_3_percent": 100 * float((distance < 3).mean()),
        "found": 100 * len(distance) / labelled,
    }


def _poses(detector: Detector, folder: Path, with_focal: bool, _: int) -> Figures:
    content = read_json(folder / "reference.json")
    camera, _frames = camera_and_frames(content, folder / "reference.json")
    truth = read_poses(folder / "reference.json")
    photos = photos_in(folder / "images")
    centre = (camera.cx, camera.cy) if with_focal else None
    solutions = solve_photos(detector, photos, camera.fx if with_focal else None, centre)
    return _figures(*solutions, np.stack([truth[f"images/{photo.name}"] for photo in photos]))


def _turn(detector: Detector, folder: Path, _: int) -> Figures:
    photos = photos_in(folder / "images")
    by_keypoints, solution = solve_photos(detector, photos, None)
    before = turn_steps(by_keypoints.c2w)[0]
    residual, confused = turn_steps(solution.c2w)
    eye = solution.c2w[np.isfinite(solution.c2w).all((1, 2)), :, 3]
    radius = np.hypot(eye[:, 0], eye[:, 1])
    return {
        "converged": float(solution.status is Status.CONVERGED),
        "step_rms_deg": float(np.sqrt(np.mean(residual**2))),
        "keypoints_step_rms_deg": float(np.sqrt(np.mean(before**2))),
        "refined": _refined(solution),
        "sides_confused": float(confused.sum()),
        "solved": float(_solved(solution)),
        "views": float(len(photos)),
        "radius_rms_percent": 100 * float(radius.std() / radius.mean()),
        "height_rms_percent": 100 * float(eye[:, 2].std() / radius.mean()),
    }


def _parts(detector: Detector, folder: Path, _: int) -> Figures:
    wheels, corners, confused, points, seen = [], [], [], [], 0
    photos = read_part_photos(folder)
    for photo in photos:
        car = main_car(detector, photo.path)
        if car is None:
            continue
        seen += 1
        points.append(int((car.confidence > 0).sum()))
        wheels.append(wheel_errors(photo, car))
        corners.append(part_errors(photo, car))
        confused.append(takes_left_for_right(photo, car))
    told = [answer for answer in confused if answer is not None]
    return {
        "wheels_within_4_percent": 100 * float((np.concatenate(wheels) < 0.04).mean()),
        "corners_within_4_percent": 100 * float((np.concatenate(corners) < 0.04).mean()),
        "photos_confused_percent": 100 * float(np.mean(told)),
        "photos_with_car": 100 * seen / len(photos),
        "points_a_photo": float(np.mean(points)),
    }


def _walk(detector: Detector, folder: Path, seed: int) -> Figures:
    from kronc_ns.benchmark.renders import WALK_FOCAL_PX, rendered_walk

    with TemporaryDirectory(prefix="kronc-walk-") as output:
        photos, truth = rendered_walk(folder, _WALK_VIEWS, seed, Path(output))
        solutions = solve_photos(detector, photos, WALK_FOCAL_PX)
    return {**_figures(*solutions, truth), "converged": float(solutions[1].status is Status.CONVERGED)}


def _false_alarms(detector: Detector, kind: str, _: int) -> Figures:
    from kronc_ns.benchmark.renders import save_all, without_car

    with TemporaryDirectory(prefix="kronc-nothing-") as output:
        files = save_all([without_car(kind, seed) for seed in range(_NOTHINGS)], Path(output))
        found = [len(cars) for cars in detector.detect([CarImage(file) for file in files])]
    return {"cars": float(sum(found))}


def _calibration(detector: Detector, folder: Path, seed: int) -> Figures:
    """Also what the error of each car would be, had the other one been there to calibrate on."""
    from kronc_ns.benchmark.renders import UNSEEN, calibration_error, judged_points, unseen_pictures
    from kronc_ns.training.calibration import rising_knots

    with TemporaryDirectory(prefix="kronc-calibration-") as output:
        said, right = judged_points(detector, unseen_pictures(folder, _CALIBRATION_PICTURES, seed), Path(output))
    cars = [
        (np.concatenate(said[car :: len(UNSEEN)]), np.concatenate(right[car :: len(UNSEEN)]))
        for car in range(len(UNSEEN))
    ]
    by_other = [
        calibration_error(np.interp(confidence, *np.transpose(rising_knots(*other))), correct)
        for (confidence, correct), other in zip(cars, cars[::-1], strict=True)
    ]
    everything, correct = np.concatenate(said), np.concatenate(right)
    return {
        "ece": calibration_error(everything, correct),
        "ece_by_other_car": float(np.mean(by_other)),
        "points": float(len(everything)),
    }


def _drawn_calibration(detector: Detector, seed: int) -> Figures:
    from kronc_ns.benchmark.renders import calibration_error, drawn_pictures, judged_points

    with TemporaryDirectory(prefix="kronc-calibration-") as output:
        said, right = judged_points(detector, drawn_pictures(_CALIBRATION_PICTURES, seed), Path(output))
    everything = np.concatenate(said)
    return {"ece": calibration_error(everything, np.concatenate(right)), "points": float(len(everything))}


_TIMED = """
import json, resource, sys, time
from pathlib import Path
from kronc_ns.capture.detection.builtin.detector import BuiltinDetector
from kronc_ns.capture.detection.detector import CarImage
start = time.perf_counter()
detector = BuiltinDetector(Path(sys.argv[2]) if sys.argv[2] else None)
files = sorted(Path(sys.argv[1]).iterdir())
found = sum(bool(cars) for cars in detector.detect([CarImage(file) for file in files]))
memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
print(json.dumps({"seconds_taken": time.perf_counter() - start, "memory_gb": memory, "with_car": found}))
"""


def _time(weights: Path | None, seed: int) -> Figures:
    from PIL import Image

    from kronc_ns.synthetic.car import build_car
    from kronc_ns.synthetic.render import render_view
    from kronc_ns.synthetic.scenes import default_camera, walk_poses

    with TemporaryDirectory(prefix="kronc-time-") as output:
        c2w = walk_poses(4, np.random.default_rng(seed))
        drawn = [render_view(build_car(), pose, default_camera("walk"), ground=True, samples=1).rgba for pose in c2w]
        for number in range(_FRAMES):
            image = Image.fromarray(drawn[number % len(drawn)][..., :3]).resize(_FRAME_SIZE)
            image.save(Path(output) / f"{number:03d}.jpg")
        command = [sys.executable, "-c", _TIMED, output, str(weights or "")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise KroncError(f"detection in a process of its own failed: {done.stderr.strip().splitlines()[-1]}")
    return {name: float(value) for name, value in json.loads(done.stdout).items()}


def _figures(by_keypoints: Solution, refined: Solution, truth: Float[np.ndarray, "n 3 4"]) -> Figures:
    """Of the poses that are handed on; beside them medians of those by keypoints alone, and which were taken."""
    before = pose_figures(by_keypoints.c2w, truth)
    return {
        **pose_figures(refined.c2w, truth),
        "solved": float(_solved(refined)),
        "keypoints_deg": before["median_deg"],
        "keypoints_cm": before["median_cm"],
        "refined": _refined(refined),
    }


def _refined(solution: Solution) -> float:
    return float(solution.images is not None and solution.images.accepted)


def _solved(solution: Solution) -> int:
    return int(solution.views_that_are(ViewStatus.SOLVED).sum())
