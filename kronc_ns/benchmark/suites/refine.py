"""The suite of refinement: poses from image features on rendered captures and real photos, and whether they harm."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from kronc_ns.benchmark.figures import Figures, pose_figures
from kronc_ns.benchmark.peers.colmap import map_images
from kronc_ns.benchmark.subjects import Subject, from_folder, thinned, with_noise, with_outliers
from kronc_ns.benchmark.suites.degraded import Trouble, degraded, draw_trouble
from kronc_ns.benchmark.suites.pose_measures import INTERVAL
from kronc_ns.benchmark.suites.rows import Limit, Row
from kronc_ns.capture.detection.choice import DetectorOptions
from kronc_ns.capture.detection.finding import find_keypoints
from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import match_keypoints, sigma_of
from kronc_ns.files.photos import photos
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.geometry.alignment import pose_errors, umeyama
from kronc_ns.geometry.poses import posed
from kronc_ns.refine.counter import Counter
from kronc_ns.refine.options import RefineConfig, Region
from kronc_ns.refine.pictures import Pictures
from kronc_ns.refine.pipeline import prepare_scene, refine_scene
from kronc_ns.refine.rounds import find_poses
from kronc_ns.solution import Solution, Status

_HARM_SCENES, _DETECTED = 200, 0.4  # and the share of them with points of the builtin detector
_SHOWN = (
    "before_deg",
    "before_cm",
    "rotation_deg",
    "centre_cm",
    "worst_deg",
    "seconds",
    "rotations_within",
    "centres_within",
)
_PLAIN = Trouble()
_TAKEN = Limit("taken", at_least=1.0)


def refine_rows(captures: Path | None, photo_folder: Path | None) -> tuple[list[Row], list[str]]:
    """Rows of what is there, and what is missing.

    ``captures`` holds rendered ones, ``walk_*``, ``hemi_*`` and ``large_*``; ``photo_folder`` holds spin_suv.
    """
    folders = sorted(path for path in captures.glob("*") if path.is_dir()) if captures else []
    kinds = ("walk_", "hemi_", "large_")
    walks, spheres, large = ([path for path in folders if path.name.startswith(kind)] for kind in kinds)
    rows: list[Row] = []
    missing = []
    if walks:
        rows += _walk_rows(walks)
    else:
        missing.append("no rendered walks: --captures FOLDER with walk_*, made by `kronc synth --render --preset walk`")
    if spheres:
        rows.append(
            Row(
                "hemisphere",
                "100 views on white, keypoints of 1 px",
                len(spheres),
                partial(_measure, spheres),
                (Limit("rotation_deg", at_most=0.12), Limit("centre_cm", at_most=1.1), _TAKEN),
                {"mean": _SHOWN},
            )
        )
        rows.append(_from_truth_row("hemisphere", partial(_from_truth, spheres), len(spheres)))
    if large:
        rows.append(
            Row(
                "seconds, 100 photos",
                "a walk, 1920x1080, keypoints of 1 px",
                len(large),
                partial(_warm, large),
                (Limit("seconds", "worst", at_most=60.0), _TAKEN),
                {"mean": _SHOWN},
            )
        )
    else:
        missing.append(
            "no large walks: --captures FOLDER with large_*, made by `kronc synth --render --preset walk --views 100 "
            "--width 1920`"
        )
    spin = photo_folder / "spin_suv" if photo_folder else None
    if spin is not None and spin.is_dir():
        rows.append(
            Row(
                "turntable of real photos",
                "spin_suv, 36 views, measured keypoints; its reference is good to about 0.3 deg and 6 cm and was made "
                "from the same keypoints; gain: share by which the held-out tracks' median residual falls",
                1,
                partial(_measure, [spin], draw=_Draw(noise_px=0.0)),
                (
                    Limit("rotation_deg", at_most=0.25),
                    Limit("centre_cm", at_most=3.5),
                    Limit("gain", at_least=1 / 3),
                    _TAKEN,
                ),
                {"mean": _SHOWN},
            )
        )
    else:
        missing.append("no spin_suv: --photos FOLDER")
    return rows, missing


def _from_truth_row(name: str, measure: Callable[[int], Figures], seeds: int) -> Row:
    text = "what the features of these photos allow: matched and adjusted from the true poses"
    return Row(f"{name}, from the truth", text, seeds, measure, (), {"mean": ("rotation_deg", "centre_cm")})


def _walk_rows(walks: Sequence[Path]) -> list[Row]:
    rows = []
    count = len(walks)
    for share, deg, centimetres in ((1.0, 0.015, 0.2), (0.5, 0.015, 0.3), (0.25, 0.03, 0.5)):
        rows.append(
            Row(
                f"walk, {100 * share:.0f} % of the photos",
                f"{count} cars, 60 views in a car park, keypoints of 1 px; intervals of {INTERVAL} sigma",
                count,
                partial(_measure, walks, draw=_Draw(share)),
                (Limit("rotation_deg", at_most=deg), Limit("centre_cm", at_most=centimetres), _TAKEN),
                {"mean": _SHOWN},
            )
        )
    white = Trouble(white=True)
    quarter, poor = _Draw(0.25), _Draw(0.25, noise_px=2.0, outliers=0.1)
    return [
        *rows,
        Row(
            "walk, 25 %, poor keypoints",
            "2 px, 10 % of them anywhere on the car's box",
            count,
            partial(_measure, walks, draw=poor),
            (Limit("rotation_deg", at_most=0.03), _TAKEN),
            {"mean": _SHOWN},
        ),
        Row(
            "walk, 25 %, builtin detector",
            "the points that the detector finds in the photos",
            count,
            partial(_measure, walks, draw=_Draw(0.25, detect=True)),
            (Limit("rotation_deg", at_most=0.03), _TAKEN),
            {"mean": _SHOWN},
        ),
        Row(
            "walk, bare photos",
            "all photos and nothing else: the points that the detector finds, the focal length 20 % wrong and refined",
            count,
            partial(_measure, walks, draw=_Draw(detect=True), focal=1.2),
            (
                Limit("rotation_deg", at_most=0.015),
                Limit("centre_cm", at_most=0.2),
                Limit("focal_percent", "worst", at_most=0.2),
                _TAKEN,
            ),
            {"mean": (*_SHOWN, "registered")},
        ),
        Row(
            "vehicle alone",
            "white around it",
            count,
            partial(_measure, walks, trouble=white),
            (Limit("rotation_deg", at_most=0.10), _TAKEN),
            {"mean": _SHOWN},
        ),
        Row(
            "vehicle alone, 25 %",
            "white around it",
            count,
            partial(_measure, walks, draw=quarter, trouble=white),
            (Limit("rotation_deg", at_most=0.25), _TAKEN),
            {"mean": _SHOWN},
        ),
        *(
            _from_truth_row(name, partial(_from_truth, walks, draw=draw, trouble=trouble), count)
            for name, draw, trouble in (
                ("walk, 25 %, poor keypoints", poor, _PLAIN),
                ("walk, 25 %, builtin detector", _Draw(0.25, detect=True), _PLAIN),
                ("vehicle alone", _Draw(), white),
                ("vehicle alone, 25 %", quarter, white),
            )
        ),
        Row(
            "focal length unknown",
            "50 % of the photos, the focal length 20 % wrong and refined",
            count,
            partial(_measure, walks, draw=_Draw(0.5), focal=1.2),
            (Limit("focal_percent", "worst", at_most=0.2), _TAKEN),
            {"mean": _SHOWN},
        ),
        Row(
            "never worse",
            "random views of the walks (3 to all), 0.5 to 3 px and outliers or points of the builtin detector, wrong "
            "focal lengths held fixed or refined, "
            "blur, no texture, a still background with and without masks, people that walk by; harmed: taken though "
            "the mean rotation error rose",
            _HARM_SCENES,
            partial(_harm, walks),
            (Limit("harmed", "total", at_most=0.0),),
            {"total": ("taken", "solved"), "mean": ("before_deg", "rotation_deg")},
        ),
        Row(
            "seconds, 60 photos",
            "640x360; COLMAP: SIFT, exhaustive matching, incremental mapper, in the same run",
            1,
            partial(_against_colmap, walks),
            (Limit("seconds", at_most=12.0), Limit("over_colmap", at_most=0.1)),
            {"mean": ("colmap_seconds", "colmap_deg", "rotation_deg")},
        ),
    ]


@dataclass(frozen=True)
class _Draw:
    """What is left of a capture, and what is known of it."""

    share: float = 1.0
    """Of the photos."""
    noise_px: float = 1.0
    outliers: float = 0.0
    detect: bool = False
    """Points of the builtin detector."""

    def of(self, folder: Path, seed: int) -> Subject:
        subject = from_folder(folder)
        rng = np.random.default_rng([seed, 7])
        subject = thinned(subject, max(3, round(len(subject.truth) * self.share)))
        if self.detect:
            return _detected(subject)
        return with_outliers(with_noise(subject, self.noise_px, rng), self.outliers, rng) if self.noise_px else subject


def _measure(
    folders: Sequence[Path], seed: int, draw: _Draw = _Draw(), focal: float = 1.0, trouble: Trouble = _PLAIN
) -> Figures:
    """One capture: solved from its keypoints, then refined."""
    return _refined(draw.of(folders[seed % len(folders)], seed), focal, trouble, "auto")[0]


def _from_truth(folders: Sequence[Path], seed: int, draw: _Draw = _Draw(), trouble: Trouble = _PLAIN) -> Figures:
    """What the photos' features allow: the same capture, matched and adjusted from the true poses."""
    subject = draw.of(folders[seed % len(folders)], seed)
    solution = solve_scene(subject.scene)
    right = subject.scene.with_sides_swapped(solution.swapped)
    placed = posed(solution.c2w)
    onto = umeyama(subject.truth[placed][..., 3], solution.c2w[placed][..., 3])
    true = replace(solution, c2w=np.where(placed[:, None, None], onto.apply_to_poses(subject.truth), math.nan))
    config, counter = RefineConfig(), Counter(None)
    prepared, _ = prepare_scene(right, true, _pictures(subject, trouble), config, counter)
    found = find_poses(prepared, config, counter)
    if found is None:
        raise KroncError("the photos have too few features in common")
    return pose_figures(found.adjusted.rig.c2w, subject.truth[placed])


def _refined(subject: Subject, focal: float, trouble: Trouble, region: Region) -> tuple[Figures, Solution]:
    scene, pictures = subject.scene, _pictures(subject, trouble)
    true_focal = scene.camera.fx
    if focal != 1.0:
        camera = replace(scene.camera, fx=scene.camera.fx * focal, fy=scene.camera.fy * focal)
        scene = replace(scene, camera=camera)
    unknown = focal != 1.0 and not trouble.focal_held
    solution = solve_scene(scene, KroncConfig(refine_focal=unknown))
    if solution.status is Status.FAILED:
        raise KroncError(f"the keypoints have no solution: {solution.reason}")
    right = scene.with_sides_swapped(solution.swapped)
    begin = time.perf_counter()
    refined = refine_scene(right, solution, pictures, RefineConfig(region, unknown))
    seconds = time.perf_counter() - begin
    before, after = (pose_figures(one.c2w, subject.truth) for one in (solution, refined))
    said = refined.images
    assert said is not None
    figures = {
        **after,
        "before_deg": before["rotation_deg"],
        "before_cm": before["centre_cm"],
        "taken": float(said.accepted),
        "seconds": seconds,
        "focal_percent": 100 * abs(refined.camera.fx / true_focal - 1),
        **_intervals(refined, subject),
    }
    if said.held_out_before_px and said.held_out_after_px:
        figures["gain"] = 1 - said.held_out_after_px / said.held_out_before_px
    return figures, refined


def _intervals(solution: Solution, subject: Subject) -> dict[str, float]:
    """Percentage of the errors that lie within intervals of 95 %."""
    found = np.flatnonzero(posed(solution.c2w))
    if len(found) < 3:
        return {}
    rotation, centre = pose_errors(solution.c2w[found], subject.truth[found])
    sigma = np.array(
        [(v.sigma_rot_deg or math.nan, v.sigma_trans_m or math.nan) for v in (solution.views[i] for i in found)]
    )
    return {
        "rotations_within": 100 * float((rotation <= INTERVAL * sigma[:, 0]).mean()),
        "centres_within": 100 * float((centre <= INTERVAL * sigma[:, 1]).mean()),
    }


def _pictures(subject: Subject, trouble: Trouble) -> Pictures:
    if subject.folder is None:
        raise KroncError(f"{subject.name} has no images")
    return degraded(photos(subject.folder, subject.scene), trouble, len(subject.scene))


def _detected(subject: Subject) -> Subject:
    """With the keypoints that the builtin detector finds in the photos."""
    detector, scene = DetectorOptions().make(default="builtin"), subject.scene
    assert detector is not None
    assert subject.folder is not None
    sizes = [(scene.camera.width, scene.camera.height)] * len(scene)
    found = find_keypoints(detector, subject.folder, scene.names, sizes, scene.masks, lambda *_: None)
    rows, _ = match_keypoints(found, scene.names, scene.camera)
    return replace(subject, scene=replace(scene, keypoints=rows, sigma_px=sigma_of(found, scene.names, rows)))


def _harm(walks: Sequence[Path], seed: int) -> Figures:
    """A random capture with some trouble: whether refined poses were taken though worse."""
    rng = np.random.default_rng([seed, 11])
    subject = from_folder(walks[int(rng.integers(len(walks)))])
    views = int(rng.integers(3, 13)) if rng.random() < 0.5 else int(rng.integers(13, len(subject.truth) + 1))
    subject = thinned(subject, min(views, len(subject.truth)))
    if rng.random() < _DETECTED:
        subject = _detected(subject)
    else:
        subject = with_noise(subject, float(rng.uniform(0.5, 3.0)), rng)
        subject = with_outliers(subject, float(rng.choice([0.0, 0.1, 0.2])), rng)
    trouble = draw_trouble(rng)
    focal = float(rng.uniform(0.8, 1.25)) if trouble.focal_held or rng.random() < 0.2 else 1.0
    try:
        figures, _ = _refined(subject, focal, trouble, "auto")
    except KroncError:
        return {"harmed": 0.0, "taken": 0.0, "solved": 0.0}
    harmed = figures["taken"] > 0 and figures["rotation_deg"] > figures["before_deg"]
    return {**figures, "harmed": float(harmed), "solved": 1.0}


def _warm(folders: Sequence[Path], seed: int) -> Figures:
    """The second of two equal measurements: the first compiles."""
    _measure(folders, seed)
    return _measure(folders, seed)


def _against_colmap(walks: Sequence[Path], seed: int) -> Figures:
    """Refinement and COLMAP on the same photos."""
    folder = walks[seed % len(walks)]
    figures = _warm(walks, seed)
    subject = from_folder(folder)
    begin = time.perf_counter()
    c2w = map_images(subject.scene, folder, "incremental", masked=False)
    seconds = time.perf_counter() - begin
    return {
        **figures,
        "colmap_seconds": seconds,
        "colmap_deg": pose_figures(c2w, subject.truth)["rotation_deg"],
        "over_colmap": figures["seconds"] / seconds,
    }
