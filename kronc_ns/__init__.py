"""Camera poses of a walk around a car from semantic keypoints, for nerfstudio.

The public names are loaded when they are first used: importing the package costs next to nothing.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from kronc_ns.errors import KroncError as KroncError
    from kronc_ns.files.scene_folder import load_scene as load_scene
    from kronc_ns.fit.options import KroncConfig as KroncConfig
    from kronc_ns.fit.pipeline import solve_scene as solve_scene
    from kronc_ns.fit.pipeline import solve_scenes as solve_scenes
    from kronc_ns.scene import Scene as Scene
    from kronc_ns.solution import Solution as Solution

__version__ = "0.1.0"

_HOMES = {
    "KroncError": "errors",
    "KroncConfig": "fit.options",
    "Scene": "scene",
    "Solution": "solution",
    "load_scene": "files.scene_folder",
    "solve_scene": "fit.pipeline",
    "solve_scenes": "fit.pipeline",
}
__all__ = [*_HOMES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """A public name from the module it lives in (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module 'kronc_ns' has no attribute {name!r}")
    return getattr(import_module(f"kronc_ns.{_HOMES[name]}"), name)
