"""Imports go downwards only (the layers of the design), and the core never imports nerfstudio or torch."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "kronc_ns"
LAYERS = [
    {"errors", "geometry"},
    {"keypoints", "scene", "solution"},
    {"solve"},
    {"fit"},
    {"refine"},
    {"show", "capture", "training", "synthetic", "metrics", "files"},
    {"commands", "plugin", "fleet", "benchmark"},
]
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}
MAY_USE_TORCH = (
    *("solve/adam", "solve/batched", "solve/tensors", "solve/objective", "plugin", "benchmark/cuda", "metrics/images"),
    *("training/network", "training/loss", "training/loop", "training/export"),
    *("capture/depth", "capture/pretrained", "capture/segmentation", "capture/detection/isolated"),
)
FILES = sorted(file for file in PACKAGE.rglob("*.py") if file != PACKAGE / "__init__.py")


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
    inside = path.relative_to(PACKAGE).with_suffix("")
    room = inside.parts[0]
    for name in imported(path):
        library, _, rest = name.partition(".")
        if library == "kronc_ns" and rest and rest != "__version__":
            target = rest.split(".")[0]
            assert RANK[target] <= RANK[room], f"{room} imports {target} from above"
        if library == "nerfstudio":
            assert room == "plugin", f"{inside} imports {name}: only kronc_ns/plugin may"
        if library in ("torch", "torchvision"):
            assert inside.as_posix().startswith(MAY_USE_TORCH), f"{inside} imports {name}"


def test_every_room_has_a_layer_and_every_layer_is_there():
    rooms = {path.relative_to(PACKAGE).with_suffix("").parts[0] for path in FILES}
    assert rooms == RANK.keys()


def test_the_house_is_small_at_the_top():
    assert len(list(PACKAGE.glob("*.py"))) <= 8


def test_dataparser_stays_clear_of_the_circular_import():
    reached = imported(PACKAGE / "plugin" / "dataparser.py")
    forbidden = (
        "nerfstudio.engine.trainer",
        "nerfstudio.pipelines",
        "nerfstudio.plugins.types",
        "kronc_ns.plugin.methods",
    )
    assert not [name for name in reached if name.startswith(forbidden)]
