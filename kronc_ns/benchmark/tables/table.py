"""A table: one row a setting, means over all subjects; written as Markdown for readers and as JSON with every run."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from kronc_ns.benchmark.figures import Figures, plain
from kronc_ns.benchmark.machine import hardware, in_words
from kronc_ns.benchmark.paper import START
from kronc_ns.benchmark.peers.methods import Method, place
from kronc_ns.benchmark.subjects import Subject, from_folder, procedural, thinned, with_noise
from kronc_ns.benchmark.tables.rendering import Table, number
from kronc_ns.commands.console import progress_bar
from kronc_ns.errors import KroncError
from kronc_ns.files.output import atomic_path, write_json
from kronc_ns.fit.options import KroncConfig
from kronc_ns.geometry.poses import camera_z
from kronc_ns.synthetic.variations import noisy_poses


@dataclass(kw_only=True)
class TableOptions:
    """On what a table is measured."""

    output_dir: Path
    """Folder for the table, as NAME.md and NAME.json."""
    captures: tuple[Path, ...] = ()
    """Scene folders with true poses in reference.json; default: procedural cars with keypoints alone."""
    cars: int = 5
    """Number of procedural cars."""
    noise_px: tuple[float, ...] = (0.0, 1.0)
    """Noise added to the keypoints: standard deviation along each axis, in pixels of the capture (0 for keypoints that
    were measured)."""
    methods: tuple[Method, ...] = ()
    """Only rows of these methods; default: all that the table has."""
    first_seed: int = 0
    """Seed of the first subject's noise and, of procedural cars, shape."""

    def subjects(self) -> list[Subject]:
        """Captures, or cars."""
        if self.first_seed < 0:
            raise KroncError(f"--first-seed is {self.first_seed}: expected 0 or more")
        for noise in self.noise_px:
            if not 0 <= noise < math.inf:
                raise KroncError(f"--noise-px holds {noise}: expected finite standard deviations, 0 or more")
        if self.captures:
            return [from_folder(folder) for folder in self.captures]
        if self.cars < 1:
            raise KroncError(f"--cars {self.cars}: expected 1 or more")
        return [procedural(self.first_seed + i) for i in range(self.cars)]


@dataclass(frozen=True)
class Setting:
    """One row: a method, and what it is given."""

    labels: Mapping[str, str]
    """The first columns."""
    method: Method
    noise_px: float
    start: tuple[float, float] | None = START
    """Noise of the poses to start from (degrees, metres); None: no poses are given."""
    config: KroncConfig | None = None
    """Settings of kronc and adam other than their defaults."""
    views: Callable[[int], int] = int
    """How many of a capture's views take part."""
    depth_noise: float | None = None
    """Relative noise of the depths that are given, for each view and for each keypoint; None: none are given."""
    paper: Mapping[str, str] = field(default_factory=dict)
    """The last columns: what the paper has here."""


def make_table(
    name: str, title: str, options: TableOptions, settings: Callable[[TableOptions], Sequence[Setting]]
) -> None:
    """Measure all settings on all subjects; print the table, which is written after every row."""
    begin, text = time.perf_counter(), ""
    machine, subjects = hardware(), options.subjects()
    chosen = [row for row in settings(options) if row.method in (options.methods or (row.method,))]
    if not chosen:
        raise KroncError(f"--methods {' '.join(map(repr, options.methods))}: {name} has no row of these")
    rows: list[dict[str, Any]] = []
    with progress_bar(name) as progress:
        for done, setting in enumerate(chosen):
            progress(done, len(chosen), None)
            runs = [_run(setting, subject, options.first_seed + i) for i, subject in enumerate(subjects)]
            names = [subject.name for subject in subjects]
            rows.append(
                {
                    "labels": dict(setting.labels),
                    **_means(runs),
                    "paper": dict(setting.paper),
                    "runs": dict(zip(names, runs, strict=True)),
                }
            )
            text = _write(name, title, options, subjects, machine, rows, time.perf_counter() - begin)
    Console(soft_wrap=True).print(text, markup=False, highlight=False)


def _write(
    name: str,
    title: str,
    options: TableOptions,
    subjects: Sequence[Subject],
    machine: Mapping[str, Any],
    rows: Sequence[Mapping[str, Any]],
    seconds: float,
) -> str:
    """Write what there is of a table; its Markdown."""
    about = (
        f"{len(subjects)} captures ({', '.join(subject.name for subject in subjects)}), seeds from "
        f"{options.first_seed} on; {in_words(machine)}; {seconds:.0f} s in all. Errors: means over the captures of "
        "each one's mean / median / worst view; seconds and megabytes are those of one capture."
    )
    text = in_columns(title, rows, about).markdown()
    with atomic_path(options.output_dir / f"{name}.md") as path:
        path.write_text(text, encoding="utf-8")
    content = {"table": name, "title": title, "hardware": machine, "seconds": seconds, "rows": rows}
    write_json(options.output_dir / f"{name}.json", plain(content))
    return text


def in_columns(title: str, rows: Sequence[Mapping[str, Any]], about: str) -> Table:
    """The rows' figures in columns."""
    papers = list(dict.fromkeys(name for row in rows for name in row["paper"]))
    errors = ("rotation (deg)", "centre (cm)", "AUC 3 / 5 / 30 deg")
    lines = []
    for row in rows:
        three = [
            " / ".join(number(row[key]) for key in keys)
            for keys in (
                ("rotation_deg", "median_deg", "worst_deg"),
                ("centre_cm", "median_cm", "worst_cm"),
                ("auc_3", "auc_5", "auc_30"),
            )
        ]
        placed = f"{100 * row['registered']:.0f} %"
        cost = [number(row["seconds"]), number(row["megabytes"])]
        lines.append([*row["labels"].values(), placed, *three, *cost, *(row["paper"].get(x, "-") for x in papers)])
    return Table(title, [*rows[0]["labels"], "views placed", *errors, "s", "MB", *papers], lines, about)


def _run(setting: Setting, subject: Subject, seed: int) -> dict[str, float]:
    """Figures of a setting on a subject; of a seed the noise of each kind is the same in every setting."""
    pixels, poses, distances = (np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(3))
    subject = with_noise(thinned(subject, setting.views(len(subject.truth))), setting.noise_px, pixels)
    start = None
    if setting.start is not None:
        start = noisy_poses(subject.truth, *setting.start, poses)
    if setting.depth_noise is not None:
        depths = camera_z(subject.truth, subject.points)
        noise = distances.normal(size=(len(depths), 1)) + distances.normal(size=depths.shape)
        depths = depths * np.exp(setting.depth_noise * noise)
        subject = replace(subject, scene=replace(subject.scene, given_depths=depths))
    try:
        return place(setting.method, subject, start, setting.config).figures(subject.truth)
    except KroncError as error:
        raise KroncError(f"{', '.join(setting.labels.values())} on {subject.name}: {error}") from None


def _means(runs: Sequence[Figures]) -> dict[str, float]:
    """Means over the runs; of the errors over those that placed views enough to have any."""
    means = {}
    for name in runs[0]:
        values = [run[name] for run in runs if math.isfinite(run[name])]
        means[name] = sum(values) / len(values) if values else math.nan
    return means
