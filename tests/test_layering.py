"""Imports go downwards only (the layers of the design), and the core never imports nerfstudio."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "kronc_ns"
LAYERS = [
    {"errors", "files", "compiled", "provenance"},
    {"geometry"},
    {"keypoints"},
    {"scene"},
    {"init", "objective", "solve"},
    {"stages"},
    {"options", "frame", "orbit"},
    {"starts", "completion"},
    {"adjustment", "repair"},
    {"verify"},
    {"pipeline"},
    {"config", "evaluate", "image_metrics", "capture", "export", "solved", "report", "plots", "viewer"},
    {"synthetic", "console", "benchmark"},
    {"batch"},
    {"cli", "plugin"},
]
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}
FILES = sorted(PACKAGE.rglob("*.py"))


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return names


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_downwards(path):
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    room = parts[0]
    if room == "__init__":
        return
    assert room in RANK, f"{room} has no layer: add it to LAYERS"
    for name in imported(path):
        if name.startswith("kronc_ns.") and name.split(".")[1] in RANK:
            target = name.split(".")[1]
            assert RANK[target] <= RANK[room], f"{room} imports {target} from above"
        if name.split(".")[0] == "nerfstudio":
            assert room == "plugin", f"{path.name} imports {name}: only kronc_ns/plugin may"


def test_dataparser_stays_clear_of_the_circular_import():
    reached = imported(PACKAGE / "plugin" / "dataparser.py")
    forbidden = (
        "nerfstudio.engine.trainer",
        "nerfstudio.pipelines",
        "nerfstudio.plugins.types",
        "kronc_ns.plugin.methods",
    )
    assert not [name for name in reached if name.startswith(forbidden)]
