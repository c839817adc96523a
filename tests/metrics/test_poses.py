"""Pose errors: known ones come out as they went in."""

import math

import numpy as np
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.fit.starts import circular_poses
from kronc_ns.geometry.alignment import Similarity
from kronc_ns.geometry.poses import make_pose
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.metrics.poses import PoseErrors, evaluate_poses


def named(c2w, folder="images"):
    return {f"{folder}/frame_{i}.png": pose for i, pose in enumerate(c2w)}


def turned(c2w, angles_deg):
    """Each camera turned about its own x axis: centres stay, so that alignment is exact."""
    omega = np.zeros((len(c2w), 3))
    omega[:, 0] = np.deg2rad(angles_deg)
    return make_pose(c2w[..., :3] @ so3_exp(omega), c2w[..., 3])


@pytest.fixture
def truth():
    return circular_poses(8, 4.0)


def test_equal_poses_have_no_error(truth):
    errors = evaluate_poses(named(truth), named(truth)).as_dict()
    assert errors["views"] == errors["registered"] == 8
    assert errors["rotation_deg"]["max"] == pytest.approx(0, abs=1e-6)
    assert errors["translation"]["max"] == pytest.approx(0, abs=1e-9)
    assert [errors[f"auc_{limit}deg"] for limit in (3, 5, 30)] == pytest.approx([1, 1, 1])


def test_known_rotation_errors_come_out(truth):
    angles = [0.0, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 16.0]
    errors = evaluate_poses(named(turned(truth, angles)), named(truth)).as_dict()
    assert errors["rotation_deg"] == pytest.approx({"mean": 5.0, "median": 3.5, "max": 16.0})
    assert errors["translation"] == pytest.approx({"mean": 0, "median": 0, "max": 0}, abs=1e-9)
    for limit in (3, 5, 30):
        expected = sum(max(0, 1 - angle / limit) for angle in angles) / 8
        assert errors[f"auc_{limit}deg"] == pytest.approx(expected, abs=1e-6)


def test_known_translation_errors_come_out(truth):
    """Every other camera of a circle moved up, its neighbour down: no similarity can explain any of it."""
    moved = truth.copy()
    moved[:, 2, 3] += [0.1, -0.1] * 4
    errors = evaluate_poses(named(moved), named(truth))
    np.testing.assert_allclose(errors.rotation_deg, 0, atol=1e-6)
    # the best scale is a little below 1, since the moved cameras lie a little farther out
    scale = 16 / (16 + 0.01)
    expected = math.hypot(scale * 0.1, 4 * (1 - scale))
    np.testing.assert_allclose(errors.translation, expected)
    angle = math.degrees(math.atan2(expected, 4.0))
    np.testing.assert_allclose(errors.angle_deg, angle)
    assert errors.auc(5.0) == pytest.approx(1 - angle / 5)


def test_errors_are_in_the_references_unit_and_know_no_frame(truth):
    moved = truth.copy()
    moved[:, 2, 3] += [0.1, -0.1] * 4
    plain = evaluate_poses(named(moved), named(truth))
    world = Similarity(2.5, so3_exp(np.array([0.3, -0.2, 1.0])), np.array([1.0, -3.0, 2.0]))
    other = evaluate_poses(named(world.apply_to_poses(moved)), named(truth))
    np.testing.assert_allclose(other.translation, plain.translation)
    larger = evaluate_poses(named(moved), named(world.apply_to_poses(truth)))
    np.testing.assert_allclose(larger.translation, 2.5 * plain.translation)
    np.testing.assert_allclose(larger.angle_deg, plain.angle_deg, rtol=1e-6)


def test_missing_views_lower_registered_and_every_auc(truth):
    poses = named(turned(truth, [1.0] * 8))
    kept = dict(list(poses.items())[:6])
    whole, part = (evaluate_poses(p, named(truth)).as_dict() for p in (poses, kept))
    assert (part["views"], part["registered"]) == (8, 6)
    assert part["rotation_deg"]["mean"] == pytest.approx(1.0)
    for limit in (3, 5, 30):
        assert part[f"auc_{limit}deg"] == pytest.approx(6 / 8 * whole[f"auc_{limit}deg"])


def test_views_the_reference_lacks_do_not_count(truth):
    reference = dict(list(named(truth).items())[:5])
    errors = evaluate_poses(named(truth), reference)
    assert (errors.views, errors.registered) == (5, 5)


def test_views_are_matched_by_file_name_in_any_folder_order_and_format(truth):
    moved = named(turned(truth, [0, 0, 0, 0, 0, 0, 0, 9.0]), "../../photos")
    elsewhere = {name.replace(".png", ".jpg"): pose for name, pose in reversed(moved.items())}
    errors = evaluate_poses(elsewhere, named(truth))
    assert errors.rotation_deg[7] == pytest.approx(9.0)
    assert errors.rotation_deg[:7].max() == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("which", ["poses", "reference"])
def test_equal_file_names_are_refused(truth, which):
    both = {**named(truth[:4]), **named(truth[4:], "images_2")}
    pair = (both, named(truth)) if which == "poses" else (named(truth), both)
    with pytest.raises(KroncError, match=f"two of the {which} have the same file name"):
        evaluate_poses(*pair)


@pytest.mark.parametrize("common", [0, 2])
def test_fewer_than_three_common_views_are_refused(truth, common):
    poses = {**named(truth[:common]), **{f"images/other_{i}.png": truth[i] for i in range(4)}}
    with pytest.raises(KroncError, match=f"^{common} of 8 reference views are among the {common + 4} poses"):
        evaluate_poses(poses, named(truth))


def test_the_auc_is_the_area_under_the_recall_curve():
    angle = np.array([0.4, 1.7, 2.2, 7.0])
    errors = PoseErrors(5, angle, angle, angle)
    recall = (angle[:, None] <= np.linspace(0, 5, 200_001)).sum(0) / 5
    assert errors.auc(5.0) == pytest.approx(float(recall.mean()), abs=1e-4)
