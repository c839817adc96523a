"""JSON files that are not what they should be: every command names them in one line, and ends with status 2."""

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

BROKEN = {
    "null": b"null",
    "list": b"[]",
    "list of numbers": b"[1, 2]",
    "text": b'"text"',
    "number": b"3.5",
    "nothing": b"",
    "truncated": b'{"frames": [{"file_path": "images/fra',
    "binary": b"\x89PNG\r\n\x1a\n\x00\xff\xfe",
    "deep": b"[" * 100_000,
    "a number of too many digits": b"1" * 5000,
}
REMEDIES = ("expected", "restore the file", "solve again")
Frame = dict[str, Any]


@pytest.fixture
def out(solved_lap_folder: Path, tmp_path: Path) -> Path:
    """A solved folder that a test may break."""
    return Path(shutil.copytree(solved_lap_folder, tmp_path / "out"))


def arguments(command: str, folder: Path) -> list[str]:
    """A command that reads all it can of a folder."""
    data = ["--data", str(folder)]
    transforms, reference = str(folder / "transforms.json"), str(folder / "reference.json")
    return {
        "solve": ["solve", *data, "--output-dir", str(folder.parent / "new")],
        "eval": ["eval", "--poses", transforms, "--reference", reference],
        "eval json": ["eval", "--poses", reference, "--reference", transforms, "--json"],
        "export colmap": ["export", *data, "--format", "colmap"],
        "export ply": ["export", *data, "--format", "ply"],
        "report": ["report", *data],
        "view": ["view", *data],
    }[command]


READS = {
    "solve": ("transforms.json", "keypoints.json"),
    "eval": ("transforms.json", "reference.json"),
    "eval json": ("transforms.json", "reference.json"),
}
OF_A_SOLUTION = {
    "solve": ("kronc.json",),
    "export colmap": ("transforms.json", "kronc.json"),
    "export ply": ("transforms.json", "kronc.json"),
    "report": ("transforms.json", "kronc.json", "keypoints.json"),
    "view": ("transforms.json", "kronc.json", "keypoints.json"),
}


def pairs(reads: dict[str, tuple[str, ...]]) -> list[tuple[str, str]]:
    return [(command, file) for command, files in reads.items() for file in files]


@pytest.mark.parametrize("content", BROKEN)
@pytest.mark.parametrize(("command", "file"), pairs(READS))
def test_broken_files_of_a_scene_are_named(kronc, scene, command, file, content):
    (scene / file).write_bytes(BROKEN[content])
    result = kronc(*arguments(command, scene))
    assert result.refused(str(scene / file))
    assert any(remedy in result.err for remedy in REMEDIES)
    assert not (scene.parent / "new").exists()


@pytest.mark.parametrize("content", BROKEN)
@pytest.mark.parametrize(("command", "file"), pairs(OF_A_SOLUTION))
def test_broken_files_of_a_solved_folder_are_named(kronc, out, command, file, content):
    (out / file).write_bytes(BROKEN[content])
    result = kronc(*arguments(command, out))
    assert result.refused(str(out / file))
    assert any(remedy in result.err for remedy in REMEDIES)


FRAMES: dict[str, tuple[Any, str]] = {
    "null": (None, '"frames"'),
    "an object": ({}, '"frames"'),
    "text": ("images", '"frames"'),
    "of null": ([None], '"frames"'),
    "of lists": ([[1]], '"frames"'),
    "of text": (["images/1.png"], '"frames"'),
    "without names": ([{}], '"frames"'),
    "named by numbers": ([{"file_path": 3}], "file_path 3"),
    "named by nothing": ([{"file_path": ""}], "file_path ''"),
    "named by a list": ([{"file_path": ["a"]}], "file_path ['a']"),
}


@pytest.mark.parametrize("command", ["solve", "eval", "eval json"])
@pytest.mark.parametrize("frames", FRAMES)
def test_frames_of_a_wrong_kind_are_named(kronc, scene, edit, command, frames):
    wrong, says = FRAMES[frames]
    edit(scene / "transforms.json", lambda content: content.update(frames=wrong))
    assert kronc(*arguments(command, scene)).refused("transforms.json", says, "expected")


@pytest.mark.parametrize("command", ["export colmap", "export ply", "report", "view"])
@pytest.mark.parametrize("frames", FRAMES)
def test_frames_of_a_wrong_kind_in_a_solved_folder_are_named(kronc, out, edit, command, frames):
    wrong, says = FRAMES[frames]
    edit(out / "transforms.json", lambda content: content.update(frames=wrong))
    assert kronc(*arguments(command, out)).refused("transforms.json", says, "expected")


UNIT = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]
MATRICES = {
    "3x3": [[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]],
    "ragged": [[1.0, 0, 0, 0], [0, 1.0]],
    "NaN": [[math.nan] * 4] * 4,
    "infinite": [[math.inf] * 4] * 4,
    "text": [["1.0, 0"] * 4] * 4,
    "of null": [[None] * 4] * 4,
    "an object": {"rotation": UNIT},
    "flat": [1.0] * 16,
    "a number": 1.0,
    "true": True,
    "huge": [[10**400] * 4] * 4,
    "overflowing": [[1e300] * 4] * 4,
    "no rotation": [[2.0, 0, 0, 0], *UNIT[1:]],
    "left-handed": [[-1.0, 0, 0, 0], *UNIT[1:]],
}


def change_first(edit: Callable, file: Path, changes: Frame) -> None:
    edit(file, lambda content: content["frames"][0].update(changes))


@pytest.mark.filterwarnings("error:overflow")
@pytest.mark.parametrize("command", ["solve", "eval", "eval json"])
@pytest.mark.parametrize("matrix", MATRICES)
def test_matrices_that_are_no_pose_are_named(kronc, scene, edit, command, matrix):
    change_first(edit, scene / "transforms.json", {"transform_matrix": MATRICES[matrix]})
    assert kronc(*arguments(command, scene)).refused("transforms.json, images/frame_00001.png", "transform_matrix")


@pytest.mark.parametrize("command", ["export colmap", "export ply", "report"])
@pytest.mark.parametrize("matrix", ["3x3", "NaN", "text", "huge"])
def test_matrices_that_are_no_pose_in_a_solved_folder_are_named(kronc, out, edit, command, matrix):
    change_first(edit, out / "transforms.json", {"transform_matrix": MATRICES[matrix]})
    assert kronc(*arguments(command, out)).refused("transforms.json", "frame_00001.png", "transform_matrix")


def test_a_view_without_a_pose_is_named_where_all_are_exported(kronc, out, edit):
    change_first(edit, out / "transforms.json", {"transform_matrix": None})
    assert kronc(*arguments("export colmap", out)).refused("frame_00001.png has no transform_matrix", "solve again")


@pytest.mark.parametrize("command", ["solve", "export colmap", "report"])
@pytest.mark.parametrize(
    ("key", "value"),
    [("fl_x", None), ("w", []), ("h", "tall"), ("cx", {}), ("fl_y", math.nan), ("k1", math.inf), ("w", 1e300)],
)
def test_intrinsics_of_a_wrong_kind_are_named(kronc, out, edit, command, key, value):
    edit(out / "transforms.json", lambda content: content.update({key: value}))
    result = kronc(*arguments(command, out))
    assert result.refused("expected")
    assert key in result.err or "finite" in result.err


RECORDS: list[tuple[Callable[[dict[str, Any]], Any], str]] = [
    *((lambda record, key=key: record.pop(key), key) for key in ("views", "points", "seconds", "status", "data")),
    *(
        (lambda record, key=key, wrong=wrong: record.update({key: wrong}), key)
        for key, wrong in (
            ("version", 3),
            ("inputs", None),
            ("command", []),
            ("versions", "1.0"),
            ("reason", 1),
            ("iterations", "many"),
            ("seconds", None),
            ("rmse_px", math.inf),
            ("median_px", 10**400),
        )
    ),
    (lambda record: record.update(views=[3]), "int"),
    (lambda record: record.update(points=[[10**400] * 3] * 66), "too large"),
    *(
        (lambda record, key=key, wrong=wrong: record["views"][0].update({key: wrong}), key)
        for key, wrong in (
            ("visible", "all"),
            ("inliers", 2.5),
            ("rmse_px", []),
            ("sigma_rot_deg", math.nan),
            ("sigma_trans_m", True),
            ("reason", None),
            ("swapped", "no"),
            ("unheard_of", ""),
        )
    ),
]


@pytest.mark.parametrize("command", ["report", "view"])
@pytest.mark.parametrize(("change", "says"), RECORDS, ids=[f"{i}: {says}" for i, (_, says) in enumerate(RECORDS)])
def test_a_record_of_a_wrong_kind_is_named(kronc, out, edit, command, change, says):
    edit(out / "kronc.json", change)
    assert kronc(*arguments(command, out)).refused("kronc.json", says, "solve again")


def test_a_record_without_its_origin_is_reported_all_the_same(kronc, out, edit):
    def forget(record: dict[str, Any]) -> None:
        for key in ("version", "inputs", "command", "versions"):
            del record[key]

    edit(out / "kronc.json", forget)
    assert kronc(*arguments("report", out)).status == 0


def test_a_loss_that_was_never_finite_is_left_out_of_the_report(kronc, out, edit):
    edit(out / "kronc.json", lambda record: record.update(history={"step": [0, 1], "loss": [None, None]}))
    assert kronc(*arguments("report", out)).status == 0
    assert "The solver recorded no steps." in (out / "report.html").read_text()


@pytest.mark.parametrize("content", ["[]", '"text"', "0", "false", "[" * 5000, "seed: 1\n  - 2"])
def test_presets_of_a_wrong_kind_are_named(kronc, scene, tmp_path, content):
    (tmp_path / "odd.yaml").write_text(content)
    assert kronc(*arguments("solve", scene), "--config", tmp_path / "odd.yaml").refused("odd.yaml")


def test_reports_write_nothing_beside_broken_files(kronc, out):
    (out / "transforms.json").write_text(json.dumps(None))
    assert kronc(*arguments("report", out)).refused("transforms.json")
    assert not (out / "report.html").exists()
