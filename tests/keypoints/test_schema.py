import json

import pytest

from kronc_ns.errors import KroncError
from kronc_ns.keypoints.schema import APOLLOCAR3D_24, APOLLOCAR3D_66, KeypointSchema, schema_of_count
from tests.conftest import SHARED_DATA


def test_flip_is_an_involution_between_the_sides():
    schema = APOLLOCAR3D_66
    assert len(schema) == 66
    assert len(set(schema.keypoints)) == 66
    assert all(schema.flip[schema.flip[i]] == i for i in range(66))
    assert {schema.flip[i] for i in schema.left} == set(range(66)) - set(schema.left)


def test_skeleton_is_mirror_symmetric():
    edges = {tuple(sorted(edge)) for edge in APOLLOCAR3D_66.skeleton}
    mirrored = {tuple(sorted((APOLLOCAR3D_66.flip[a], APOLLOCAR3D_66.flip[b]))) for a, b in edges}
    assert mirrored == edges


def test_facts_agree_with_the_published_list():
    path = SHARED_DATA / "apollocar3d66.json"
    if not path.exists():
        pytest.skip(f"the published keypoint list is not beside the project ({path})")
    facts = json.loads(path.read_text())
    assert list(APOLLOCAR3D_66.keypoints) == facts["names"]
    assert list(APOLLOCAR3D_66.flip) == facts["flip"]
    assert [i for i, side in enumerate(facts["side"]) if side == "left"] == sorted(APOLLOCAR3D_66.left)


def test_wheels_are_wheel_centres():
    names = [APOLLOCAR3D_66.keypoints[i] for i in APOLLOCAR3D_66.wheels]
    assert names == [
        "center_left_front_wheel",
        "center_right_front_wheel",
        "center_left_rear_wheel",
        "center_right_rear_wheel",
    ]


@pytest.mark.parametrize("flip", [(0, 1, 2), (1, 2, 0, 3), (0, 1, 2, 9)])
def test_schemas_that_do_not_pair_up_are_refused(flip):
    with pytest.raises(KroncError, match="flip"):
        KeypointSchema("x", ("a", "b", "c", "d"), flip)


def test_fewer_than_four_points_are_refused():
    with pytest.raises(KroncError, match="at least 4"):
        KeypointSchema("x", ("a", "b", "c"), (0, 1, 2))


def test_the_24_points_are_a_mirror_symmetric_part_of_the_66():
    assert len(APOLLOCAR3D_24) == 24
    for i, name in enumerate(APOLLOCAR3D_24.keypoints):
        whole = APOLLOCAR3D_66.keypoints.index(name)
        partner = APOLLOCAR3D_24.keypoints[APOLLOCAR3D_24.flip[i]]
        assert partner == APOLLOCAR3D_66.keypoints[APOLLOCAR3D_66.flip[whole]]
    assert len(APOLLOCAR3D_24.left) == 12
    names = [APOLLOCAR3D_24.keypoints[i] for i in APOLLOCAR3D_24.wheels]
    assert names == [APOLLOCAR3D_66.keypoints[i] for i in APOLLOCAR3D_66.wheels]


def test_a_count_tells_a_known_schema():
    assert schema_of_count(66) is APOLLOCAR3D_66
    assert schema_of_count(24) is APOLLOCAR3D_24
    other = schema_of_count(14)
    assert len(other) == 14
    assert other.flip == tuple(range(14))
    with pytest.raises(KroncError, match="at least 4"):
        schema_of_count(3)
