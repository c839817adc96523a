import numpy as np
import pytest
import trimesh

from kronc_ns.synthetic.car import build_car
from kronc_ns.training.decals import painted
from kronc_ns.training.deformation import Proportions, deform
from kronc_ns.training.procedural import draw_procedural, procedural_body

FRONT, REAR = 7, 20
MIRROR = np.array([1.0, -1.0, 1.0])


@pytest.fixture(scope="module")
def body():
    return procedural_body(build_car())


def _distance(body, points):
    return trimesh.proximity.closest_point(body.mesh.geometry(), points)[1]


def test_keypoints_of_a_procedural_body_lie_on_it(body):
    assert body.present.all()
    assert _distance(body, body.keypoints).max() < 0.01
    assert {"paint", "tyre", "rim"} <= {surface.name for surface in body.mesh.surfaces}


@pytest.mark.parametrize("seed", range(3))
def test_deformed_bodies_keep_their_points_wheels_and_symmetry(body, seed):
    proportions = Proportions.draw(np.random.default_rng(seed))
    moved = deform(body, proportions)
    points = moved.keypoints
    assert _distance(moved, points).max() < 0.012
    np.testing.assert_allclose(points[[57, 50, 37]] * MIRROR, points[[0, 7, 20]], atol=1e-6)
    assert moved.mesh.vertices[:, 2].min() == pytest.approx(0, abs=1e-9)
    tyre = [s.name for s in moved.mesh.surfaces].index("tyre")
    rubber = moved.mesh.vertices[moved.mesh.faces[moved.mesh.surface == tyre].ravel()]
    for hub in points[[FRONT, REAR]]:
        near = rubber[(np.abs(rubber[:, 0] - hub[0]) < 0.6) & (rubber[:, 1] > 0)]
        radius = np.hypot(near[:, 0] - hub[0], near[:, 2] - hub[2])
        assert np.ptp(near[:, 0]) == pytest.approx(np.ptp(near[:, 2]), rel=0.01), "wheels stay round"
        assert radius.max() == pytest.approx(hub[2], rel=0.02), "and on the ground"


def test_the_wheelbase_is_what_was_asked(body):
    longer = deform(body, Proportions(wheelbase=1.1))
    before = body.keypoints[FRONT, 0] - body.keypoints[REAR, 0]
    after = longer.keypoints[FRONT, 0] - longer.keypoints[REAR, 0]
    assert after == pytest.approx(1.1 * before, rel=0.01)


def test_nothing_changes_when_nothing_is_asked(body):
    same = deform(body, Proportions())
    middle = (body.mesh.vertices[:, 0].min() + body.mesh.vertices[:, 0].max()) / 2
    shift = np.array([middle, 0.0, body.mesh.vertices[:, 2].min()])
    np.testing.assert_allclose(same.mesh.vertices, body.mesh.vertices - shift, atol=2e-3)
    cosine = (same.mesh.normals * body.mesh.normals).sum(1)
    assert np.quantile(cosine, 0.01) > 0.999


def test_normals_stay_at_right_angles_to_the_surface(body):
    moved = deform(body, Proportions(front_overhang=1.2, cabin_height=0.85, rake=0.2, nose_m=0.06))
    corners = moved.mesh.vertices[moved.mesh.faces]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(face, axis=1)
    mean = moved.mesh.normals[moved.mesh.faces].mean(1)
    solid = area > 1e-6
    cosine = np.abs((face * mean).sum(1)[solid]) / area[solid] / np.linalg.norm(mean[solid], axis=1)
    assert np.quantile(cosine, 0.1) > 0.95


def test_plates_that_are_left_out_take_their_points_along(body):
    gone = 0
    for seed in range(12):
        plated = painted(body, ["front_plate", "rear_plate"], np.random.default_rng(seed))
        corners = plated.present[[58, 59, 60, 61]]
        assert corners.all() or not corners.any()
        gone += not corners.any()
    assert 0 < gone < 12


def test_both_sides_are_painted_alike(body):
    decals = {
        decal.view: decal for decal in painted(body, ["front_door", "rear_door"], np.random.default_rng(5)).decals
    }
    left, right = (decals[side].rgba[..., 3] > 0 for side in ("left", "right"))
    assert left.any()
    assert (left == right).mean() > 0.99


def test_the_same_seed_draws_the_same_body():
    one, other = (draw_procedural(np.random.default_rng(4)) for _ in range(2))
    np.testing.assert_array_equal(one.mesh.vertices, other.mesh.vertices)
    np.testing.assert_array_equal(one.keypoints, other.keypoints)
