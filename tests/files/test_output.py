"""Files appear whole or not at all."""

import errno
import json
import math
import os

import pytest

from kronc_ns.errors import KroncError
from kronc_ns.files.output import atomic_path, write_json


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
