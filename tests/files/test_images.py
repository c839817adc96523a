"""Masks and depth maps say what they say at the right pixel, or are named."""

import cv2
import numpy as np
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.files.images import depth_under, read_depth, read_mask
from kronc_ns.geometry.camera import Camera

CAMERA = Camera(100.0, 100.0, 20.0, 15.0, 40, 30)


@pytest.fixture
def written(tmp_path):
    def write(image: np.ndarray, name: str = "a.png"):
        cv2.imwrite(str(tmp_path / name), image)
        return tmp_path / name

    return write


def test_masks_are_cut_in_the_middle(written):
    levels = np.array([[0, 127, 128, 255]], np.uint8)
    np.testing.assert_array_equal(read_mask(written(levels), (4, 1)), [[0, 0, 255, 255]])
    assert not read_mask(written(np.zeros((2, 3), np.uint8)), (3, 2)).any()


def test_masks_that_do_not_fit_are_named(written, tmp_path):
    mask = np.full((2, 3), 255, np.uint8)
    with pytest.raises(KroncError, match=r"a\.png is 3x2, its image 4x2"):
        read_mask(written(mask), (4, 2))
    with pytest.raises(KroncError, match="no value above 1: expected 0 outside the car and 255 on it"):
        read_mask(written(mask // 255), (3, 2))
    (tmp_path / "b.png").write_text("no image")
    with pytest.raises(KroncError, match=r"b\.png is no image that can be read"):
        read_mask(tmp_path / "b.png", (3, 2))


def test_depth_maps_are_millimetres_or_metres(written, tmp_path):
    metres = np.array([[0.0, 1.5], [4.0, 65.535]])
    millimetres = (1000 * metres).astype(np.uint16)
    np.testing.assert_allclose(read_depth(written(millimetres)), metres)
    np.save(tmp_path / "a.npy", metres.astype(np.float32))
    np.testing.assert_allclose(read_depth(tmp_path / "a.npy"), metres, rtol=1e-6)


def test_what_is_no_depth_map_is_named(written, tmp_path):
    (tmp_path / "a.npy").write_text("no array")
    colour = written(np.zeros((2, 2, 3), np.uint8))
    odd = {"flat": np.zeros(4), "cube": np.zeros((2, 2, 2)), "text": np.array([["a"]]), "any": np.array([[None, {}]])}
    for name, array in odd.items():
        np.save(tmp_path / f"{name}.npy", array)
    (tmp_path / "empty.npy").touch()
    with (tmp_path / "archive.npy").open("wb") as archive:
        np.savez(archive, np.zeros((2, 2)))
    names = ["a", "none", "empty", "archive", *odd]
    for file in (colour, tmp_path / "none.png", *(tmp_path / f"{name}.npy" for name in names)):
        with pytest.raises(KroncError, match=f"{file.name} is no depth map: expected a 16-bit"):
            read_depth(file)


@pytest.mark.parametrize("scale", [1, 2, 0.5])
def test_depth_is_that_of_the_pixel_at_any_resolution(scale):
    size = int(30 * scale), int(40 * scale)
    depth = np.zeros(size)
    depth[:, : size[1] // 2] = 3.0
    depth[:, size[1] // 2 :] = 7.0
    rows = np.array([[19.9, 10.0, 1.0], [20.1, 10.0, 0.2], [0.0, 0.0, 1.0], [39.9, 29.9, 1.0]])
    np.testing.assert_array_equal(depth_under(rows, depth, CAMERA), [3, 7, 3, 7])


def test_where_there_is_no_depth_there_is_none():
    depth = np.full((30, 40), 5.0)
    depth[0, :3] = 0, np.inf, -1
    unseen, outside = [10.0, 10.0, 0.0], [[-0.1, 5.0, 1.0], [40.1, 5.0, 1.0], [5.0, 30.1, 1.0]]
    unknown = [[column + 0.5, 0.5, 1.0] for column in range(3)]
    rows = np.array([unseen, *outside, *unknown])
    assert np.isnan(depth_under(rows, depth, CAMERA)).all()
