#!/usr/bin/env python
"""Accuracy of the paper's solver: `python scripts/reproduce_poses.py [--seeds N] [--capture SCENE_FOLDER] [--json]`."""

import json
import platform
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from kronc_ns.benchmark.poses import SETTINGS, measure, measure_folder
from kronc_ns.config import load_config


@dataclass
class Options:
    """Solve synthetic captures of report seeds 0, 1, ... and, if given, a real capture with a reference.json."""

    seeds: int = 3
    capture: Path | None = None
    config: str = "turntable"
    """Preset for the real capture."""
    json: bool = False


def main(options: Options) -> None:
    """Print a Markdown table, or JSON lines."""
    torch.set_num_threads(1)
    runs = [(s.name, seed, measure(s, seed)) for s in SETTINGS for seed in range(options.seeds)]
    if options.capture is not None:
        runs.append(
            (
                options.capture.name,
                0,
                measure_folder(options.capture, load_config(options.config, solver="adam", init="circular")),
            )
        )
    if options.json:
        for name, seed, figures in runs:
            print(json.dumps({"setting": name, "seed": seed, **figures}))
        return
    print(f"one CPU core, {platform.machine()}, torch {torch.__version__}\n")
    print("| setting | seed | views | rotation mean / median (deg) | centre mean / median (cm) | s | steps/s | best |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, seed, f in runs:
        degrees = " / ".join(f"{f['rotation_deg'][which]:.4f}" for which in ("mean", "median"))
        centimetres = " / ".join(f"{100 * f['translation'][which]:.2f}" for which in ("mean", "median"))
        views, speed = f"{f['registered']}/{f['views']}", f"{f['seconds']:.1f} | {f['steps_per_s']:.0f}"
        best = ""
        if "maximum_likelihood" in f:
            bound = f["maximum_likelihood"]
            best = f"{bound['rotation_deg']['median']:.3f} deg, {100 * bound['translation']['median']:.2f} cm"
        print(f"| {name} | {seed} | {views} | {degrees} | {centimetres} | {speed} | {best} |")
    print("\nbest: median error of the maximum-likelihood solution started from the truth")


if __name__ == "__main__":
    main(tyro.cli(Options))
