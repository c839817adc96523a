"""The sheet of the pictures that the network does worst on."""

import cv2
import numpy as np
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.training.shards import Picture, write_shard
from kronc_ns.training.worst import worst_pictures


def grey(number: int) -> Picture:
    """A picture of nothing that is said to show a car."""
    mask = np.zeros((120, 160), np.uint8)
    mask[40:80, 30:130] = 255
    keypoints = np.zeros((66, 3))
    keypoints[:20] = [[30 + 5 * i, 60, 1] for i in range(20)]
    return Picture(np.full((120, 160, 3), 100 + number, np.uint8), mask, keypoints)


def test_where_no_car_is_found_it_is_said_and_drawn(tmp_path):
    write_shard(tmp_path / "00000.npz", [grey(i) for i in range(3)])
    said = worst_pictures(None, tmp_path, tmp_path / "sheet.jpg", count=2)
    assert said.startswith("3 pictures, no car found in 3; ")
    sheet = cv2.imread(str(tmp_path / "sheet.jpg"))
    assert sheet.shape == (280, 5 * 400, 3), "a row of five places, two of them taken"
    assert (sheet[:, 800:] > 250).all()
    assert (sheet[:270, :350] < 200).mean() > 0.9
    green = (sheet[..., 1].astype(int) - sheet[..., 2] > 60).sum()
    assert green > 100, "where the points are"


def test_without_pictures_there_is_no_sheet(tmp_path):
    with pytest.raises(KroncError, match="no pictures"):
        worst_pictures(None, tmp_path, tmp_path / "sheet.jpg", count=2)
    assert not (tmp_path / "sheet.jpg").exists()
