"""Fields trained on the poses of several methods, on the full frame and on the vehicle cut out."""

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from rich.console import Console

from kronc_ns.benchmark.commands import Commands
from kronc_ns.benchmark.figures import plain, pose_figures
from kronc_ns.benchmark.machine import hardware, in_words
from kronc_ns.benchmark.peers import adam
from kronc_ns.benchmark.peers.methods import Method, place
from kronc_ns.benchmark.subjects import Subject, from_folder
from kronc_ns.benchmark.tables.rendering import Table
from kronc_ns.benchmark.training import train, write_poses
from kronc_ns.errors import KroncError
from kronc_ns.files.output import atomic_path, write_json
from kronc_ns.fit.starts import circular_poses
from kronc_ns.geometry.alignment import umeyama
from kronc_ns.geometry.poses import posed

PosesOf = Method | Literal["reference", "circle"]
_PAPER = {
    "reference": "29.20 (29.31), COLMAP's poses",
    "colmap-incremental": "29.20 (29.31)",
    "adam": "19.41 (21.89)",
    "circle": "12.0 on its easiest scene",
}
"""PSNR, full frame (vehicle), means over the seven real scenes of the paper."""


@dataclass(kw_only=True)
class FieldOptions:
    """What is trained, and on which poses."""

    output_dir: Path
    """New or empty folder for the table (fields.md, fields.json), the data sets and the runs."""
    captures: tuple[Path, ...]
    """Scene folders with images, masks and poses to compare with in reference.json."""
    poses: tuple[PosesOf, ...] = ("reference", "kronc", "adam", "colmap-incremental", "circle")
    """Whose poses; all but the reference's are found without a start (Adam begins on the circle)."""
    method: str = "kronc-splatfacto-cpu"
    """Method of `ns-train`."""
    backgrounds: tuple[Literal["keep", "white"], ...] = ("keep", "white")
    """keep: trained and tested on the full frame; white: on the vehicle, cut out."""
    downscale_factor: int = 1
    """Train and test on images smaller by this factor (1, 2, 4 or 8); poses are found from the full size."""
    iterations: int | None = None
    """Training steps (default: the method's)."""


def make_field_table(options: FieldOptions) -> None:
    """Train and test on all of them; print the table, which is written after every row."""
    if options.output_dir.exists() and any(options.output_dir.iterdir()):
        raise KroncError(f"{options.output_dir} is in use: expected a new or empty folder")
    begin, machine, text = time.perf_counter(), hardware(), ""
    rows: list[dict[str, Any]] = []
    with Commands({"KRONC_NS_CACHE": str(options.output_dir.resolve() / "cache")}) as commands:
        for folder in options.captures:
            subject = from_folder(folder)
            for poses in options.poses:
                rows.append(_row(subject, poses, options, commands))
                print(" | ".join(rows[-1]["cells"]), file=sys.stderr)
                text = _write(rows, options, machine, time.perf_counter() - begin)
    Console(soft_wrap=True).print(text, markup=False, highlight=False)


def _write(rows: Sequence[Mapping[str, Any]], options: FieldOptions, machine: Mapping[str, Any], seconds: float) -> str:
    """Write what there is of the table; its Markdown."""
    about = (
        "PSNR (dB) / SSIM of the full frame (of the vehicle) over the test views; keep: trained on the full frame, "
        f"white: on the vehicle cut out; a dash: fewer than three views placed. `{options.method}`, images 1/"
        f"{options.downscale_factor} in size, every 8th view for testing, {in_words(machine)}; {seconds:.0f} s in all."
    )
    text = Table(
        "Fields on the poses of several methods",
        ["capture", "poses", "views placed", "rotation, centre (median)", *options.backgrounds, "paper"],
        [[*row["cells"], _PAPER.get(row["poses"], "-")] for row in rows],
        about,
    ).markdown()
    with atomic_path(options.output_dir / "fields.md") as path:
        path.write_text(text, encoding="utf-8")
    write_json(options.output_dir / "fields.json", plain({"hardware": machine, "seconds": seconds, "rows": rows}))
    return text


def _row(subject: Subject, poses: PosesOf, options: FieldOptions, commands: Commands) -> dict[str, Any]:
    c2w, errors = _poses(subject, poses)
    row = {"capture": subject.name, "poses": poses, "errors": errors, "results": {}}
    placed = f"{100 * errors['registered']:.0f} %"
    if math.isnan(errors["median_deg"]):
        return {**row, "cells": [subject.name, poses, placed, "-", *("-" for _ in options.backgrounds)]}
    data = options.output_dir / subject.name / poses
    assert subject.folder is not None
    write_poses(data, subject.folder, subject.scene, c2w, subject.points)
    results: dict[str, Any] = {}
    steps = [] if options.iterations is None else ["--max-num-iterations", str(options.iterations)]
    for background in options.backgrounds:
        parser = ["--background", background, "--downscale-factor", str(options.downscale_factor)]
        config = train(data, options.method, data / "runs" / background, steps, parser, commands)
        pictures = data / "pictures" / background
        output = commands.run("kronc", "eval", "--nvs", str(config), "--pictures", str(pictures), "--json")
        results[background] = {name: json.loads(output)[name] for name in ("full", "masked")}
    apart = f"{errors['median_deg']:.2f} deg, {errors['median_cm']:.1f} cm"
    cells = [subject.name, poses, placed, apart, *(_psnr(results[name]) for name in options.backgrounds)]
    return {**row, "results": results, "cells": cells}


def _poses(subject: Subject, poses: PosesOf) -> tuple[Float[np.ndarray, "n 3 4"], dict[str, float]]:
    """Poses in the frame of the reference, and their errors (NaN below three views, which nothing aligns)."""
    if poses == "reference":
        c2w = subject.truth
    elif poses == "circle":
        circle = adam.FROM_CIRCLE
        c2w = circular_poses(len(subject.truth), circle.radius_m, circle.direction, circle.laps)
    else:
        c2w = place(poses, subject, None, adam.FROM_CIRCLE if poses == "adam" else None).c2w
    found = posed(c2w)
    if found.sum() >= 3:
        c2w = umeyama(c2w[found][..., 3], subject.truth[found][..., 3]).apply_to_poses(c2w)
    return c2w, pose_figures(c2w, subject.truth)


def _psnr(results: dict[str, Any]) -> str:
    def cell(metrics: dict[str, Any] | None) -> str:
        return "-" if metrics is None else f"{metrics['psnr']:.2f} / {metrics['ssim']:.3f}"

    return f"{cell(results['full'])} ({cell(results['masked'])})"
