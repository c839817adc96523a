#!/usr/bin/env python
"""PSNR of the same training on exact, solved and unoptimised poses of a rendered walk (CPU, about 12 minutes)."""

import json
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

from kronc_ns.benchmark.training import Poses, add_half_size, evaluate, train, write_variant
from kronc_ns.config import load_config
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import make_capture


@dataclass
class Options:
    """Render a walk and train three times."""

    output_dir: Path
    method: str = "kronc-tensorf-cpu"
    views: int = 40
    noise_px: float = 1.0
    """Keypoint noise in the rendered 480x270 frames; training is on half their size."""
    poses: tuple[Poses, ...] = ("exact", "solved", "circle")
    """Which poses to train on."""
    seed: int = 0
    iterations: int | None = None
    """Training iterations (default: the method's)."""


def main(options: Options) -> None:
    """Print one JSON line per kind of poses."""
    capture = make_capture("walk", options.views, options.seed, options.noise_px)
    data = options.output_dir / "capture"
    write_capture(data, capture, render=True)
    add_half_size(data)
    points = torch.from_numpy(capture.car.keypoints)
    extra = [] if options.iterations is None else ["--max-num-iterations", str(options.iterations)]
    for which in options.poses:
        folder = options.output_dir / which
        write_variant(folder, data, which, load_config("phone_walk"), points)
        config = train(folder, options.method, options.output_dir / "runs", extra, ["--downscale-factor", "2"])
        results = evaluate(config, options.output_dir / "renders" / which)
        print(json.dumps({"poses": which, "psnr": results["psnr"], "ssim": results["ssim"]}), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
