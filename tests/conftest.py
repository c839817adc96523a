"""Shared fixtures; jaxtyping annotations are checked at run time in every test."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import jaxtyping
import numpy as np
import pytest

with jaxtyping.install_import_hook(
    [
        "kronc_ns.adjustment",
        "kronc_ns.batch",
        "kronc_ns.benchmark",
        "kronc_ns.capture",
        "kronc_ns.completion",
        "kronc_ns.evaluate",
        "kronc_ns.export",
        "kronc_ns.frame",
        "kronc_ns.geometry",
        "kronc_ns.image_metrics",
        "kronc_ns.init",
        "kronc_ns.keypoints",
        "kronc_ns.objective",
        "kronc_ns.orbit",
        "kronc_ns.pipeline",
        "kronc_ns.repair",
        "kronc_ns.report",
        "kronc_ns.scene",
        "kronc_ns.solve.adam",  # each by itself: solve.lm_cpu is compiled and cannot be checked
        "kronc_ns.solve.bundle",
        "kronc_ns.solve.lm",
        "kronc_ns.solve.problem",
        "kronc_ns.solve.resection",
        "kronc_ns.solve.solution",
        "kronc_ns.solve.uncertainty",
        "kronc_ns.solved",
        "kronc_ns.stages",
        "kronc_ns.starts",
        "kronc_ns.synthetic",
        "kronc_ns.verify",
        "kronc_ns.viewer",
    ],
    "beartype.beartype",
):
    import kronc_ns.completion
    import kronc_ns.evaluate
    import kronc_ns.image_metrics
    import kronc_ns.init
    import kronc_ns.keypoints.select
    import kronc_ns.objective
    import kronc_ns.repair
    import kronc_ns.report
    import kronc_ns.solve.adam
    import kronc_ns.solved  # noqa: F401

import torch

from kronc_ns.export import claim_output, write_solution
from kronc_ns.init import noisy_poses
from kronc_ns.options import KroncConfig
from kronc_ns.pipeline import solve_scene
from kronc_ns.scene import Scene, load_scene
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import Capture, make_capture

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(autouse=True)
def seeded() -> None:
    """torch's global generator starts alike in every test."""
    torch.manual_seed(0)


@pytest.fixture(scope="session")
def spin_suv() -> Path:
    """The real turntable capture beside the project."""
    folder = SHARED_DATA / "spin_suv"
    if not folder.is_dir():
        pytest.skip(f"the real capture is not beside the project ({folder})")
    return folder


@pytest.fixture(scope="session")
def walk_capture() -> Capture:
    """A walk of 16 views with half a pixel of noise."""
    return make_capture("walk", views=16, seed=7, noise_px=0.5)


@pytest.fixture(scope="session")
def lap() -> Capture:
    """A walk of 20 views with 0.7 px of noise."""
    return make_capture("walk", views=20, seed=4, noise_px=0.7)


@pytest.fixture(scope="session")
def lap_start(lap: Capture) -> torch.Tensor:
    """Its poses with (4 deg, 0.5 m) of noise."""
    return noisy_poses(lap.c2w, 4.0, 0.5, torch.Generator().manual_seed(0))


@pytest.fixture
def walk_folder(tmp_path: Path, walk_capture: Capture) -> Path:
    """The walk as a scene folder without images; tests may change its files."""
    folder = tmp_path / "walk"
    write_capture(folder, walk_capture)
    return folder


@pytest.fixture
def edit():
    """Change a JSON file in place: edit(path, function of its content)."""

    def apply(path: Path, change) -> None:
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))

    return apply


@pytest.fixture(scope="session")
def solved_lap_folder(tmp_path_factory: pytest.TempPathFactory, lap: Capture) -> Path:
    """The lap of 20 views solved, the fifth of them without keypoints and every other with an image; for reading."""
    folder = tmp_path_factory.mktemp("lap")
    keypoints = lap.keypoints.clone()
    keypoints[4, :, 2] = 0
    write_capture(folder / "walk", replace(lap, keypoints=keypoints))
    scene = load_scene(folder / "walk")
    claim_output(folder / "out")
    write_solution(folder / "out", scene, solve_scene(scene, KroncConfig()), folder / "walk", "abc")
    (folder / "walk/images").mkdir()
    for name in scene.names[::2]:
        cv2.imwrite(str(folder / "walk" / name), np.full((lap.camera.height, lap.camera.width, 3), 90, np.uint8))
    return folder / "out"


BROWSER_PATIENCE_MS = 180_000
"""WebGL is drawn by the processor, which may be busy."""
_CHROMIUM_FLAGS = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]


@pytest.fixture(scope="module")  # it draws the viewer as long as it lives
def browser():
    """Debian's chromium, driven by Playwright."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("chromium is not installed: apt-get install chromium")
    with sync_api.sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=chromium, args=_CHROMIUM_FLAGS)
        yield running
        running.close()


@pytest.fixture(scope="session")
def screenshots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where pictures of pages are left to be looked at: ``$KRONC_SCREENSHOTS``, else pytest's own folder."""
    chosen = os.environ.get("KRONC_SCREENSHOTS")
    folder = Path(chosen) if chosen else tmp_path_factory.mktemp("screenshots")
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def scene_of(capture: Capture, given: torch.Tensor | None = None) -> Scene:
    """A capture as a scene in memory."""
    from kronc_ns.keypoints.schema import APOLLOCAR3D_66

    names = tuple(f"images/frame_{i + 1:05d}.png" for i in range(len(capture.c2w)))
    return Scene(names, capture.camera, APOLLOCAR3D_66, capture.keypoints, given)
