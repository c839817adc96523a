"""How a result was made: the command and the versions that later readers need to make it again."""

import platform
import shlex
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import kronc_ns

_PACKAGES = ("numpy", "numba", "torch", "nerfstudio")


def provenance() -> dict[str, Any]:
    """The ``command`` line of this process, and ``versions`` by name of kronc_ns, Python and what computes."""
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    versions = {"kronc_ns": kronc_ns.__version__, "python": platform.python_version()}
    return {"command": command, "versions": {**versions, **{name: _version(name) for name in _PACKAGES}}}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:  # a source tree on the path
        return "unknown"
