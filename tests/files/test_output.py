"""Files appear whole or not at all, and nobody's folder is touched."""

import errno
import json
import math
import os

import pytest

from kronc_ns.errors import KroncError
from kronc_ns.files.output import MARKER, atomic_path, claim_output, release_output, write_json
from tests.files.conftest import listing


def disk_full(*_, **__):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_file_replaces_the_old_one_and_no_temporary_stays(tmp_path):
    file = tmp_path / "new" / "a.json"
    write_json(file, {"a": 1})
    write_json(file, {"a": 2})
    assert json.loads(file.read_text()) == {"a": 2}
    assert os.listdir(file.parent) == ["a.json"]


def test_permissions_follow_the_umask(tmp_path):
    before = os.umask(0o027)
    try:
        write_json(tmp_path / "a.json", {})
    finally:
        os.umask(before)
    assert (tmp_path / "a.json").stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("error", [RuntimeError("bug"), KeyboardInterrupt()])
def test_a_failing_writer_leaves_the_old_file(tmp_path, error):
    file = tmp_path / "a.txt"
    file.write_text("old")

    def write() -> None:
        with atomic_path(file) as temporary:
            temporary.write_text("half")
            raise error

    with pytest.raises(type(error)):
        write()
    assert file.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("step", ["replace", "fsync"])
def test_a_full_disk_names_the_file_and_leaves_the_old_one(tmp_path, monkeypatch, step):
    file = tmp_path / "a.json"
    write_json(file, "old")
    monkeypatch.setattr(os, step, disk_full)
    with pytest.raises(KroncError, match=r"a\.json cannot be written: No space left on device"):
        write_json(file, "new")
    assert json.loads(file.read_text()) == "old"
    assert os.listdir(tmp_path) == ["a.json"]


def test_a_folder_that_cannot_be_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(KroncError, match=r"file/a\.json cannot be written"):
        write_json(tmp_path / "file" / "a.json", 1)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_nan_is_refused_and_the_old_file_stays(tmp_path, value):
    file = tmp_path / "a.json"
    write_json(file, [1.0])
    with pytest.raises(ValueError, match="JSON"):
        write_json(file, [value])
    assert json.loads(file.read_text()) == [1.0]
    assert os.listdir(tmp_path) == ["a.json"]


# ---- whose folder


@pytest.mark.parametrize("name", ["photo.jpg", "transforms.json", "images/a.png"])
def test_foreign_data_is_refused_and_stays(tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    before = listing(tmp_path)
    with pytest.raises(KroncError, match="choose a new or empty folder"):
        claim_output(tmp_path)
    assert listing(tmp_path) == before


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / "out").write_text("mine")
    with pytest.raises(KroncError, match="is a file"):
        claim_output(tmp_path / "out")
    assert (tmp_path / "out").read_text() == "mine"


def test_new_empty_and_own_folders_are_claimed(tmp_path):
    claim_output(tmp_path / "a" / "new")
    assert listing(tmp_path / "a" / "new").keys() == {(tmp_path / MARKER).relative_to(tmp_path)}
    (tmp_path / "empty").mkdir()
    claim_output(tmp_path / "empty")
    claim_output(tmp_path / "empty")  # holds the marker of an interrupted run
    release_output(tmp_path / "empty")
    assert not any((tmp_path / "empty").iterdir())


def test_a_finished_result_is_taken_back_before_it_is_written_over(solved):
    claim_output(solved)
    assert (solved / MARKER).exists()
    assert not (solved / "kronc.json").exists()


def test_results_of_another_kind_are_not_replaced(solved, tmp_path):
    """Rendering a capture, or solving another, must not take a data set with its detections."""
    before = listing(solved)
    with pytest.raises(KroncError, match="holds a solution, which is not for a capture to replace"):
        claim_output(solved, "capture")
    assert listing(solved) == before
    claim_output(tmp_path / "data", "data set")
    for other in ("solution", "capture"):
        with pytest.raises(KroncError, match="holds a data set"):
            claim_output(tmp_path / "data", other)
    claim_output(tmp_path / "data", "data set")


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(KroncError, match="out cannot be written"):
        claim_output(tmp_path / "file" / "out")
