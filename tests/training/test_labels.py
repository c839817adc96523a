import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import trimesh

from kronc_ns.errors import KroncError
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.training import labelling
from kronc_ns.training.labelling import Labels, View, read_labels
from kronc_ns.training.meshes import load_textured_mesh
from tests.conftest import SHARED_DATA

FILES = sorted((Path(labelling.__file__).parent / "labels").glob("*.json"))
LEFT_HALF = (*range(29), 59, 61, 62, 65)
DRAWN = {
    "front_door": (9, 10, 11, 12, 15),
    "rear_door": (12, 15, 16, 19),
    "front_handle": (13, 14),
    "rear_handle": (17, 18),
    "front_lamp": (0, 1, 2, 3),
    "fog": (4, 5),
    "rear_lamp": (22, 23, 25, 26),
    "boot": (24, 27),
    "front_plate": (59, 61),
    "rear_plate": (62, 65),
}
# pairs of points (more, less) along an axis
AHEAD = ((59, 7), (6, 7), (7, 20), (20, 21), (21, 62), (0, 7), (8, 11), (9, 12), (12, 16), (10, 15), (15, 19))
AHEAD += ((13, 14), (14, 18), (17, 18), (8, 24), (20, 22), (20, 28))
ABOVE = ((0, 1), (2, 3), (4, 5), (8, 9), (8, 12), (11, 12), (9, 10), (12, 15), (16, 19), (24, 27), (22, 23), (25, 26))
ABOVE += ((59, 61), (62, 65), (12, 13), (13, 15))
OUTSIDE = ((2, 0), (3, 1), (22, 25), (23, 26), (12, 11), (9, 8), (28, 62))


@pytest.fixture(scope="module", params=FILES, ids=lambda file: file.stem)
def labelled(request: pytest.FixtureRequest) -> tuple[trimesh.Trimesh, Labels]:
    """A mesh beside the project and its points."""
    glb = SHARED_DATA / "cars_train" / request.param.stem / "car.glb"
    if not glb.is_file():
        pytest.skip(f"the meshes to train on are not beside the project ({glb})")
    mesh = load_textured_mesh(glb).geometry()
    return mesh, read_labels(request.param, mesh)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_file_says_a_place_or_none_for_each_point_of_the_left_half(file):
    content = json.loads(file.read_text())
    assert content["mesh"] == file.stem
    assert {int(key) for key in content["points"]} == set(LEFT_HALF)
    for label in content["points"].values():
        assert label is None or label[0] in get_args(View)
        assert label is None or label[0] == "left" or label[1 + (label[0] == "top")] > 0  # y: the car's left


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_what_is_to_be_drawn_has_its_points(file):
    content = json.loads(file.read_text())
    for feature in content["draw"]:
        assert all(content["points"][str(index)] is not None for index in DRAWN[feature]), feature


def test_left_and_right_mirror_each_other(labelled, request):
    points = labelled[1].points
    off_centre = "chrono_uaz469" in request.node.name  # its plane of symmetry is not y = 0
    shift = (0, -0.086 if off_centre else 0.0, 0)
    np.testing.assert_allclose(points[list(APOLLOCAR3D_66.flip)] * (1, -1, 1) + shift, points, atol=1e-9)
    assert (points[[i for i in LEFT_HALF if np.isfinite(points[i, 0])], 1] > 0).all()


def test_points_of_both_sides_lie_on_the_surface(labelled):
    mesh, labels = labelled
    _, distance, _ = trimesh.proximity.closest_point(mesh, labels.points[labels.present])
    off = np.flatnonzero(labels.present)[distance > 0.03]
    assert not len(off), f"points {off} are up to {distance.max():.3f} m off"


def test_points_stand_as_on_a_car(labelled):
    points = labelled[1].points
    for axis, pairs in ((0, AHEAD), (1, OUTSIDE), (2, ABOVE)):
        more, less = points[np.transpose(pairs), axis]
        wrong = [pair for pair, bad in zip(pairs, more <= less, strict=True) if bad]  # NaN: no such point
        assert not wrong, f"axis {axis}: {wrong}"


def test_wheels_stand_level_and_apart(labelled):
    front, rear = labelled[1].points[[7, 20]]
    assert abs(front[2] - rear[2]) < 0.03
    assert abs(front[1] - rear[1]) < 0.15
    assert 1.9 < front[0] - rear[0] < 3.8


def test_a_label_is_cast_onto_the_first_surface_and_mirrored(tmp_path):
    box = trimesh.creation.box((4.0, 1.6, 1.0))
    file = tmp_path / "box.json"
    file.write_text(json.dumps({"points": {"0": ["front", 0.5, 0.1], "7": ["left", 1.2, -0.3], "4": None}}))
    labels = read_labels(file, box)
    np.testing.assert_allclose(labels.points[[0, 57]], [[2.0, 0.5, 0.1], [2.0, -0.5, 0.1]], atol=1e-6)
    np.testing.assert_allclose(labels.points[[7, 50]], [[1.2, 0.8, -0.3], [1.2, -0.8, -0.3]], atol=1e-6)
    assert labels.present.sum() == 4


def test_a_place_beside_the_car_is_an_error(tmp_path):
    file = tmp_path / "box.json"
    file.write_text(json.dumps({"points": {"0": ["front", 0.9, 0.1]}}))
    with pytest.raises(KroncError, match=r"point 0 at front .* beside the car"):
        read_labels(file, trimesh.creation.box((4.0, 1.6, 1.0)))
