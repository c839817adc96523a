"""`kronc report`: a solved folder as one HTML file that needs nothing else, neither network nor neighbours."""

import math
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from kronc_ns.errors import KroncError
from kronc_ns.files.output import REPORT_FILE, atomic_path, is_report
from kronc_ns.files.record import read_record, read_solution
from kronc_ns.fit.verdict import inliers
from kronc_ns.scene import Scene
from kronc_ns.show.report import figures
from kronc_ns.show.report.overlays import choose_views, overlay
from kronc_ns.show.report.templates import render, source
from kronc_ns.solution import ImageEvidence, Solution, Status, ViewStatus

_VERDICT = {
    Status.CONVERGED: "the poses can be trusted",
    Status.WEAK: "the poses may be wrong: look before you train on them",
    Status.FAILED: "there are no poses to train on",
}


def write_report(folder: Path) -> Path:
    """Write report.html into a solved ``folder`` and return its path.

    Raises `KroncError` where the folder is not solved, a file of it is broken, or report.html is somebody else's.
    """
    target = folder / REPORT_FILE
    record = read_record(folder)
    scene, solution = read_solution(folder)
    if target.exists() and not is_report(target):
        raise KroncError(f"{target} was not written by kronc: move it away, then repeat `kronc report`")
    page = _page(record, scene, solution, folder)
    with atomic_path(target) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return target


def _page(record: dict[str, Any], scene: Scene, solution: Solution, folder: Path) -> str:
    error, inlier = inliers(scene, solution)
    overlays = [overlay(kind, i, scene, solution, inlier, folder) for kind, i in choose_views(solution)]
    plots = {
        "cameras": figures.cameras_3d(scene, solution),
        "residuals": figures.residual_histogram(error, inlier),
        "convergence": figures.convergence(solution),
        "uncertainties": figures.uncertainties(solution.views),
    }
    return render(
        "page.html",
        title=folder.resolve().name,
        record=record,
        solution=solution,
        verdict=_VERDICT[solution.status],
        facts=_facts(scene, solution),
        image_facts=_image_facts(solution.images),
        left_out=_left_out(scene, solution, error, inlier),
        overlays=overlays,
        without_image=sum(not shown.image for shown in overlays),
        plots={name: None if plot is None else _json(str(plot.to_json())) for name, plot in plots.items()},
        plotly=Markup(get_plotlyjs().replace("</script", r"<\/script")),
        style=source("page.css") + source("overlay.css"),
        script=source("page.js"),
    )


def _facts(scene: Scene, solution: Solution) -> list[tuple[str, str, str]]:
    """(what, figure, remark) of the summary."""
    views = solution.views
    count = {status: sum(view.status is status for view in views) for status in ViewStatus}
    others = [
        f"{count[status]} {status.value}" for status in (ViewStatus.COMPLETED, ViewStatus.FAILED) if count[status]
    ]
    facts = [
        ("views solved", f"{count[ViewStatus.SOLVED]} of {len(views)}", ", ".join(others) or "none left out"),
        ("reprojection RMSE", _px(solution.rmse_px), f"of the explained; median of all {_px(solution.median_px)}"),
    ]
    sigmas = [(v.sigma_rot_deg, v.sigma_trans_m) for v in views if v.status is ViewStatus.SOLVED]
    rotation = [rotation for rotation, _ in sigmas if rotation is not None]
    centre = [centre for _, centre in sigmas if centre is not None]
    if rotation and centre:
        worst = f"worst {max(rotation):.2f}°, {100 * max(centre):.1f} cm"
        typical = f"{statistics.median(rotation):.2f}°, {100 * statistics.median(centre):.1f} cm"
        facts.append(("standard deviation", typical, f"median view; {worst}"))
    return [
        *facts,
        _focal(solution),
        (
            "keypoints a view",
            f"{float(scene.visibility.sum(1).mean()):.1f}",
            f"of {len(scene.schema)}, {scene.schema.name}",
        ),
        (
            "solver",
            solution.solver,
            f"from {solution.init} poses, {solution.iterations} steps, {solution.seconds:.2f} s",
        ),
    ]


def _image_facts(said: ImageEvidence | None) -> list[tuple[str, str]]:
    """What image features said, in words."""
    if said is None:
        return []
    tracks = [f"{count} of {length}" for length, count in enumerate(said.tracks_by_length) if count and length < 8]
    longer = sum(said.tracks_by_length[8:])
    seen = [count for count in said.observations if count]
    facts = [
        ("features were used", "on the vehicle alone" if said.region == "vehicle" else "in the whole frame"),
        ("background", "stands still while the car turns" if said.background_still else "moves as the car does"),
        ("tracks, by the views that see them", ", ".join([*tracks, *([f"{longer} of 8 or more"] if longer else [])])),
        ("sightings of a view", f"median {statistics.median(seen):.0f}, least {min(seen)}" if seen else "none"),
        ("tracks held out", str(said.held_out)),
        (
            "their residual, before and after",
            f"{_or_unknown(said.held_out_before_px)}, {_or_unknown(said.held_out_after_px)}",
        ),
        ("they are met better by", f"{said.held_out_z:.1f} standard deviations"),
        ("keypoints' chi-square", f"{said.keypoints_z:+.1f} standard deviations off what is expected"),
        ("noise of a feature", _or_unknown(said.noise_px)),
        ("focal length, before and after", f"{said.focal_before_px:.2f} px, {said.focal_after_px:.2f} px"),
        ("time", f"{said.seconds:.1f} s"),
    ]
    return [(what, value) for what, value in facts if value]


def _or_unknown(value: float | None) -> str:
    return "unknown" if value is None else _px(value)


def _focal(solution: Solution) -> tuple[str, str, str]:
    """Of all cameras."""
    cameras = (solution.camera,) if solution.lenses is None else solution.lenses.cameras
    sizes = dict.fromkeys(f"{camera.width} × {camera.height}" for camera in cameras)
    what, images = ("focal length", "image") if len(cameras) == 1 else ("focal lengths", "images")
    return (what, f"{', '.join(f'{camera.fx:.1f}' for camera in cameras)} px", f"{images} {', '.join(sizes)}")


def _px(value: float) -> str:
    return f"{value:.2f} px" if math.isfinite(value) else "unknown"


def _left_out(
    scene: Scene, solution: Solution, error: Float[np.ndarray, "n j"], inlier: Bool[np.ndarray, "n j"]
) -> list[tuple[str, Sequence[str]]]:
    """What has no part in the solution or not as it was given, with its number, and the names."""
    views = solution.views
    known = int((~np.isnan(error)).sum())
    odd = known - int(inlier.sum())
    failed = [f"{view.name}: {view.reason}" for view in views if view.status is ViewStatus.FAILED]
    completed = [f"{view.name}: {view.reason}" for view in views if view.status is ViewStatus.COMPLETED]
    swapped = [view.name for view in views if view.swapped]
    missing = (~np.isfinite(solution.points).all(-1)).tolist()
    unknown = [name for name, unsolved in zip(scene.schema.keypoints, missing, strict=True) if unsolved]
    said = [
        ("Views without a pose, which are not in transforms.json", failed),
        ("Views hardly known, or placed between their neighbours (--min-status solved omits them)", completed),
        ("Views in which left and right were confused, and put right", swapped),
        ("Keypoints without a position, seen by too few solved views", unknown),
    ]
    listed: list[tuple[str, Sequence[str]]] = [(f"{what}: {len(names)}", names) for what, names in said if names]
    if odd:
        listed.append(
            (f"Detections that are not explained (outliers): {odd} of {known}, {100 * odd / known:.1f} %", ())
        )
    return listed


def _json(text: str) -> Markup:
    """JSON that may stand in a script element, whatever names are in it."""
    return Markup(text.replace("&", r"\u0026").replace("<", r"\u003c").replace(">", r"\u003e"))
