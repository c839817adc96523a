"""Ultralytics' pose labels, in small files after its documentation (pose data sets and `save_txt`, 8.3)."""

import numpy as np
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import match_keypoints, read_keypoints
from kronc_ns.geometry.camera import Camera
from kronc_ns.keypoints.schema import APOLLOCAR3D_24

CAMERA = Camera(50.0, 50.0, 20.0, 15.0, 40, 30)
BOX = "0 0.5 0.5 0.2 0.2 "
FOUR = "0.25 0.5 2 0.75 0.5 1 0 0 0 0.75 1 2"
YAML = "path: .\nkpt_shape: [4, 3]\nflip_idx: [1, 0, 2, 3]\nnames:\n  0: car\n"


@pytest.fixture
def labels(tmp_path):
    folder = tmp_path / "set" / "labels" / "train"
    folder.mkdir(parents=True)
    (folder / "a.txt").write_text(BOX + FOUR + "\n")
    (folder / "b.txt").write_text("")
    (tmp_path / "set" / "data.yaml").write_text(YAML)
    return folder


def test_shares_become_pixels_of_each_image(labels):
    found = read_keypoints(labels.parent.parent)
    names = ("images/a.png", "images/b.png")
    rows, _ = match_keypoints(found, names, CAMERA)
    np.testing.assert_allclose(rows[0], [[10, 15, 1], [30, 15, 0.5], [0, 0, 0], [30, 30, 1]])
    assert (rows[1] == 0).all()
    twice, _ = match_keypoints(found, names, CAMERA, sizes=[(80, 60), (40, 30)])
    np.testing.assert_allclose(twice[0], rows[0] * [2, 2, 1])
    for given in (labels, labels.parent, labels / "a.txt"):
        assert read_keypoints(given).frames.keys() == {"a", "b"}


def test_a_data_set_names_its_points(labels):
    yaml = labels.parents[1] / "data.yaml"
    yaml.write_text(YAML + "kpt_names:\n  0: [left, right, roof, door]\n")
    schema = read_keypoints(labels).schema
    assert schema.keypoints == ("left", "right", "roof", "door")
    assert schema.flip == (1, 0, 2, 3)
    with pytest.raises(KroncError, match="kpt_shape has 4 points, --keypoint-names 24"):
        read_keypoints(labels, "openpifpaf-24")


@pytest.mark.parametrize("dims", [2, 3])
@pytest.mark.parametrize("behind", ["", " 0.9", " 0.9 17"])
def test_without_a_data_set_the_length_tells(tmp_path, dims, behind):
    (tmp_path / "a.txt").write_text(BOX + " ".join(["0.5"] * 24 * dims) + behind)
    found = read_keypoints(tmp_path)
    assert found.schema is APOLLOCAR3D_24
    assert (found.frames["a"][..., 2] == (1 if dims == 2 else 0.5)).all()


def test_a_track_alone_is_no_confidence(labels):
    (labels / "a.txt").write_text(f"{BOX}{FOUR} 0.9\n{BOX}{FOUR} 0.4\n")
    (labels / "b.txt").write_text(f"{BOX}{FOUR} 3\n{BOX}{FOUR} 17\n")
    assert {name: len(rows) for name, rows in read_keypoints(labels).frames.items()} == {"a": 1, "b": 2}


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (BOX + FOUR + " 1 2 3", r"a\.txt, line 1: 20 numbers, expected 5 and 4 times 3"),
        (BOX + "0.5", r"a\.txt, line 1: 6 numbers, expected 5 and 4 times 3"),
        (BOX + FOUR.replace("0.25", "250"), r"line 1: a point is at 250: expected shares of the image"),
    ],
)
def test_lines_that_do_not_fit(labels, line, message):
    (labels / "a.txt").write_text(line)
    with pytest.raises(KroncError, match=message):
        read_keypoints(labels)


def test_lengths_that_tell_nothing_ask_for_names(labels):
    (labels.parents[1] / "data.yaml").unlink()
    with pytest.raises(KroncError, match=r"a\.txt, line 1: 17 numbers, .*--keypoint-names, or put the dataset's YAML"):
        read_keypoints(labels)
    names = labels.parents[1] / "names.txt"
    names.write_text("left\nright\nroof\ndoor\n")
    assert read_keypoints(labels, str(names)).frames["a"].shape == (1, 4, 3)


def test_other_text_in_a_folder_is_no_label(tmp_path):
    (tmp_path / "readme.txt").write_text("Photos of a car.")
    with pytest.raises(KroncError, match="holds no keypoint file"):
        read_keypoints(tmp_path)


def test_two_files_of_one_stem_are_told(labels):
    (labels.parent / "a.txt").write_text("")
    with pytest.raises(KroncError, match=r"two files are called a\.txt"):
        read_keypoints(labels.parent)
