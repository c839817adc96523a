"""Radiance fields trained on poses of several kinds, and how well they show views that they were not trained on."""

import json
import time
from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any

from kronc_ns.benchmark.commands import Commands
from kronc_ns.benchmark.figures import Figures
from kronc_ns.benchmark.suites.captures import noisy_start
from kronc_ns.benchmark.training import Poses, train, write_variant
from kronc_ns.files.keypoints import write_keypoints
from kronc_ns.files.transforms import read_poses
from kronc_ns.fit.options import KroncConfig
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.metrics.poses import evaluate_poses
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import Capture, default_camera, make_capture

EVAL_INTERVAL = 5
"""Every so manieth view is a test view."""


@dataclass(frozen=True)
class PoseKind:
    """Poses to train and to test on, by name."""

    name: str
    """What a row calls them."""
    folder: str
    poses: Poses
    noise: float = 0.0
    """Of the keypoints they are solved from: standard deviation per axis as a share of the image's width."""


EXACT = PoseKind("exact poses", "exact", "exact")


class Trainings:
    """Trained and tested fields of one run of the suite; each is made once, however many rows ask for it.

    A capture is a rendered car from a hemisphere of ``views`` cameras, every fifth for testing, ``width`` pixels wide
    and high. Test views have poses of the same kind as training views.
    """

    def __init__(self, folder: Path, commands: Commands, views: int = 75, width: int = 160) -> None:
        self._folder = folder
        self._commands = commands
        self._views = views
        self._width = width
        self._lock = Lock()
        self._solving = Lock()  # one after the other: the solver uses all cores, and compiles itself at first
        self._made: dict[Hashable, Future[Any]] = {}

    def figures(self, method: str, kind: PoseKind, seed: int) -> Figures:
        """Means over the test views, errors of the poses, and times; for poses that are not exact what those lose."""
        figures = dict(self._once(self._train, method, kind, seed))
        if kind != EXACT:
            exact = self._once(self._train, method, EXACT, seed)
            losses = {f"{name}_below_exact": exact[name] - figures[name] for name in ("psnr", "vehicle_psnr")}
            figures = {**losses, **figures}
        return figures

    def _once(self, make: Callable[..., Any], *arguments: Hashable) -> Any:
        """What ``make`` gives for these arguments; a thread that asks while another makes it waits."""
        with self._lock:
            future = self._made.get((make, *arguments))
            missing = future is None
            future = self._made.setdefault((make, *arguments), Future())
        if missing:
            try:
                future.set_result(make(*arguments))
            except BaseException as error:
                future.set_exception(error)
        return future.result()

    def _train(self, method: str, kind: PoseKind, seed: int) -> Figures:
        data = self._once(self._posed, kind, seed)
        out = self._folder / f"seed_{seed}"
        begin = time.perf_counter()
        parser = ["--eval-interval", str(EVAL_INTERVAL)]
        config = train(data, method, out / "runs", parser=parser, commands=self._commands)
        trained = time.perf_counter()
        pictures = out / "pictures" / method / kind.folder
        result = json.loads(
            self._commands.run("kronc", "eval", "--nvs", str(config), "--pictures", str(pictures), "--json")
        )
        tested = time.perf_counter()
        errors = evaluate_poses(
            read_poses(data / "transforms.json"), read_poses(self._once(self._capture, seed) / "reference.json")
        ).as_dict()
        return {
            **_metrics(result["full"], ""),
            **_metrics(result["masked"], "vehicle_"),
            "rotation_deg": errors["rotation_deg"]["mean"],
            "centre_cm": 100 * errors["translation"]["mean"],
            "train_s": trained - begin,
            "test_s": tested - trained,
        }

    def _posed(self, kind: PoseKind, seed: int) -> Path:
        """The capture as a data set with poses of a kind."""
        data, folder = self._once(self._capture, seed), self._folder / f"seed_{seed}" / kind.folder
        detected = self._make(seed, kind.noise * self._width)
        keypoints = data / f"{kind.folder}.json"
        names = list(read_poses(data / "reference.json"))
        size = (detected.camera.width, detected.camera.height)
        write_keypoints(keypoints, APOLLOCAR3D_66, size, dict(zip(names, detected.keypoints, strict=True)))
        with self._solving:
            write_variant(folder, data, kind.poses, KroncConfig(init="given"), detected.points, keypoints)
        return folder

    def _capture(self, seed: int) -> Path:
        """The rendered scene folder, with noisy poses to start from."""
        capture, folder = self._make(seed), self._folder / f"seed_{seed}" / "capture"
        write_capture(folder, capture, noisy_start(capture, seed), render=True, ground=False)
        return folder

    def _make(self, seed: int, noise_px: float = 0.0) -> Capture:
        return make_capture("carpatch", self._views, seed, noise_px, camera=default_camera("carpatch", self._width))


def _metrics(metrics: Mapping[str, float | None], prefix: str) -> dict[str, float]:
    return {prefix + name: value for name, value in metrics.items() if value is not None}
