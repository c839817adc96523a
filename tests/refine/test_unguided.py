"""Tracks that need no poses, and poses that are too far off for any others."""

from dataclasses import replace

import numpy as np
import pytest

from kronc_ns.files.photos import photos
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.geometry.camera import reproject
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.refine import rounds
from kronc_ns.refine.adjustment import adjust
from kronc_ns.refine.counter import Counter
from kronc_ns.refine.options import RefineConfig
from kronc_ns.refine.pairs import choose_pairs, view_angles, with_next
from kronc_ns.refine.pipeline import prepare_scene, refine_scene
from kronc_ns.refine.unguided import _mutual, unguided_tracks
from tests.refine.test_placement import features, ring, used

VIEWS, POINTS, UNLIKE = 6, 120, 60
EACH = POINTS + UNLIKE


def tracks_of(rig, gathered, may=None):
    uv = rig.ideal(gathered.pixel, gathered.view)
    pairs = choose_pairs(view_angles(rig.cameras.centre, np.zeros(3)), 4)
    done = []
    may = used(gathered) if may is None else may
    tracks = unguided_tracks(gathered, may, pairs, uv, rig.focal, lambda: done.append(1))
    assert len(done) == len(pairs)
    return tracks


@pytest.fixture
def seen():
    rng = np.random.default_rng(5)
    rig = ring(VIEWS)
    points = rng.uniform([-2, -1, 0], [2, 1, 1.5], (POINTS, 3))
    return rig, features(rig, points, rng, 0.3, unlike=UNLIKE)


def test_tracks_are_those_of_the_points(seen):
    rig, gathered = seen
    tracks = tracks_of(rig, gathered)
    place = tracks.feature % EACH
    first = place[tracks.first[:-1]]
    assert (place == np.repeat(first, tracks.lengths)).mean() > 0.99
    assert (place < POINTS).mean() > 0.99
    assert (tracks.lengths == VIEWS).sum() > 0.9 * POINTS


def test_what_may_not_be_used_is_in_none(seen):
    rig, gathered = seen
    may = used(gathered)
    may[gathered.first[2] : gathered.first[3]] = False
    assert 2 not in gathered.view[tracks_of(rig, gathered, may).feature]


def test_words_that_are_alike_by_chance_make_none(seen):
    """They choose each other, but nothing explains where they are."""
    rig, gathered = seen
    rng = np.random.default_rng(6)
    anywhere = rng.uniform([0, 0], [640, 480], gathered.pixel.shape)
    assert not len(tracks_of(rig, replace(gathered, pixel=anywhere)))


def test_choices_are_mutual_and_clear():
    rng = np.random.default_rng(7)
    a = rng.random((40, 128)).astype(np.float32)
    b = np.concatenate(
        [a[::2] + 0.05 * rng.random((20, 128)).astype(np.float32), rng.random((30, 128)).astype(np.float32)]
    )
    b = np.concatenate([b, b[:5]])  # twice the same: neither is clear
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b))
    here, there, similarity, ratio = _mutual(a, b)
    np.testing.assert_array_equal(here, 2 * np.arange(5, 20))
    np.testing.assert_array_equal(there, np.arange(5, 20))
    products = a @ b.T
    np.testing.assert_allclose(similarity, products[here, there], rtol=1e-6)
    distance = np.sqrt(2 - 2 * np.sort(products, axis=1)[here])
    back = np.sqrt(2 - 2 * np.sort(products, axis=0)[:, there])
    np.testing.assert_allclose(ratio, np.maximum(distance[:, -1] / distance[:, -2], back[-1] / back[-2]), rtol=1e-4)
    assert all(not len(part) for part in _mutual(a[:0], b))


def test_photos_taken_one_after_the_other_are_compared_though_poses_part_them():
    pairs = with_next(np.array([[0, 2], [1, 3]]), 4)
    np.testing.assert_array_equal(pairs, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
    np.testing.assert_array_equal(with_next(np.zeros((0, 2), int), 1), np.zeros((0, 2), int))


@pytest.fixture(scope="module")
def astray(walk, solved):
    """(scene, solution) of the walk whose photos 5 and 6 have keypoints that put them 6 degrees around the car."""
    scene, solution = solved
    c2w = solution.c2w.copy()
    c2w[5:7] = so3_exp(np.deg2rad([0.0, 0.0, 6.0])) @ c2w[5:7]
    moved, stood = (reproject(solution.points, one, scene.camera) for one in (c2w, solution.c2w))
    keypoints = scene.keypoints.copy()
    keypoints[..., :2] += np.where(scene.seen[..., None], moved - stood, 0.0)
    return replace(scene, keypoints=keypoints), replace(solution, c2w=c2w)


def test_the_first_tracks_owe_nothing_to_the_poses(walk, astray, monkeypatch):
    folder, capture = walk
    scene, solution = astray
    monkeypatch.setattr(rounds, "find_tracks", None)
    counter = Counter(None)
    prepared, _ = prepare_scene(scene, solution, photos(folder, scene), RefineConfig(), counter)
    found = adjust(prepared.keypoints, rounds._first(prepared, counter), prepared.gathered, prepared.start, None)
    assert pose_errors(found.rig.c2w, capture.c2w)[0].max() < 0.4


def test_refined_poses_are_not_led_astray(walk, astray):
    folder, capture = walk
    scene, solution = astray
    assert pose_errors(solution.c2w, capture.c2w)[0].max() > 5
    found = refine_scene(scene, solution, photos(folder, scene))
    said = found.images
    assert said is not None
    assert said.accepted, said.reason
    assert pose_errors(found.c2w, capture.c2w)[0].max() < 0.4
