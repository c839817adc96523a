"""Point clouds as others read them."""

import errno
import os

import numpy as np
import pytest
import trimesh

from kronc_ns.errors import KroncError
from kronc_ns.files.ply import write_points


@pytest.fixture
def points() -> np.ndarray:
    return np.random.default_rng(0).normal(scale=3.0, size=(7, 3))


@pytest.fixture
def colours() -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (7, 3), dtype=np.uint8)


def test_trimesh_reads_what_was_written(tmp_path, points, colours):
    write_points(tmp_path / "new" / "a.ply", points, colours)
    cloud = trimesh.load(tmp_path / "new" / "a.ply")
    np.testing.assert_allclose(cloud.vertices, points, rtol=1e-6)
    np.testing.assert_array_equal(cloud.colors[:, :3], colours)


def test_nerfstudio_reads_positions_and_colours(tmp_path, points, colours):
    """By Open3D, as the seeds of splatfacto (`nerfstudio_dataparser._load_3D_points`)."""
    open3d = pytest.importorskip("open3d")
    write_points(tmp_path / "a.ply", points, colours)
    cloud = open3d.io.read_point_cloud(str(tmp_path / "a.ply"))
    np.testing.assert_allclose(np.asarray(cloud.points), points, rtol=1e-6)
    np.testing.assert_array_equal((np.asarray(cloud.colors) * 255).astype(np.uint8), colours)


def test_the_header_is_that_of_the_format(tmp_path, points, colours):
    write_points(tmp_path / "a.ply", points, colours)
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    lines = header.decode("ascii").splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 7"]
    assert [line.split()[1:] for line in lines[3:]] == [
        *(["float", axis] for axis in "xyz"),
        *(["uchar", band] for band in ("red", "green", "blue")),
    ]
    assert len(body) == 7 * (3 * 4 + 3)


def test_no_points_are_a_file_too(tmp_path):
    write_points(tmp_path / "a.ply", np.empty((0, 3)), np.empty((0, 3), np.uint8))
    assert b"element vertex 0\n" in (tmp_path / "a.ply").read_bytes()


def test_a_full_disk_names_the_file(tmp_path, monkeypatch, points, colours):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(KroncError, match=r"a\.ply cannot be written: No space left on device"):
        write_points(tmp_path / "a.ply", points, colours)
    assert not os.listdir(tmp_path)
