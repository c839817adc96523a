"""Subjects, peers and the tables made of them."""

import itertools
import json
import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import tyro

from kronc_ns.benchmark.figures import pose_figures
from kronc_ns.benchmark.memory import with_peak
from kronc_ns.benchmark.peers.ceres import bundle_adjustment
from kronc_ns.benchmark.peers.colmap import map_images, map_keypoints
from kronc_ns.benchmark.peers.methods import place
from kronc_ns.benchmark.subjects import from_folder, procedural, thinned, with_noise
from kronc_ns.benchmark.tables import settings
from kronc_ns.benchmark.tables.table import Setting, TableOptions, in_columns, make_table
from kronc_ns.errors import KroncError
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.geometry.poses import posed
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import make_capture
from kronc_ns.synthetic.variations import noisy_poses


@pytest.fixture(scope="module")
def subject():
    return procedural(3, "walk", views=24)


def test_points_of_exact_keypoints_are_the_car_s():
    capture = make_capture("walk", 12, 5)
    subject = procedural(5, "walk", views=12)
    seen = subject.scene.seen.sum(0) >= 2
    np.testing.assert_allclose(subject.points[seen], capture.points[seen], atol=1e-6)


def test_points_that_fewer_than_two_views_see_are_unknown(subject):
    keypoints = subject.scene.keypoints.copy()
    keypoints[:, 0] = keypoints[1:, 1] = 0
    lost = replace(subject, scene=replace(subject.scene, keypoints=keypoints))
    assert np.isnan(lost.points[:2]).all()


@pytest.mark.parametrize(("unit", "factor"), [(1.0, 1.0), (1.2, 1.2), (0.2, 1.0), (7.0, 1.0)])
def test_a_reference_in_which_a_car_has_no_car_s_size_is_scaled_to_metres(tmp_path, unit, factor):
    capture = make_capture("walk", 12, 5)
    stretched = capture.c2w.copy()
    stretched[..., 3] *= unit
    write_capture(tmp_path / "scene", replace(capture, c2w=stretched))
    found, true = (np.linalg.norm(c2w[..., 3], axis=-1) for c2w in (from_folder(tmp_path / "scene").truth, capture.c2w))
    radius = found / (factor * true)
    assert radius.std() < 1e-6
    assert float(radius.mean()) == pytest.approx(1.0, abs=1e-6 if unit == factor else 0.1)


def test_bundle_adjustment_has_both_focal_lengths(subject):
    pytest.importorskip("pycolmap", minversion="4.1")
    camera = replace(subject.scene.camera, fy=1.02 * subject.scene.camera.fy)
    squeezed = subject.scene.keypoints.copy()
    squeezed[..., 1] = camera.cy + 1.02 * (squeezed[..., 1] - camera.cy)
    scene = replace(subject.scene, camera=camera, keypoints=squeezed)
    found = bundle_adjustment(scene, noisy_poses(subject.truth, 1.0, 0.1, np.random.default_rng(0)))
    assert pose_figures(found.c2w, subject.truth)["worst_deg"] < 0.01


def test_noise_has_the_size_asked_for_and_moves_nothing_unseen(subject):
    noisy = with_noise(subject, 2.0, np.random.default_rng(0))
    seen = subject.scene.seen
    moved = (noisy.scene.keypoints - subject.scene.keypoints)[..., :2]
    assert not moved[~seen].any()
    assert moved[seen].std() == pytest.approx(2.0, rel=0.1)
    again = with_noise(subject, 2.0, np.random.default_rng(0))
    assert np.array_equal(again.scene.keypoints, noisy.scene.keypoints)


def test_thinned_keeps_views_with_their_truth(subject):
    few = thinned(subject, 7)
    rows = [subject.scene.names.index(name) for name in few.scene.names]
    gaps = [after - before for before, after in itertools.pairwise([*rows, 24 + rows[0]])]
    assert len(rows) == 7
    assert set(gaps) == {3, 4}  # the one from the last to the first, too
    assert np.array_equal(few.truth, subject.truth[rows])
    assert np.array_equal(few.scene.keypoints, subject.scene.keypoints[rows])
    with pytest.raises(KroncError, match="expected 3 to 24"):
        thinned(subject, 2)


def test_a_folder_is_read_with_its_reference_and_without_its_poses(tmp_path, subject):
    capture = make_capture("walk", 6, 1)
    folder = tmp_path / "lap"
    write_capture(folder, capture, noisy_poses(capture.c2w, 4.0, 0.5, np.random.default_rng(0)))
    found = from_folder(folder)
    assert found.scene.given_c2w is None
    np.testing.assert_allclose(found.truth, capture.c2w, atol=1e-9)
    (folder / "reference.json").unlink()
    with pytest.raises(KroncError, match=r"reference\.json"):
        from_folder(folder)


def test_figures_count_views_without_a_pose_and_not_their_errors(subject):
    c2w = subject.truth.copy()
    c2w[::2] = math.nan
    found = pose_figures(c2w, subject.truth)
    assert found["registered"] == 0.5
    assert found["worst_deg"] < 1e-4
    assert found["auc_30"] == pytest.approx(0.5)
    none = pose_figures(np.full_like(c2w, math.nan), subject.truth)
    assert none["registered"] == none["auc_5"] == 0
    assert math.isnan(none["rotation_deg"])


@pytest.mark.parametrize("mapper", ["incremental", "global"])
def test_colmap_maps_exact_keypoints_exactly(subject, mapper):
    pytest.importorskip("pycolmap", minversion="4.1")
    found = map_keypoints(subject.scene, mapper)
    placed = posed(found)
    assert placed.mean() > 0.8
    rotation, centre = pose_errors(found[placed], subject.truth[placed])
    assert rotation.max() < 0.01
    assert centre.max() < 0.001


def test_colmap_without_masks_says_so(tmp_path, subject):
    pytest.importorskip("pycolmap", minversion="4.1")
    with pytest.raises(KroncError, match="no masks"):
        map_images(subject.scene, tmp_path, "incremental", masked=True)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["kronc", "ceres", "adam", "keypoints-incremental"])
def test_every_method_places_the_views_of_a_noisy_start_in_a_process_of_its_own(subject, method):
    start = noisy_poses(subject.truth, 2.0, 0.2, np.random.default_rng(0))
    found = place(method, subject, start).figures(subject.truth)
    assert found["registered"] > 0.8
    assert found["median_deg"] < 0.05
    assert found["seconds"] > 0


@pytest.mark.skipif(sys.platform != "linux", reason="peak memory is counted on Linux")
def test_peak_memory_is_what_a_run_adds_however_often_it_ran_before():
    def run() -> int:
        return np.ones(40 * 2**20 // 8).size

    for _ in range(2):
        size, megabytes = with_peak(run)
        assert size == 5 * 2**20
        assert 39 < megabytes < 48


@pytest.mark.slow
def test_a_method_that_needs_images_names_what_is_missing(subject):
    with pytest.raises(KroncError, match="--captures"):
        place("colmap-incremental", subject)


@pytest.mark.slow
def test_a_table_is_written_as_markdown_and_json(tmp_path, capsys):
    def rows(options):
        return [Setting({"method": "kronc", "keypoints": f"{x:g} px"}, "kronc", x) for x in options.noise_px]

    make_table("small", "A small table", TableOptions(output_dir=tmp_path, cars=2, noise_px=(0.0, 1.0)), rows)
    table = json.loads((tmp_path / "small.json").read_text())
    exact, noisy = table["rows"]
    assert exact["rotation_deg"] < 0.01 < noisy["rotation_deg"] < 1
    assert noisy["rotation_deg"] == pytest.approx(sum(run["rotation_deg"] for run in noisy["runs"].values()) / 2)
    assert table["hardware"]["cores"] >= 1
    text = (tmp_path / "small.md").read_text()
    assert text in capsys.readouterr().out
    assert "| kronc | 0 px | 100 % |" in text
    assert "2 captures (procedural car 0, procedural car 1)" in text
    with pytest.raises(KroncError, match="has no row"):
        make_table("small", "", TableOptions(output_dir=tmp_path, methods=("ceres",)), rows)


def test_markdown_has_a_dash_for_what_is_not_there():
    papers = {"a": {}, "b": {"paper": "1 deg"}}
    row = dict.fromkeys(("rotation_deg", "median_deg", "worst_deg", "centre_cm", "median_cm", "worst_cm"), math.nan)
    row |= {"auc_3": 0.0, "auc_5": 0.0, "auc_30": 0.0, "registered": 0.0, "seconds": 1.5, "megabytes": math.nan}
    rows = [{"labels": {"method": name}, **row, "paper": paper} for name, paper in papers.items()]
    title, _, head, rule, first, second, _, about = in_columns("Title", rows, "2 cars").markdown().splitlines()
    assert (title, about) == ("## Title", "2 cars")
    assert head.count("|") == rule.count("|") == first.count("|") == second.count("|")
    assert first == "| a | 0 % | - / - / - | - / - / - | 0.00 / 0.00 / 0.00 | 1.50 | - | - |"
    assert second.endswith("| 1 deg |")


@pytest.mark.parametrize(
    "table",
    [settings.main, settings.by_noise, settings.by_loss, settings.by_views, settings.by_depths, settings.by_subset],
)
def test_rows_of_a_table_have_the_same_columns_and_are_told_apart_by_them(tmp_path, table):
    rows = table(TableOptions(output_dir=tmp_path))
    assert len({tuple(row.labels) for row in rows}) == 1
    assert len({tuple(row.labels.values()) for row in rows}) == len(rows)


def test_the_rows_by_views_and_by_subset_ask_for_so_many_views(tmp_path):
    options = TableOptions(output_dir=tmp_path, noise_px=(1.0,))
    assert {row.views(100) for row in settings.by_views(options)} == {5, 10, 20, 30, 40, 50, 60, 70}
    assert {row.views(40) for row in settings.by_subset(options)} == {40, 30, 20, 10, 4}
    assert all(row.views(8) <= 8 for row in settings.by_views(options))


def test_table_options_come_from_the_command_line(tmp_path):
    options = tyro.cli(TableOptions, args=["--output-dir", str(tmp_path), "--noise-px", "0.5", "2"])
    assert options == TableOptions(output_dir=tmp_path, noise_px=(0.5, 2.0))
    with pytest.raises(KroncError, match="--cars 0"):
        replace(options, cars=0).subjects()


@pytest.mark.slow
def test_rows_measured_before_an_error_are_kept(tmp_path):
    def rows(_):
        return [Setting({"method": name}, name, 0.0) for name in ("kronc", "colmap-global")]

    with pytest.raises(KroncError, match="--captures"):
        make_table("begun", "A table that ends early", TableOptions(output_dir=tmp_path, cars=1), rows)
    (row,) = json.loads((tmp_path / "begun.json").read_text())["rows"]
    assert row["labels"] == {"method": "kronc"}
