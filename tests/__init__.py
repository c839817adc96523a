"""The tests. jaxtyping's shapes are checked at run time in all of them: the hook stands before any import of ours."""

from pathlib import Path

import jaxtyping

PACKAGE = Path(__file__).resolve().parents[1] / "kronc_ns"


def checked_modules() -> list[str]:
    """Every module but those with functions to compile, which cannot be checked, and those that say why not."""
    unchecked = ("@compiled", "@formula", "import bpy", "# shapes unchecked")
    files = [file for file in PACKAGE.rglob("*.py") if not any(mark in file.read_text() for mark in unchecked)]
    names = (file.relative_to(PACKAGE.parent).with_suffix("").parts for file in files if file.stem != "__init__")
    return [".".join(parts) for parts in names]


jaxtyping.install_import_hook(checked_modules(), "beartype.beartype")
