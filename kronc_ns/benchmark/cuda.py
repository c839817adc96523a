"""Do the CUDA paths work, and what are they worth? For a bare machine with a GPU: `scripts/check_cuda`.

Needs torch, numba, numpy and jaxtyping; what else is missing is skipped and said.
"""

import argparse
import importlib.util
import json
import math
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from kronc_ns.fit.attempts import problem_of
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene, solve_scenes
from kronc_ns.fit.starts import circular_poses, start_from_poses
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.geometry.camera import Camera, reproject
from kronc_ns.geometry.poses import compose, make_pose, unit
from kronc_ns.geometry.rotations import rotation_angle_deg, so3_exp
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.keypoints.template import car_template
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution
from kronc_ns.solve.lm import adjust
from kronc_ns.solve.problem import Intrinsic, State

_LIMIT_S = 480.0
_SAME_DEG = 1e-6
"""Two solvers that compute the same in float64 differ by less."""
_METHODS = ("kronc-splatfacto", "kronc-tensorf", "kronc-dvgo")
_STEPS = 300

Figures = dict[str, float | int | str | bool]


class Skipped(Exception):
    """A check that cannot be made here, and why."""


@dataclass(frozen=True)
class Options:
    """How large the checks are."""

    device: str
    scenes: int
    adam_steps: int
    views: int


def capture(seed: int, views: int) -> tuple[Scene, Float[np.ndarray, "n 3 4"]]:
    """A lap around the template car with 1 px of noise, poses off by (4 deg, 0.5 m); and the true poses."""
    template = car_template(APOLLOCAR3D_66)
    assert template is not None
    rng = np.random.default_rng(seed)
    camera = Camera(500.0, 500.0, 320.0, 180.0, 640, 360)
    truth = circular_poses(views, radius_m=rng.uniform(5, 7))
    truth[:, 2, 3] += rng.uniform(1.0, 2.0)
    ray = unit(truth[:, None, :, 3] - template.mean)
    facing = np.einsum("njc,jc->nj", ray, template.normals) > 0.1
    uv = reproject(template.mean, truth, camera) + rng.normal(size=(*facing.shape, 2))
    seen = facing & (uv > 0).all(-1) & (uv < (camera.width, camera.height)).all(-1)
    keypoints = np.concatenate([np.where(seen[..., None], uv, 0.0), seen[..., None].astype(float)], axis=-1)
    noise = rng.normal(size=(views, 6)) * ([math.radians(4.0)] * 3 + [0.5] * 3)
    given = compose(truth, make_pose(so3_exp(noise[:, :3]), noise[:, 3:]))
    names = tuple(f"images/frame_{i + 1:05d}.png" for i in range(views))
    return Scene(names, camera, APOLLOCAR3D_66, keypoints, given), truth


def batched_against_compiled(options: Options) -> Figures:
    """The tensors' poses of scenes of several sizes against the compiled solver's."""
    from kronc_ns.solve.batched import adjust_batch

    scenes = [capture(seed, options.views - 7 * seed)[0] for seed in range(6)]
    starts = [start_from_poses("given", "given", s, s.given_c2w) for s in scenes if s.given_c2w is not None]
    worst: Figures = {}
    cases: dict[str, tuple[Intrinsic, ...]] = {"": (), " with focal length and k1": ("focal", "k1")}
    for name, refine in cases.items():
        problems = [problem_of(start, refine) for start in starts]
        states = [State.of(start.c2w, start.points) for start in starts]
        ours = [adjust(problem, state).state.c2w for problem, state in zip(problems, states, strict=True)]
        tensors = [found.state.c2w for found in adjust_batch(problems, states, device=options.device)]
        off = [
            float(rotation_angle_deg(a[..., :3].swapaxes(1, 2) @ b[..., :3]).max())
            for a, b in zip(ours, tensors, strict=True)
        ]
        worst[f"largest difference{name}, deg"] = max(off)
    return {**worst, "same": max(float(value) for value in worst.values()) <= _SAME_DEG}


def scenes_per_second(options: Options) -> Figures:
    """Many scenes by the tensors, and by the compiled solver on all cores of this machine."""
    scenes = [capture(seed, options.views)[0] for seed in range(min(options.scenes, 20))]
    scenes = [scenes[i % len(scenes)] for i in range(options.scenes)]
    rates: Figures = {}
    for device in (options.device, "cpu") if options.device != "cpu" else ("cpu",):
        config = KroncConfig(init="given", device="cuda" if device == "cuda" else "cpu")
        solve_scenes(scenes[:2], config)
        start = time.perf_counter()
        solve_scenes(scenes, config)
        rates[f"scenes/s, {device}"] = len(scenes) / (time.perf_counter() - start)
    return {"scenes": len(scenes), "views": options.views, **rates}


def adam(options: Options) -> Figures:
    """Algorithm 1 of the paper on the device: seconds, and how far it ends from the CPU's."""
    scene, truth = capture(0, options.views)
    config = KroncConfig(solver="adam", init="given")
    config = replace(config, adam=replace(config.adam, steps=options.adam_steps))
    solve_scene(scene, replace(config, adam=replace(config.adam, steps=1)))  # what is loaded once

    def errors(solution: Solution) -> tuple[float, float]:
        rotation, centre = pose_errors(solution.c2w, truth)
        return float(rotation.mean()), 100 * float(centre.mean())

    figures: Figures = {"steps": options.adam_steps}
    for device in (options.device, "cpu") if options.device != "cpu" else ("cpu",):
        start = time.perf_counter()
        solution = solve_scene(scene, replace(config, device="cuda" if device == "cuda" else "cpu"))
        figures[f"seconds, {device}"] = time.perf_counter() - start
        figures[f"rotation, deg, {device}"], figures[f"centre, cm, {device}"] = errors(solution)
    return figures


def training(options: Options, method: str, limit_s: float) -> Figures:
    """Steps of a method made for a GPU on a rendered capture, from keypoints to a checkpoint."""
    missing = [name for name in ("nerfstudio", "trimesh", "embreex") if importlib.util.find_spec(name) is None]
    if missing or shutil.which("ns-train") is None:
        raise Skipped(f"{', '.join(missing) or 'ns-train'} is not installed: pip install kronc-ns")
    if options.device != "cuda":
        raise Skipped("made for a GPU")
    with tempfile.TemporaryDirectory() as folder:
        car, out = Path(folder) / "car", Path(folder) / "out"
        _run([sys.executable, "-m", "kronc_ns.commands.main", "synth", "--render", "--preset", "walk", "--views", "40",
              "--width", "320", "--noise-px", "0.5", "--output-dir", str(car)], limit_s)  # fmt: skip
        start = time.perf_counter()
        _run(["ns-train", method, "--data", str(car), "--output-dir", str(out), "--vis", "tensorboard",
              "--max-num-iterations", str(_STEPS), "kronc-dataparser"], limit_s)  # fmt: skip
        return {"steps": _STEPS, "seconds": time.perf_counter() - start}


def _run(command: Sequence[str], limit_s: float) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=max(1.0, limit_s))
    except subprocess.TimeoutExpired:
        raise Skipped(f"{command[0]} ran out of the time that was left") from None
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip() or "no output").splitlines()[-1]
        raise RuntimeError(f"{' '.join(command[:2])} exited with {done.returncode}: {last}")


def run_checks(options: Options) -> dict[str, dict[str, Any]]:
    """Every check by name: its figures, or why there are none."""
    began = time.perf_counter()
    checks: dict[str, Callable[[], Figures]] = {
        "batched solver against the compiled one": lambda: batched_against_compiled(options),
        "scenes a second": lambda: scenes_per_second(options),
        "Adam, the paper's steps": lambda: adam(options),
    }
    for method in _METHODS:
        checks[f"train {method}"] = lambda method=method: training(
            options, method, _LIMIT_S - (time.perf_counter() - began)
        )
    results: dict[str, dict[str, Any]] = {}
    for name, check in checks.items():
        start = time.perf_counter()
        try:
            results[name] = dict(check())
        except Skipped as reason:
            results[name] = {"skipped": str(reason)}
        except Exception as error:  # one path that fails must not hide what the others do
            results[name] = {"failed": f"{type(error).__name__}: {error}"}
        results[name]["took_s"] = time.perf_counter() - start
        print(_line(name, results[name]), flush=True)
    return results


def _line(name: str, figures: dict[str, Any]) -> str:
    shown = (f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in figures.items())
    return f"| {name} | {'; '.join(shown)} |"


def main() -> int:
    """Exit status 0 when nothing failed, 1 else; 2 without a GPU."""
    import torch

    parser = argparse.ArgumentParser(prog="check_cuda", description=__doc__)
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda", help="cpu: to try this command itself")
    parser.add_argument("--scenes", type=int, default=1000, help="scenes of the measurement of throughput")
    parser.add_argument("--adam-steps", type=int, default=10_000)
    parser.add_argument("--views", type=int, default=100)
    parser.add_argument("--json", type=Path, help="where to write the figures as JSON, too")
    given = parser.parse_args()
    if given.device == "cuda" and not torch.cuda.is_available():
        print("error: torch finds no CUDA GPU: run this on a machine that has one", file=sys.stderr)
        return 2
    machine = {
        "gpu": torch.cuda.get_device_name() if given.device == "cuda" else None,
        "torch": torch.__version__,
        "python": sys.version.split()[0],
    }
    print("| check | figures |\n| --- | --- |")
    results = run_checks(Options(given.device, given.scenes, given.adam_steps, given.views))
    text = json.dumps({"machine": machine, "checks": results}, indent=1)
    if given.json is not None:
        given.json.write_text(text + "\n")
    print(text)
    wrong = [name for name, figures in results.items() if "failed" in figures or figures.get("same") is False]
    if wrong:
        print(f"failed: {', '.join(wrong)}", file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
