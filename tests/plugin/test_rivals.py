"""The table of methods that find poses by images: its rows, and that those that are there are kept."""

import json

import pytest

pytest.importorskip("nerfstudio")

from kronc_ns.benchmark.tables import rivals
from kronc_ns.benchmark.tables.rivals import RivalOptions, make_rival_table
from tests.plugin.commands import InProcess

pytestmark = [pytest.mark.slow, pytest.mark.nerfstudio]


@pytest.mark.usefixtures("without_lpips")
def test_rows_are_made_once_and_kept(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(rivals, "Commands", InProcess)
    options = RivalOptions(
        output_dir=tmp_path, noise=((2.0, 0.2),), methods=("start", "barf"), views=10, width=32, iterations=4
    )
    make_rival_table(options)
    text = (tmp_path / "rivals.md").read_text()
    assert text in capsys.readouterr().out
    start, barf = json.loads((tmp_path / "rivals.json").read_text())["rows"]
    assert (start["method"], barf["method"]) == ("start", "barf")
    assert barf["rotation_deg"] == pytest.approx(start["rotation_deg"], abs=0.01)  # poses wait for the field
    assert start["pose_s"] == 0 < barf["pose_s"]
    assert barf["psnr"] > 3
    assert "| (2 deg, 0.2 m) | barf |" in text

    monkeypatch.setattr(rivals, "train", None)  # which nobody calls
    make_rival_table(options)
    assert (tmp_path / "rivals.md").read_text() == text
