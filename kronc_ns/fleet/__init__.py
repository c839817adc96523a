"""Many captures on many machines: the stages of one capture as tasks of Ray.

The public names are loaded when they are first used; Ray, fsspec and pyarrow (extra ``fleet``) when a fleet runs.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from kronc_ns.fleet.driver import Summary as Summary
    from kronc_ns.fleet.driver import run_fleet as run_fleet
    from kronc_ns.fleet.items import Item as Item
    from kronc_ns.fleet.job import Job as Job
    from kronc_ns.fleet.job import make_job as make_job
    from kronc_ns.fleet.options import FleetOptions as FleetOptions
    from kronc_ns.fleet.work import do_captures as do_captures

_HOMES = {
    "FleetOptions": "options",
    "Item": "items",
    "Job": "job",
    "Summary": "driver",
    "do_captures": "work",
    "make_job": "job",
    "run_fleet": "driver",
}
__all__ = [*_HOMES]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    """A public name from the module it lives in (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module 'kronc_ns.fleet' has no attribute {name!r}")
    return getattr(import_module(f"kronc_ns.fleet.{_HOMES[name]}"), name)
