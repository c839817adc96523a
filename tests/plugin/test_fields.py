"""The table of fields on several methods' poses, small."""

import json

import pytest

from kronc_ns.benchmark.tables.fields import FieldOptions, make_field_table
from kronc_ns.errors import KroncError
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import default_camera, make_capture
from tests.plugin.commands import InProcess

pytestmark = [pytest.mark.slow, pytest.mark.nerfstudio, pytest.mark.usefixtures("without_lpips")]


def test_a_field_on_true_poses_beats_one_on_the_circle(tmp_path, monkeypatch):
    monkeypatch.setattr("kronc_ns.benchmark.tables.fields.Commands", InProcess)
    capture = make_capture("walk", 32, 0, camera=default_camera("walk", 96))
    write_capture(tmp_path / "lap", capture, render=True)
    options = FieldOptions(
        output_dir=tmp_path / "out",
        captures=(tmp_path / "lap",),
        poses=("kronc", "circle"),
        method="kronc-splatfacto-cpu",
        backgrounds=("white",),
        iterations=200,
    )
    make_field_table(options)
    solved, circle = json.loads((tmp_path / "out" / "fields.json").read_text())["rows"]
    assert solved["errors"]["registered"] == circle["errors"]["registered"] == 1
    assert solved["errors"]["median_deg"] < 0.1 < 1 < circle["errors"]["median_deg"]
    for what, gain_db in (("full", 2), ("masked", 0.5)):  # of what 200 steps can show
        assert solved["results"]["white"][what]["psnr"] > circle["results"]["white"][what]["psnr"] + gain_db
    assert len(list((tmp_path / "out" / "lap" / "kronc" / "pictures" / "white").iterdir())) == 4
    assert "| lap | kronc | 100 % |" in (tmp_path / "out" / "fields.md").read_text()
    with pytest.raises(KroncError, match="in use"):
        make_field_table(options)


def test_a_peer_that_places_nothing_has_a_row_of_dashes(tmp_path):
    capture = make_capture("walk", 4, 0)
    write_capture(tmp_path / "four", capture)
    make_field_table(
        FieldOptions(output_dir=tmp_path / "out", captures=(tmp_path / "four",), poses=("keypoints-incremental",))
    )
    assert "| four | keypoints-incremental | 0 % | - | - | - | - |" in (tmp_path / "out" / "fields.md").read_text()
