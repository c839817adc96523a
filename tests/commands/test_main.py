"""The `kronc` command: what it writes, prints and exits with."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from kronc_ns.files.output import MARKER
from kronc_ns.files.presets import preset_names
from kronc_ns.files.transforms import read_poses
from tests.commands.conftest import contents

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning", "error::UserWarning")  # they would reach stderr


@pytest.fixture
def garbage(edit):
    """Give every detection of a scene another point's name: what is left explains nothing."""

    def spoil(scene: Path) -> None:
        def shuffle(content):
            rng = np.random.default_rng(0)
            for frame in content["frames"]:
                frame["keypoints"] = [frame["keypoints"][j] for j in rng.permutation(66)]

        edit(scene / "keypoints.json", shuffle)

    return spoil


# ---- the way through


def test_synth_solve_eval_export(scene, short, kronc, tmp_path):
    before, out = contents(scene), tmp_path / "out"
    result = kronc("solve", "--data", scene, "--output-dir", out, "--config", short)
    assert (result.status, result.err) == (0, "")
    assert result.out.splitlines()[-1] == str(out / "transforms.json")
    assert "12 of 12" in result.out
    assert contents(scene) == before
    assert sorted(os.listdir(out)) == ["keypoints.json", "keypoints.ply", "kronc.json", "transforms.json"]
    assert json.loads((out / "kronc.json").read_text())["status"] == "converged"

    judged = kronc("eval", "--poses", out / "transforms.json", "--reference", scene / "reference.json", "--json")
    start = kronc("eval", "--poses", scene / "transforms.json", "--reference", scene / "reference.json", "--json")
    errors = json.loads(judged.out)
    assert (judged.status, judged.err, judged.out.count("\n")) == (0, "", 1)
    assert set(errors) == {"views", "registered", "rotation_deg", "translation", "auc_3deg", "auc_5deg", "auc_30deg"}
    assert errors["views"] == errors["registered"] == 12
    for key in ("rotation_deg", "translation"):
        assert set(errors[key]) == {"mean", "median", "max"}
        assert errors[key]["mean"] < 0.5 * json.loads(start.out)[key]["mean"]
    table = kronc("eval", "--poses", out / "transforms.json", "--reference", scene / "reference.json")
    assert f"{errors['rotation_deg']['median']:.4f}" in table.out
    assert f"auc_5deg {errors['auc_5deg']:.4f}" in table.out

    colmap = kronc("export", "--data", out, "--format", "colmap")
    assert (colmap.status, colmap.out) == (0, f"12 images: {out / 'colmap/sparse/0'}\n")
    assert (out / "colmap/sparse/0/images.bin").stat().st_size > 0
    ply = kronc("export", "--data", out, "--format", "ply", "--output", tmp_path / "a.ply")
    assert ply.status == 0
    assert (tmp_path / "a.ply").read_bytes().startswith(b"ply")
    for format_, target in (("colmap", out / "colmap/sparse/0"), ("ply", tmp_path / "a.ply")):
        kept = contents(tmp_path)
        assert kronc("export", "--data", out, "--format", format_, "--output", target).refused(str(target), "--output")
        assert contents(tmp_path) == kept


def test_report_writes_one_file_beside_the_solution(solved, kronc):
    before = contents(solved)
    result = kronc("report", "--data", solved)
    assert (result.status, result.out, result.err) == (0, f"{solved / 'report.html'}\n", "")
    after = contents(solved)
    assert b"images/frame_00001.png" in after.pop("report.html")
    assert after == before


@pytest.mark.parametrize("command", ["report", "view"])
def test_report_and_view_want_a_solved_folder(command, scene, kronc):
    before = contents(scene)
    assert kronc(command, "--data", scene).refused(str(scene / "kronc.json"), "kronc solve")
    assert contents(scene) == before


def test_a_process_of_its_own_prints_no_more_than_that(scene, hasty, tmp_path, edit):
    """No warning, progress bar or log line gets between."""
    edit(scene / "keypoints.json", lambda c: c["frames"][3].update(keypoints=[[0, 0, 0]] * 66))
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
    options = {"--data": scene, "--output-dir": tmp_path / "out", "--config": hasty}
    flat = [str(part) for pair in options.items() for part in pair]
    command = [sys.executable, "-m", "kronc_ns.commands.main", "solve", *flat]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120, check=False)
    assert done.returncode == 3
    assert done.stderr.startswith("failed: ")
    assert done.stderr.count("\n") == 1
    assert done.stdout.splitlines()[-1] == str(tmp_path / "out/transforms.json")


def test_a_result_is_solved_again_into_the_same_folder(solved, scene, short, kronc):
    first = json.loads((solved / "transforms.json").read_text())
    result = kronc("solve", "--data", scene, "--output-dir", solved, "--config", short)
    assert result.status == 0
    assert json.loads((solved / "transforms.json").read_text()) == first


def test_options_win_over_the_preset(scene, hasty, kronc, tmp_path):
    kronc("solve", "--data", scene, "--output-dir", tmp_path / "a", "--config", hasty)
    kronc("solve", "--data", scene, "--output-dir", tmp_path / "b", "--config", hasty, "--init", "circular")
    inits = [json.loads((tmp_path / name / "kronc.json").read_text())["init"] for name in "ab"]
    assert inits == ["given", "circular"]


def test_keypoints_may_lie_elsewhere(scene, short, kronc, tmp_path):
    (scene / "keypoints.json").rename(tmp_path / "found.json")
    arguments = ("solve", "--data", scene, "--output-dir", tmp_path / "out", "--config", short)
    assert kronc(*arguments).refused("keypoints")
    assert kronc(*arguments, "--keypoints", tmp_path / "found.json").status == 0


# ---- errors a user can cause


def test_wrong_paths_are_named(kronc, scene, tmp_path):
    out = tmp_path / "out"
    (tmp_path / "empty").mkdir()
    assert kronc("solve", "--data", tmp_path / "nowhere", "--output-dir", out).refused("nowhere", "scene folder")
    assert kronc("solve", "--data", tmp_path / "empty", "--output-dir", out).refused("transforms.json")
    assert kronc("solve", "--data", scene / "transforms.json", "--output-dir", out).refused("is no folder")
    for option in ("--poses", "--reference"):
        paths = {
            "--poses": scene / "reference.json",
            "--reference": scene / "reference.json",
            option: tmp_path / "no.json",
        }
        assert kronc("eval", *[part for pair in paths.items() for part in pair]).refused("no.json")
    assert kronc("eval", "--poses", scene, "--reference", scene / "reference.json").refused(str(scene))
    assert kronc("export", "--data", tmp_path / "empty", "--format", "ply").refused("kronc.json", "kronc solve")
    assert not out.exists()


@pytest.mark.parametrize(
    ("file", "text", "parts"),
    [
        ("keypoints.json", '{"schema": ', ["keypoints.json", "not valid JSON"]),
        ("keypoints.json", "[1, 2]", ["keypoints.json"]),
        ("keypoints.json", "\udcff", ["keypoints.json", "not valid JSON"]),
        ("transforms.json", "", ["transforms.json", "not valid JSON"]),
        ("transforms.json", "[]", ["transforms.json", "frames"]),
    ],
)
def test_corrupt_files_are_named(kronc, scene, tmp_path, file, text, parts):
    (scene / file).write_bytes(text.encode("utf-8", "surrogateescape"))
    assert kronc("solve", "--data", scene, "--output-dir", tmp_path / "out").refused(*parts)
    assert not (tmp_path / "out").exists()


def test_zero_focal_length_is_refused(kronc, scene, edit, tmp_path):
    edit(scene / "transforms.json", lambda c: c.update(fl_x=0.0, fl_y=0.0))
    assert kronc("solve", "--data", scene, "--output-dir", tmp_path / "out").refused("focal length", "fl_x")


def test_too_few_usable_views_are_written_but_not_trusted(kronc, scene, edit, tmp_path):
    def thin(content):
        for frame in content["frames"][2:]:
            frame["keypoints"] = [[0, 0, 0]] * 66

    edit(scene / "keypoints.json", thin)
    result = kronc("solve", "--data", scene, "--output-dir", tmp_path / "out")
    assert result.status == 3
    assert result.err.startswith("weak: ")
    assert result.err.count("\n") == 1
    for part in ("only 2 views", "template", "2 of 12 views"):
        assert part in result.err
    report = json.loads((tmp_path / "out/kronc.json").read_text())
    statuses = [view["status"] for view in report["views"]]
    assert set(statuses[:2]) <= {"solved", "completed"}, "as well as the template alone tells"
    assert statuses[2:] == ["failed"] * 10
    assert len(read_poses(tmp_path / "out/transforms.json")) == 2


def test_an_unknown_preset_names_the_known_ones(kronc, scene, tmp_path):
    result = kronc("solve", "--data", scene, "--output-dir", tmp_path / "out", "--config", "phone")
    assert result.refused("'phone'", *preset_names())
    assert not (tmp_path / "out").exists()


def test_other_peoples_folders_are_left_alone(kronc, scene, hasty, tmp_path):
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs/thesis.tex").write_text("only copy")
    for command in (("solve", "--data", scene, "--config", hasty), ("synth", "--views", 2)):
        assert kronc(*command, "--output-dir", tmp_path / "theirs").refused("theirs", "new or empty folder")
    assert contents(tmp_path / "theirs") == {"thesis.tex": b"only copy"}


def test_the_scene_is_never_its_own_output(kronc, scene, hasty, tmp_path):
    before = contents(scene)
    (tmp_path / "link").symlink_to(scene)
    for out in (scene, scene / "." / "..", tmp_path / "link"):
        path = out / scene.name if out.name == ".." else out
        assert kronc("solve", "--data", scene, "--output-dir", path, "--config", hasty).refused("another folder")
    assert contents(scene) == before


def test_a_corrupt_result_is_named(kronc, solved):
    (solved / "kronc.json").write_text("{")
    assert kronc("export", "--data", solved, "--format", "ply").refused("kronc.json", "not valid JSON")
    (solved / "kronc.json").write_text("{}")
    for format_ in ("ply", "colmap"):
        assert kronc("export", "--data", solved, "--format", format_).refused("kronc.json")


def test_an_output_below_a_file_is_named(kronc, solved, scene, hasty, tmp_path):
    (tmp_path / "file").touch()
    target = tmp_path / "file" / "x"
    for command in (
        ("solve", "--data", scene, "--config", hasty, "--output-dir", target),
        ("synth", "--views", 2, "--output-dir", target),
        ("export", "--data", solved, "--format", "ply", "--output", target),
        ("export", "--data", solved, "--format", "colmap", "--output", target),
    ):
        assert kronc(*command).refused(str(target))


# ---- things that happen


def test_no_trustworthy_solution_exits_3_says_why_and_marks_its_files(kronc, scene, garbage, tmp_path):
    garbage(scene)
    result = kronc("solve", "--data", scene, "--output-dir", tmp_path / "out", "--init", "given")
    report = json.loads((tmp_path / "out/kronc.json").read_text())
    assert result.status == 3
    assert result.err == f"{report['status']}: {report['reason']}\n"
    assert report["status"] == "failed"
    assert (tmp_path / "out/transforms.json").exists()
    assert not (tmp_path / "out" / MARKER).exists()
    if not read_poses(tmp_path / "out/transforms.json"):
        for format_ in ("ply", "colmap"):
            assert kronc("export", "--data", tmp_path / "out", "--format", format_).refused("transforms.json")


def test_ctrl_c_exits_130_and_leaves_no_result(kronc, scene, short, tmp_path, monkeypatch):
    arguments = ("solve", "--data", scene, "--output-dir", tmp_path / "out", "--config", short, "--solver", "adam")

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("kronc_ns.solve.adam.minimise", interrupted)
        result = kronc(*arguments)
    assert (result.status, result.err.count("\n")) == (130, 1)
    assert os.listdir(tmp_path / "out") == [MARKER]
    assert kronc(*arguments).status == 0, "the same command starts again"
    assert (tmp_path / "out/kronc.json").exists()


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_full_disk_exits_2_and_leaves_no_result(kronc, scene, hasty, tmp_path, monkeypatch, step):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(os, step, full)
        result = kronc("solve", "--data", scene, "--output-dir", out, "--config", hasty)
        assert result.refused("out/", "cannot be written", "No space left on device")
        made = kronc("synth", "--output-dir", tmp_path / "made", "--views", 2)
        assert made.refused("made/", "cannot be written", "No space left on device")
    assert not (out / "kronc.json").exists()
    assert kronc("export", "--data", out, "--format", "ply").refused("kronc.json")
    assert kronc("synth", "--output-dir", tmp_path / "made", "--views", 2).status == 0, (
        "its own rest is no foreign data"
    )
