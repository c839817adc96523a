"""Adds `kronc` to nerfstudio's `ns-process-data`, which has no place for plugins.

The wheel puts this module and a one-line ``kronc_ns_hook.pth`` into site-packages. Python reads the latter when it
starts and calls `install`, which only remembers to do something should ``nerfstudio.scripts.process_data`` ever
be imported. Nothing else is imported here, and nothing that goes wrong reaches the program that was started.
``KRONC_NS_NO_HOOK=1`` in the environment switches it off.
"""

import os
import sys

_SCRIPT = "nerfstudio.scripts.process_data"


class ProcessDataFinder:
    """Import finder that leaves the search for the one module to the others, and adds a step after it has run."""

    def find_spec(self, name, path=None, target=None):
        """The spec the other finders have for nerfstudio's script, extended; None for any other module."""
        if name != _SCRIPT:
            return None
        others = (finder for finder in sys.meta_path if finder is not self and hasattr(finder, "find_spec"))
        spec = next((spec for spec in (finder.find_spec(name, path, target) for finder in others) if spec), None)
        if spec is not None and hasattr(spec.loader, "exec_module"):
            _extend_after(spec.loader)
        return spec


def install():
    """Put the finder in place, once, unless it is switched off."""
    if os.environ.get("KRONC_NS_NO_HOOK", "0") not in ("", "0"):
        return
    if not any(type(finder).__name__ == ProcessDataFinder.__name__ for finder in sys.meta_path):
        sys.meta_path.insert(0, ProcessDataFinder())


def _extend_after(loader):
    run = loader.exec_module

    def exec_module(module):
        run(module)
        try:
            from kronc_ns.plugin.process_data import extend_commands

            extend_commands(module)
        except Exception as error:  # ns-process-data has to go on without us, whatever it is
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            print(f"warning: ns-process-data has no kronc command ({reason})", file=sys.stderr)

    loader.exec_module = exec_module
