"""Shared fixtures."""

import json
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from kronc_ns.files.output import claim_output
from kronc_ns.files.record import write_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.scene import Scene
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import Capture, make_capture
from kronc_ns.synthetic.variations import noisy_poses

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(autouse=True)
def seeded() -> None:
    """torch's global generator starts alike in every test that has it."""
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(0)


@pytest.fixture(scope="session")
def compiled_solver(lap: Capture) -> None:
    """The solver is there: commands say nothing of compiling it."""
    solve_scene(scene_of(lap), KroncConfig())


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
def lap_start(lap: Capture) -> np.ndarray:
    """Its poses with (4 deg, 0.5 m) of noise."""
    return noisy_poses(lap.c2w, 4.0, 0.5, np.random.default_rng(0))


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
    keypoints = lap.keypoints.copy()
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


def scene_of(capture: Capture, given: np.ndarray | None = None) -> Scene:
    """A capture as a scene in memory."""
    names = tuple(f"images/frame_{i + 1:05d}.png" for i in range(len(capture.c2w)))
    return Scene(names, capture.camera, APOLLOCAR3D_66, capture.keypoints, given)
