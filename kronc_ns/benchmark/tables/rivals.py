"""Poses from keypoints beside those that radiance fields find by images alone, from ever noisier starts."""

import json
import math
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float
from rich.console import Console

from kronc_ns.benchmark import paper
from kronc_ns.benchmark.commands import Commands
from kronc_ns.benchmark.figures import plain, pose_figures
from kronc_ns.benchmark.machine import hardware, in_words
from kronc_ns.benchmark.peers.methods import place
from kronc_ns.benchmark.subjects import Subject, capture_scene
from kronc_ns.benchmark.tables.rendering import Table, number
from kronc_ns.benchmark.training import train, write_poses
from kronc_ns.files.output import MARKER, atomic_path, read_json, write_json
from kronc_ns.files.transforms import read_poses
from kronc_ns.metrics.poses import evaluate_poses
from kronc_ns.scene import Scene
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import Capture, default_camera, make_capture
from kronc_ns.synthetic.variations import noisy_poses

Rival = Literal["start", "kronc", "adam", "barf", "l2g-nerf", "tensorf", "dvgo", "splatfacto"]
"""start: a field on the noisy poses as they are; kronc, adam: a field on poses solved from keypoints; barf, l2g-nerf,
and tensorf, dvgo, splatfacto with nerfstudio's camera optimizer (SO3xR3): fields that find poses by images."""
_TESTED_EVERY = 5
_KEYPOINT_WIDTH = 400  # of the paper's images, in whose pixels noise is given
_PAPER_ROWS = {"adam": paper.BY_NOISE, "l2g-nerf": paper.L2G_BY_NOISE}


@dataclass(kw_only=True)
class RivalOptions:
    """Which starts, methods and photos."""

    output_dir: Path
    """Folder for the table (rivals.md, rivals.json), the captures and the runs. Rows that are there already with these
    settings are kept, so that the same command goes on where it stopped."""
    noise: tuple[tuple[float, float], ...] = ((2.0, 0.2), (4.0, 0.5), (5.0, 1.5))
    """Noise of the poses to start from, degrees and metres: --noise 4 0.5 5 1.5 is two rows."""
    methods: tuple[Rival, ...] = ("start", "kronc", "adam", "barf", "l2g-nerf", "tensorf", "dvgo", "splatfacto")
    """Only rows of these."""
    views: int = 40
    """Photos of the car, rendered from a hemisphere; every fifth is a test view."""
    width: int = 100
    """Their width and height in pixels."""
    noise_px: float = 1.0
    """Noise of the keypoints along each axis, in pixels of an image of 400x400 (the paper's)."""
    gpu: bool = False
    """Train the methods for a GPU instead of those sized for two cores."""
    field: Literal["tensorf", "dvgo", "splatfacto"] = "tensorf"
    """What is trained on poses that do not come from a field."""
    iterations: int | None = None
    """Training steps (default: each method's)."""
    seed: int = 0
    """Seed of the car, the cameras and all noise."""


def make_rival_table(options: RivalOptions) -> None:
    """Make the rows that are missing, one at a time; print the table, which is written after every row."""
    cache = options.output_dir.resolve() / "cache"
    rows: list[dict[str, Any]] = []
    text = ""
    with Commands({"KRONC_NS_CACHE": str(cache)}) as commands:
        for noise in options.noise:
            for method in options.methods:
                rows.append(_row(options, noise, method, commands))
                text = _write(rows, options)
    Console(soft_wrap=True).print(text, markup=False, highlight=False)


def _row(options: RivalOptions, noise: tuple[float, float], method: Rival, commands: Commands) -> dict[str, Any]:
    """A row that was made with these settings before, or is made now."""
    settings = _settings(options, noise, method)
    photos = f"{options.views}x{options.width}px_{options.noise_px:g}px_seed{options.seed}"
    name = f"{noise[0]:g}deg_{noise[1]:g}m_{photos}"
    file = options.output_dir / "rows" / f"{name}_{method}.json"
    if file.is_file():
        row = read_json(file)
        if row.get("settings") == settings:
            return row
    trial = _Trial(options, noise, options.output_dir / name, commands)
    figures = trial.solved(method) if method in ("start", "kronc", "adam") else trial.refined(method)
    row = plain({"noise": noise, "method": method, **figures, "hardware": hardware(), "settings": settings})
    write_json(file, row)
    print(" | ".join(_cells(row)), file=sys.stderr)
    return row


def _settings(options: RivalOptions, noise: tuple[float, float], method: Rival) -> dict[str, Any]:
    """What a row or a training must have been made with to be kept."""
    return plain({**asdict(options), "noise": noise, "methods": method, "output_dir": None})


class _Trial:
    """One capture, and the start that all methods get."""

    def __init__(self, options: RivalOptions, noise: tuple[float, float], folder: Path, commands: Commands) -> None:
        self._options = options
        self._noise = noise
        self._folder = folder
        self._commands = commands
        camera = default_camera("carpatch", options.width)
        noise_px = options.noise_px * options.width / _KEYPOINT_WIDTH
        self._capture: Capture = make_capture("carpatch", options.views, options.seed, noise_px, camera=camera)
        self._test: Bool[np.ndarray, "n"] = np.arange(options.views) % _TESTED_EVERY == 0

    def solved(self, method: Rival) -> dict[str, Any]:
        """Poses that need no field, and the field trained on them."""
        capture, data = self._capture, self._data()
        c2w, seconds = self._start(), 0.0
        if method != "start":
            subject = Subject(self._folder.name, capture_scene(capture), capture.c2w)
            placed = place("kronc" if method == "kronc" else "adam", subject, c2w)
            c2w, seconds = placed.c2w, placed.seconds
        scene = capture_scene(capture)
        found = self._folder / method
        write_poses(found, data, _with_masks(scene), c2w, capture.points)
        errors = pose_figures(c2w[~self._test], capture.c2w[~self._test])
        _, view_figures, trained = self._train(found, self._options.field, [], [])
        return {**_errors(errors), **view_figures, "pose_s": seconds, "train_s": trained}

    def refined(self, method: Rival) -> dict[str, Any]:
        """A field that finds its poses."""
        mode = [] if method in ("barf", "l2g-nerf") else ["--pipeline.model.camera-optimizer.mode", "SO3xR3"]
        config, view_figures, seconds = self._train(self._data(), method, mode, ["--init", "given", "--solver", "none"])
        output = config.parent / "refined" / "transforms.json"
        output.unlink(missing_ok=True)
        self._commands.run("kronc", "export", "--run", str(config), "--format", "transforms", "--output", str(output))
        found = read_poses(output)
        reference = read_poses(self._data() / "reference.json")
        training = {name: reference[name] for name, test in zip(reference, self._test, strict=True) if not test}
        errors = evaluate_poses(found, training).as_dict()
        figures = {"rotation_deg": errors["rotation_deg"]["mean"], "centre_cm": 100 * errors["translation"]["mean"]}
        return {**figures, **view_figures, "pose_s": seconds, "train_s": seconds}

    def _train(
        self, data: Path, method: Rival, options: Sequence[str], parser: Sequence[str]
    ) -> tuple[Path, dict[str, float], float]:
        """The run's config.yml, metrics of its test views, and seconds of the training."""
        prefix = "" if method in ("barf", "l2g-nerf") else "kronc-"
        name = f"{prefix}{method}{'' if self._options.gpu else '-cpu'}"
        steps = self._options.iterations
        if steps is not None:
            options = [*options, "--max-num-iterations", str(steps)]
        parser = ["--eval-interval", str(_TESTED_EVERY), *parser]
        runs = self._folder / "runs"
        config = runs / data.name / name / "run" / "config.yml"
        note, settings = config.parent / "training.json", _settings(self._options, self._noise, method)
        done = read_json(note) if note.is_file() else {}
        if done.get("settings") != settings:
            shutil.rmtree(config.parent, ignore_errors=True)  # a longer run's checkpoint would be taken for this one's
            begin = time.perf_counter()
            train(data, name, runs, [*options, "--viewer.quit-on-train-completion", "True"], parser, self._commands)
            done = {"seconds": time.perf_counter() - begin, "settings": settings}
            write_json(note, done)
        pictures = config.parent / "pictures"
        for old in pictures.glob("*.png"):
            old.unlink()
        output = self._commands.run("kronc", "eval", "--nvs", str(config), "--pictures", str(pictures), "--json")
        result = json.loads(output)["full"]
        return config, {"psnr": result["psnr"], "ssim": result["ssim"]}, done["seconds"]

    def _start(self) -> Float[np.ndarray, "n 3 4"]:
        """Noisy poses; the test views' are true, as in BARF's protocol: they take no part in the training."""
        noisy = noisy_poses(self._capture.c2w, *self._noise, np.random.default_rng(self._options.seed))
        return np.where(self._test[:, None, None], self._capture.c2w, noisy)

    def _data(self) -> Path:
        """The rendered scene folder, written once."""
        folder = self._folder / "capture"
        if not (folder / "reference.json").exists() or (folder / MARKER).exists():
            write_capture(folder, self._capture, self._start(), render=True, ground=False)
        return folder


def _errors(errors: Mapping[str, float]) -> dict[str, float]:
    return {name: errors[name] for name in ("rotation_deg", "centre_cm")}


def _with_masks(scene: Scene) -> Scene:
    """The scene with the masks that a rendered capture has."""
    return replace(scene, masks=tuple(name.replace("images", "masks") for name in scene.names))


def _write(rows: Sequence[Mapping[str, Any]], options: RivalOptions) -> str:
    """Write what there is of the table; its Markdown."""
    about = (
        f"A rendered car, {options.views} photos of {options.width}x{options.width} from a hemisphere, every "
        f"{_TESTED_EVERY}th for testing; keypoints of {options.noise_px:g} px at 400x400. Errors: means over the "
        "training views after a similarity alignment. PSNR: test views at the poses that explain them best, of a "
        f"{options.field} field where the method has none. Seconds to poses; of the training. "
        f"{in_words(rows[-1]['hardware'])}."
    )
    columns = ["start", "method", "rotation (deg)", "centre (cm)", "PSNR", "s to poses", "s of training", "paper"]
    text = Table("Poses from keypoints and from fields", columns, [_cells(row) for row in rows], about).markdown()
    with atomic_path(options.output_dir / "rivals.md") as path:
        path.write_text(text, encoding="utf-8")
    write_json(options.output_dir / "rivals.json", {"table": "rivals", "rows": list(rows)})
    return text


def _cells(row: Mapping[str, Any]) -> list[str]:
    degrees, metres = row["noise"]
    method = row["method"]
    of_paper = _PAPER_ROWS.get(method, {}).get((degrees, metres))
    names = ("rotation_deg", "centre_cm", "psnr", "pose_s", "train_s")
    measured = [number(math.nan if row[name] is None else row[name]) for name in names]
    shown = f"{method} + SO3xR3" if method in ("tensorf", "dvgo", "splatfacto") else method
    paper_cell = "-" if of_paper is None else f"{of_paper[0]:g} deg, {of_paper[1]:g} cm"
    return [f"({degrees:g} deg, {metres:g} m)", shown, *measured, paper_cell]
