"""Camera poses of a walk around a car from semantic keypoints, for nerfstudio.

The core API; importing it does not import nerfstudio.
"""

from kronc_ns.errors import KroncError as KroncError
from kronc_ns.pipeline import KroncConfig as KroncConfig
from kronc_ns.pipeline import solve_scene as solve_scene
from kronc_ns.pipeline import solve_scenes as solve_scenes
from kronc_ns.scene import Scene as Scene
from kronc_ns.scene import load_scene as load_scene
from kronc_ns.solve.solution import Solution as Solution

__version__ = "0.1.0"
