"""Many scenes in one go: each as if it were alone, and none stops the others."""

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kronc_ns.commands import main as cli
from kronc_ns.commands.batch import expand
from kronc_ns.errors import KroncError
from kronc_ns.files.transforms import read_poses
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene, solve_scenes
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import make_capture
from tests.conftest import scene_of

NAMES = ("a", "b", "c")


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """Three walks of different lengths."""
    folder = tmp_path_factory.mktemp("captures")
    for seed, name in enumerate(NAMES):
        write_capture(folder / name, make_capture("walk", views=7 + 3 * seed, seed=seed, noise_px=0.5))
    return folder


@pytest.fixture
def captures(made, tmp_path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "captures"))


@pytest.fixture
def solve(monkeypatch, capsys):
    """Run `kronc solve --data ...`: (status, stdout, stderr)."""

    def run(*data, output: Path, **options) -> tuple[int, str, str]:
        extra = [str(part) for name, value in options.items() for part in (f"--{name.replace('_', '-')}", value)]
        arguments = ["kronc", "solve", "--data", *map(str, data), "--output-dir", str(output), *extra]
        monkeypatch.setattr(sys, "argv", arguments)
        capsys.readouterr()
        with pytest.raises(SystemExit) as caught:
            cli.main()
        return int(caught.value.code or 0), *capsys.readouterr()

    return run


def report(folder: Path) -> dict:
    return json.loads((folder / "kronc.json").read_text())


def test_every_folder_gets_its_own_result(captures, solve, tmp_path):
    out = tmp_path / "out"
    status, printed, err = solve(*(captures / name for name in NAMES), output=out)
    assert (status, err) == (0, "")
    assert sorted(path.name for path in out.iterdir()) == list(NAMES)
    files = ["keypoints.json", "keypoints.ply", "kronc.json", "transforms.json"]
    for name in NAMES:
        assert sorted(path.name for path in (out / name).iterdir()) == files
        assert report(out / name)["status"] == "converged"
        assert f" {name} " in printed
        assert (out / name / json.loads((out / name / "transforms.json").read_text())["ply_file_path"]).exists()
    assert printed.splitlines()[-1] == str(out)


def test_one_that_is_broken_does_not_stop_the_others(captures, solve, tmp_path):
    (captures / "b/keypoints.json").write_text("{")
    status, printed, err = solve(*(captures / name for name in NAMES), output=tmp_path / "out")
    assert status == 2
    assert "Traceback" not in printed
    assert err.count("\n") == 1
    assert f"{captures / 'b/keypoints.json'} is not valid JSON" in err
    for name in ("a", "c"):
        assert report(tmp_path / "out" / name)["status"] == "converged"
    assert not (tmp_path / "out/b").exists()


def test_one_that_cannot_be_trusted_ends_with_3_and_is_written(captures, solve, edit, tmp_path):
    def thin(content):
        for frame in content["frames"][2:]:
            frame["keypoints"] = [[0, 0, 0]] * 66

    edit(captures / "b/keypoints.json", thin)
    status, _, _ = solve(*(captures / name for name in NAMES), output=tmp_path / "out")
    assert status == 3
    assert [report(tmp_path / "out" / name)["status"] for name in NAMES] == ["converged", "weak", "converged"]


def test_a_folder_of_somebody_else_is_left_alone_and_the_others_written(captures, solve, tmp_path):
    theirs = tmp_path / "out/b"
    theirs.mkdir(parents=True)
    (theirs / "thesis.tex").write_text("only copy")
    status, printed, err = solve(*(captures / name for name in NAMES), output=tmp_path / "out")
    assert status == 2
    assert "Traceback" not in printed
    assert f"{theirs} already holds data" in err
    assert [path.name for path in theirs.iterdir()] == ["thesis.tex"]
    assert report(tmp_path / "out/a")["status"] == report(tmp_path / "out/c")["status"] == "converged"


def test_a_pattern_stands_for_the_folders_that_match(captures, solve, tmp_path):
    (captures / "notes.txt").touch()
    status, _, err = solve(captures / "[ab]", output=tmp_path / "out")
    assert (status, err) == (0, "")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a", "b"]
    assert expand([captures / "*"]) == [captures / name for name in NAMES]
    assert expand([captures / "c", captures / "[ab]"]) == [captures / name for name in ("c", "a", "b")]
    odd = captures / "d[1]"
    odd.mkdir()
    assert expand([odd]) == [odd], "a folder that exists is no pattern"


def test_a_pattern_without_a_match_is_named(captures, solve, tmp_path):
    status, _, err = solve(captures / "x*", output=tmp_path / "out")
    assert status == 2
    assert err.count("\n") == 1
    assert "x* matches no folder" in err
    assert not (tmp_path / "out").exists()


def test_equal_names_are_refused_before_anything_is_solved(captures, solve, tmp_path):
    shutil.copytree(captures / "a", tmp_path / "more/a")
    status, _, err = solve(captures / "a", tmp_path / "more/a", output=tmp_path / "out")
    assert (status, err.count("\n")) == (2, 1)
    assert "two scenes are named a" in err
    assert not (tmp_path / "out").exists()


def test_the_same_folder_twice_is_refused(captures, solve, tmp_path):
    status, _, err = solve(captures / "a", captures / "b" / ".." / "a", output=tmp_path / "out")
    assert (status, err.count("\n")) == (2, 1)


def test_scenes_are_never_their_own_output(captures, solve):
    before = {path: path.read_bytes() for path in captures.rglob("*") if path.is_file()}
    status, _, err = solve(captures / "a", captures / "b", output=captures)
    assert status == 2
    assert "holds the scene" in err
    assert {path: path.read_bytes() for path in captures.rglob("*") if path.is_file()} == before


def test_keypoints_from_elsewhere_are_for_a_single_scene(captures, solve, tmp_path):
    keypoints = captures / "a/keypoints.json"
    status, _, err = solve(captures / "a", captures / "b", output=tmp_path / "out", keypoints=keypoints)
    assert status == 2
    assert "single scene" in err


def test_a_batch_is_what_each_scene_is_alone(captures, solve, tmp_path):
    solve(*(captures / name for name in NAMES), output=tmp_path / "out")
    for name in NAMES:
        solve(captures / name, output=tmp_path / "single" / name)
        together, alone = (
            np.stack(list(read_poses(folder / name / "transforms.json").values()))
            for folder in (tmp_path / "out", tmp_path / "single")
        )
        np.testing.assert_allclose(together, alone, atol=1e-6)
        assert report(tmp_path / "out" / name)["inputs"] == report(tmp_path / "single" / name)["inputs"]


# ---- the same in memory


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    """Good ones and a poor one, more than go through together."""
    good = [scene_of(make_capture("walk", views=6 + i % 3, seed=i, noise_px=0.5)) for i in range(9)]
    few = good[2].keypoints.copy()
    few[2:] = 0
    return [*good, replace(good[2], keypoints=few)]


def test_scenes_solved_together_are_solved_as_alone(scenes):
    calls = []
    together = solve_scenes(scenes, progress=lambda done, total, _: calls.append((done, total)))
    assert calls == sorted(calls)
    assert calls[-1] == (10, 10)
    assert [solution.names for solution in together] == [scene.names for scene in scenes]
    for scene, solution in list(zip(scenes, together, strict=True))[::3]:
        alone = solve_scene(scene)
        assert isinstance(solution, Solution)
        assert solution.status is alone.status
        assert [view.status for view in solution.views] == [view.status for view in alone.views]
        np.testing.assert_allclose(solution.c2w, alone.c2w, atol=1e-6)
        np.testing.assert_allclose(solution.points, alone.points, atol=1e-6)
    assert [solution.status for solution in together[:9]] == [Status.CONVERGED] * 9
    assert together[9].status is Status.WEAK


def test_an_error_takes_the_place_of_its_scene_only(scenes):
    with_poses = replace(scenes[0], given_c2w=make_capture("walk", views=6, seed=0).c2w)
    outcome = solve_scenes([scenes[1], with_poses, scenes[2]], KroncConfig(init="given"))
    assert [type(one) for one in outcome] == [KroncError, Solution, KroncError]
    assert "transform_matrix" in str(outcome[0])


def test_no_scenes_have_no_solutions():
    assert solve_scenes([]) == []
