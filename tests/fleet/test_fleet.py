"""A fleet in this process: what becomes of captures, whatever is wrong with them."""

import json
import os
import shutil
import time
from dataclasses import fields

import pyarrow.parquet as pq
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.fleet import FleetOptions, run_fleet
from kronc_ns.fleet.storage import place_of
from kronc_ns.fleet.work import RECORD
from tests.fleet.conftest import NAMES

QUICK = FleetOptions(reports="none")


def run(captures, output, options=QUICK, **rest):
    return run_fleet(str(captures), str(output), options, ray="none", **rest)


def test_every_capture_gets_a_folder_a_row_and_its_place_in_the_page(captures, tmp_path, rows):
    before = {path: path.read_bytes() for path in captures.rglob("*.json")}
    summary = run(captures, tmp_path / "out", FleetOptions())
    assert summary.is_solved
    assert summary.counts == {"converged": 4}
    table = rows(tmp_path / "out")
    assert sorted(table) == list(NAMES)
    for name in NAMES:
        folder = tmp_path / "out" / name
        report = json.loads((folder / "kronc.json").read_text())
        row = table[name]
        assert (row["status"], row["views"]) == (report["status"], len(report["views"]))
        assert row["rmse_px"] == pytest.approx(report["rmse_px"], abs=1e-5)
        assert row["focal_px"] == pytest.approx(report["focal_px"][0])
        assert row["path"] == f"file://{captures / name}"
        assert min(row[stage] for stage in ("fetch_s", "work_s", "report_s", "upload_s")) > 0
        assert row["seconds"] >= row["work_s"]
        assert sorted(os.listdir(folder)) == [
            "fleet.json", "keypoints.json", "keypoints.ply", "kronc.json", "report.html", "thumbnail.svg",
            "transforms.json",
        ]  # fmt: skip
    page = (tmp_path / "out/fleet.html").read_text()
    assert all(f'"{name}"' in page for name in NAMES)
    assert {path: path.read_bytes() for path in captures.rglob("*.json")} == before


def test_paths_of_a_result_lead_to_the_images_of_the_capture(captures, tmp_path):
    run(captures, tmp_path / "deep/out")
    folder = tmp_path / "deep/out/a"
    file = json.loads((folder / "transforms.json").read_text())["frames"][0]["file_path"]
    assert (folder / file).resolve() == captures / "a/images/frame_00001.png"
    assert (folder / json.loads((folder / "kronc.json").read_text())["data"]).resolve() == captures / "a"


def test_results_are_those_of_kronc_solve(captures, tmp_path, same_poses):
    from kronc_ns.commands.solve import Solve

    run(captures, tmp_path / "out")
    Solve(data=(captures / "b",), output_dir=tmp_path / "alone").run()
    assert same_poses(tmp_path / "out/b", tmp_path / "alone")
    inputs = [json.loads((tmp_path / name / "kronc.json").read_text())["inputs"] for name in ("out/b", "alone")]
    assert inputs[0] == inputs[1]


def test_scratch_is_left_as_it_was(captures, tmp_path):
    (tmp_path / "scratch").mkdir()
    (captures / "b/keypoints.json").write_text("{")
    run(captures, tmp_path / "out", FleetOptions(scratch=tmp_path / "scratch"))
    assert os.listdir(tmp_path / "scratch") == []


@pytest.mark.parametrize(
    ("spoil", "parts"),
    [
        (lambda folder: (folder / "keypoints.json").write_text("{"), ["b/keypoints.json", "not valid JSON"]),
        (lambda folder: (folder / "transforms.json").unlink(), ["no capture"]),
        (lambda folder: [file.unlink() for file in folder.iterdir()], ["empty"]),
        (lambda folder: (folder / "keypoints.json").write_bytes(os.urandom(5000)), ["b/keypoints.json"]),
        (lambda folder: (folder / "transforms.json").write_text("[" * 100_000), ["b/transforms.json"]),
    ],
    ids=["rotten", "no capture", "empty", "noise", "bomb"],
)
def test_one_that_is_rotten_has_its_row_and_the_others_go_on(captures, tmp_path, rows, spoil, parts):
    spoil(captures / "b")
    summary = run(captures, tmp_path / "out")
    assert summary.counts == {"converged": 3, "error": 1}
    row = rows(tmp_path / "out")["b"]
    assert row["status"] == "error"
    assert all(part in row["reason"] for part in parts), row["reason"]
    assert "\n" not in row["reason"]
    assert "kronc-fleet-" not in row["reason"]
    assert summary.doubtful == (("error", "b", row["reason"]),)
    assert not (tmp_path / "out/b").exists()


def test_a_doubtful_one_is_written_and_said(captures, tmp_path, edit, rows):
    def thin(content):
        for frame in content["frames"][2:]:
            frame["keypoints"] = [[0, 0, 0]] * 66

    edit(captures / "c/keypoints.json", thin)
    summary = run(captures, tmp_path / "out", FleetOptions(reports="doubtful"))
    assert summary.counts == {"converged": 3, "weak": 1}
    assert not summary.is_solved
    assert rows(tmp_path / "out")["c"]["reason"].startswith("only 2 views")
    assert [name for name in NAMES if (tmp_path / "out" / name / "report.html").exists()] == ["c"]


# ---- done once


def test_what_is_done_and_unchanged_stays_as_it_is(captures, tmp_path, rows):
    out = tmp_path / "out"
    run(captures, out)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.json") if path.parent != out}
    table = rows(out)
    summary = run(captures, out, resume=True)
    assert (summary.captures, summary.unchanged) == (4, 4)
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.json") if path.parent != out} == before
    assert rows(out) == table


def test_one_that_changed_is_done_again(captures, tmp_path, rows, edit):
    out = tmp_path / "out"
    run(captures, out)
    before = rows(out)
    edit(captures / "b/keypoints.json", lambda c: c["frames"][0]["keypoints"][0].__setitem__(2, 0.0))
    os.utime(captures / "c/keypoints.json")  # touched, but the same
    assert run(captures, out, resume=True).unchanged == 2
    after = rows(out)
    assert after["b"]["inputs"] != before["b"]["inputs"]
    assert after["c"]["inputs"] == before["c"]["inputs"]
    assert after["c"]["finished"] == before["c"]["finished"], "not solved again"
    assert after["a"] == before["a"]
    assert run(captures, out, resume=True).unchanged == 4


def test_other_options_make_other_results(captures, tmp_path, rows):
    out = tmp_path / "out"
    run(captures, out)
    before = rows(out)
    assert run(captures, out, FleetOptions(reports="none", car_length_m=4.2), resume=True).unchanged == 0
    assert all(rows(out)[name]["inputs"] != before[name]["inputs"] for name in NAMES)
    assert run(captures, out, FleetOptions(reports="none", car_length_m=4.2, retries=5), resume=True).unchanged == 4


def test_errors_are_tried_again_and_mended(captures, tmp_path, rows):
    out = tmp_path / "out"
    good = (captures / "b/keypoints.json").read_text()
    (captures / "b/keypoints.json").write_text("{")
    assert run(captures, out).counts == {"converged": 3, "error": 1}
    (captures / "b/keypoints.json").write_text(good)
    summary = run(captures, out, resume=True)
    assert (summary.counts, summary.unchanged) == ({"converged": 4}, 3)
    assert rows(out)["b"]["status"] == "converged"


def test_a_table_that_a_kill_cut_short_is_made_whole_from_the_results(captures, tmp_path, rows):
    out = tmp_path / "out"
    run(captures, out)
    before = rows(out)
    shutil.rmtree(out / "fleet.parquet")
    (out / "d" / RECORD).unlink()  # not whole
    run(captures, out, resume=True)
    after = rows(out)
    assert all(after[name] == before[name] for name in "abc")
    assert after["d"]["finished"] > before["d"]["finished"]


def test_new_captures_join_and_a_limit_takes_the_first(captures, tmp_path, rows):
    out = tmp_path / "out"
    assert run(captures, out, limit=2).captures == 2
    assert sorted(rows(out)) == ["a", "b"]
    summary = run(captures, out, resume=True)
    assert (summary.captures, summary.unchanged) == (4, 2)
    assert sorted(rows(out)) == list(NAMES)


# ---- with images


@pytest.mark.slow
def test_images_make_a_data_set_or_poses_alone(photos, tmp_path, rows):
    captures = tmp_path / "captures"
    shutil.copytree(photos, captures / "walk")
    run(captures, tmp_path / "whole", FleetOptions(num_downscales=1))
    whole = tmp_path / "whole/walk"
    assert len(list((whole / "images").iterdir())) == len(list((whole / "images_2").iterdir())) == 6
    assert (whole / "report.html").exists()
    assert (whole / "thumbnail.jpg").stat().st_size > 300
    row = rows(tmp_path / "whole")["walk"]
    assert (row["kind"], row["views"], row["attempts"]) == ("images", 6, 1)
    run(captures, tmp_path / "poses", FleetOptions(poses_only=True))
    files = ["fleet.json", "keypoints.json", "keypoints.ply", "kronc.json", "report.html", "transforms.json"]
    assert [name for name in sorted(os.listdir(tmp_path / "poses/walk")) if "thumbnail" not in name] == files
    assert rows(tmp_path / "poses")["walk"]["bytes_in"] < row["bytes_in"] / 2, "the images were not read"


def test_every_option_of_process_data_is_there():
    from typing import get_args

    from kronc_ns.capture.segmentation import choice
    from kronc_ns.fleet import options
    from kronc_ns.plugin.process_data import KroncToNerfstudio

    theirs = {f.name: f for f in fields(KroncToNerfstudio)}
    of_one_capture = {"data", "output_dir", "keypoints", "masks"}
    apart = {"segmentation", "solve", "images"}
    ours = {f.name: f for f in fields(FleetOptions)}
    assert theirs.keys() - ours.keys() == of_one_capture | apart
    for name in theirs.keys() & ours.keys() - {"detection"}:
        assert theirs[name].default == ours[name].default, name
    assert get_args(options.SegmenterName) == get_args(choice.SegmenterName)


# ---- limits


def test_a_capture_takes_no_more_memory_or_disk_than_it_may(captures, tmp_path, rows, monkeypatch):
    import numpy as np

    from kronc_ns.fleet import making

    as_it_is = making.make_poses

    def greedy(data, out, job, options):
        if data.name == "b":
            return float(np.ones(1 << 26).sum())
        if data.name == "c":
            (out.parent / "heap").write_bytes(bytes(40 << 20))
            time.sleep(5)
        return as_it_is(data, out, job, options)

    monkeypatch.setattr(making, "make_poses", greedy)
    options = FleetOptions(reports="none", memory_gb=0.3, scratch_gb=0.03, scratch=tmp_path / "scratch")
    assert run(captures, tmp_path / "out", options).counts == {"converged": 2, "error": 2}
    table = rows(tmp_path / "out")
    assert "--memory-gb 0.3" in table["b"]["reason"]
    assert "--scratch-gb 0.03" in table["c"]["reason"]
    assert os.listdir(tmp_path / "scratch") == []
    (captures / "d/long.bin").write_bytes(bytes(40 << 20))
    run(captures, tmp_path / "out", options, resume=True)
    assert "--scratch-gb is 0.03" in rows(tmp_path / "out")["d"]["reason"]
    assert np.empty(1 << 26).size, "the limit is gone with the capture"


# ---- told before the work


def test_what_can_be_known_is_told_first(captures, tmp_path):
    out = tmp_path / "out"

    def refused(match, *, captures=captures, output=out, options=QUICK, **rest):
        with pytest.raises(KroncError, match=match) as told:
            run(captures, output, options, **rest)
        assert "\n" not in str(told.value)

    refused("does not exist", captures=tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    refused("holds no captures", captures=tmp_path / "empty")
    refused("lie in each other", output=captures / "out")
    refused("lie in each other", output=captures)
    refused("--limit", limit=0)
    refused("--memory-gb", options=FleetOptions(memory_gb=0.0))
    refused("'phone'", options=FleetOptions(config="phone"))
    refused("nowhere.json", options=FleetOptions(camera=tmp_path / "nowhere.json"))
    refused("s4", captures="s4://bucket/captures")
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs/thesis.tex").write_text("only copy")
    refused("did not write", output=tmp_path / "theirs")
    refused("is a file", output=tmp_path / "theirs/thesis.tex")
    (captures / "a.mp4").touch()
    refused("both be named a: rename one")
    (captures / "a.mp4").unlink()
    assert not out.exists()
    run(captures, out)
    refused("--resume")
    (tmp_path / "more/x").mkdir(parents=True)
    refused("holds results of", captures=tmp_path / "more", resume=True)
    (captures / "fleet.parquet").mkdir()
    refused("rename it", output=tmp_path / "other")


def test_data_in_memory_are_done_in_this_process(made_captures):
    import fsspec

    memory = fsspec.filesystem("memory")
    memory.put(f"{made_captures}/", "/fleet/captures", recursive=True)
    try:
        assert run_fleet("memory://fleet/captures", "memory://fleet/out", QUICK).is_solved
        assert json.loads(memory.cat("/fleet/out/a/kronc.json"))["status"] == "converged"
        rows = [pq.read_table(memory.open(f["name"])).num_rows for f in memory.ls("/fleet/out/fleet.parquet")]
        assert sum(rows) == 4
    finally:
        memory.rm("/fleet", recursive=True)


def test_names_that_lead_elsewhere_are_refused(tmp_path):
    (tmp_path / "a").mkdir()
    place = place_of(str(tmp_path))
    assert [*place.entries()] == [("a", True)]
    with pytest.raises(KroncError, match=r"without '\.\.'"):
        _Listing(place.url).files()


class _Listing(type(place_of("/"))):
    def opened(self):
        class Files:
            @staticmethod
            def find(root, detail):
                return {f"{root}/../../etc/passwd": {"size": 1, "mtime": 1}}

        return Files, "/captures/a"
