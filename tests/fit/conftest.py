"""A lap of 20 views as a scene, and what was made of it; all for reading."""

import numpy as np
import pytest

from kronc_ns.fit.attempts import Attempt, adjust_starts
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.fit.starts import start_from_poses, start_from_template
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution
from kronc_ns.synthetic.scenes import Capture
from tests.conftest import scene_of


@pytest.fixture(scope="session")
def scene(lap: Capture) -> Scene:
    return scene_of(lap)


@pytest.fixture(scope="session")
def given_scene(lap: Capture, lap_start: np.ndarray) -> Scene:
    """The lap with poses that are off by (4 deg, 0.5 m)."""
    return scene_of(lap, lap_start)


@pytest.fixture(scope="session")
def attempt(scene: Scene, lap_start: np.ndarray) -> Attempt:
    """What the solver makes of the given poses."""
    (attempt,) = adjust_starts([start_from_poses("given", "given", scene, lap_start)], KroncConfig())
    return attempt


@pytest.fixture(scope="session")
def template_attempt(scene: Scene) -> Attempt:
    """What the solver makes of the template in each view."""
    (attempt,) = adjust_starts([start_from_template(scene)], KroncConfig())
    return attempt


@pytest.fixture(scope="session")
def solution(scene: Scene) -> Solution:
    """The lap solved by default, without any pose."""
    return solve_scene(scene)


@pytest.fixture(scope="session")
def given_solution(given_scene: Scene) -> Solution:
    """The lap solved by default, from the given poses."""
    return solve_scene(given_scene)
