"""Matching, tracks and patches on made-up features."""

import cv2
import numpy as np
import pytest

from kronc_ns.geometry.camera import Camera
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.refine.gathering import _look
from kronc_ns.refine.grid import grid_of
from kronc_ns.refine.matching import Seen, match, standing_still
from kronc_ns.refine.pairs import choose_pairs, view_angles
from kronc_ns.refine.patches import _align
from kronc_ns.refine.pictures import Picture
from kronc_ns.refine.tracks import Cameras, Linked, angles_deg, angles_off_middle_deg, confirmed, enough, link, rows_of
from kronc_ns.refine.triangulation import place
from kronc_ns.refine.verdict import _signed_rank_z

FOCAL = 500.0


def two_views(rng, count=200):
    """Points seen by two cameras; descriptors are random, alike in both views."""
    world = rng.uniform([-1, -1, 4], [1, 1, 6], (count, 3))
    rotation, shift = so3_exp(np.array([0.0, 0.15, 0.02])), np.array([-0.8, 0.05, 0.1])
    other = world @ rotation.T + shift
    words = rng.random((count, 128)).astype(np.float32)
    words /= np.linalg.norm(words, axis=1, keepdims=True)
    return world, other, rotation, shift, words


def seen(points, words, order):
    uv = points[order, :2] / points[order, 2:] * FOCAL
    depth = points[order, 2]
    return Seen(uv, 10.0 / depth, words[order], 0.9 * depth, 1.1 * depth, grid_of(uv))


def test_matches_are_those_of_the_points():
    rng = np.random.default_rng(0)
    world, other, rotation, shift, words = two_views(rng)
    here, there = rng.permutation(len(world)), rng.permutation(len(world))
    found = match(seen(world, words, here), seen(other, words, there), (rotation, shift), FOCAL, (2.0, 2.0), (5.0, 5.0))
    assert len(found.here) > 0.9 * len(world)
    np.testing.assert_array_equal(here[found.here], there[found.there])


@pytest.mark.parametrize("off", ["line", "size", "depth"])
def test_what_does_not_fit_is_no_match(off):
    rng = np.random.default_rng(1)
    world, other, rotation, shift, words = two_views(rng)
    order = np.arange(len(world))
    a, b = seen(world, words, order), seen(other, words, order)
    if off == "line":
        uv = b.uv + np.array([0.0, 12.0])
        b = Seen(uv, b.size, b.descriptor, b.nearest, b.farthest, grid_of(uv))
    elif off == "size":
        b = Seen(b.uv, 2 * b.size, b.descriptor, b.nearest, b.farthest, b.grid)
    else:
        b = Seen(b.uv, b.size, b.descriptor, 1.5 * b.farthest, 2 * b.farthest, b.grid)
    found = match(a, b, (rotation, shift), FOCAL, (2.0, 2.0), (5.0, 5.0))
    assert len(found.here) < 0.05 * len(world)


def test_a_feature_at_its_old_place_stands_still():
    rng = np.random.default_rng(2)
    world, _, _, _, words = two_views(rng)
    order = np.arange(len(world))
    a = seen(world, words, order)
    uv = a.uv.copy()
    uv[50:] += 30.0
    b = Seen(uv, a.size, a.descriptor, a.nearest, a.farthest, grid_of(uv))
    found = standing_still(a, b)
    assert found[:50].all()
    assert not found[50:].any()


def test_no_track_has_two_features_of_a_view():
    rng = np.random.default_rng(3)
    view = rng.integers(0, 6, 400)
    here, there = rng.integers(0, 400, (2, 600))
    apart = view[here] != view[there]
    similarity = rng.uniform(0.8, 1.0, 600)
    tracks = link(Linked(here[apart], there[apart], similarity[apart], np.full(int(apart.sum()), 0.5)), view)
    assert (tracks.lengths >= 2).all()
    for first, last in zip(tracks.first[:-1], tracks.first[1:], strict=True):
        views = view[tracks.feature[first:last]]
        assert len(set(views)) == len(views)


def test_points_are_placed_despite_an_outlier():
    rng = np.random.default_rng(4)
    world = rng.uniform(-1, 1, (50, 3))
    angle = np.linspace(-0.6, 0.6, 5)
    rotation = np.stack([so3_exp(np.array([0.0, a, 0.0])) for a in angle])
    translation = np.tile([0.0, 0.0, 5.0], (5, 1))
    at = np.einsum("nij,pj->pni", rotation, world) + translation
    uv = (at[..., :2] / at[..., 2:] * FOCAL).reshape(-1, 2)
    uv[::5] += 25.0  # the first view of each
    view = np.tile(np.arange(5), 50)
    tracks = rows_of(np.arange(250), np.repeat(np.arange(50), 5), np.full((50, 3), np.nan))
    placed, error = place(tracks, uv, view, Cameras(rotation, translation, FOCAL), 0.5)
    np.testing.assert_allclose(placed.points, world, atol=2e-3)
    assert (error.reshape(50, 5)[:, 1:] < 0.5).all()
    assert (error.reshape(50, 5)[:, 0] > 20).all()


def test_enough_tracks_serve_every_view():
    rng = np.random.default_rng(5)
    view = np.tile(np.arange(4), 300)
    tracks = rows_of(np.arange(1200), np.repeat(np.arange(300), 4), np.zeros((300, 3)))
    chosen = enough(tracks, view, 50, rng)
    assert (np.bincount(view[chosen.feature], minlength=4) >= 50).all()
    assert len(chosen) == 50


def test_tracks_of_two_views_count_where_there_are_few_others():
    view = np.array([0, 1, 2] * 5 + [0, 1] * 10 + [2, 3] * 10)
    track = np.repeat(np.arange(25), [3] * 5 + [2] * 20)
    tracks = rows_of(np.arange(len(view)), track, np.zeros((25, 3)))
    kept = confirmed(tracks, view, 4)
    assert (kept.lengths == 3).sum() == 5
    np.testing.assert_array_equal(np.bincount(view[kept.feature], minlength=4), [5, 5, 5 + 4, 4])


@pytest.mark.parametrize("sift_px", [640, 480])
def test_a_large_photo_has_its_features_where_they_were_photographed(sift_px):
    rgb = np.full((1500, 2000, 3), 90, np.uint8)
    places = np.random.default_rng(8).uniform(100, 1400, (30, 2))
    for x, y in places:
        cv2.circle(rgb, (round(16 * x) - 8, round(16 * y) - 8), 16 * 14, (230, 230, 230), -1, cv2.LINE_AA, 4)
    camera = Camera(2000.0, 2000.0, 1000.0, 750.0, 2000, 1500)
    looked = _look(Picture(rgb, None), camera, np.array([0.0, -1.0, 0.0]), sift_px, 500)
    off = np.linalg.norm(looked.features.pixel[:, None] - places[None], axis=2).min(0)
    assert np.median(off) < 0.5
    assert looked.grey.shape == (960, 1280)


def test_angles_are_from_the_middle_of_the_views():
    centre = np.array([[np.sin(a), 0.0, -np.cos(a)] for a in np.radians([-20.0, 0.0, 20.0])])
    cameras = Cameras(np.tile(np.eye(3), (3, 1, 1)), -centre, 500.0)
    tracks = rows_of(np.arange(3), np.zeros(3, int), np.zeros((1, 3)))
    np.testing.assert_allclose(angles_off_middle_deg(tracks, np.arange(3), cameras), [20, 0, 20], atol=1e-6)
    np.testing.assert_allclose(angles_deg(tracks, np.arange(3), cameras), [40], atol=1e-6)


def test_patches_find_a_shift_under_a_warp():
    """To a hundredth of a pixel, with another brightness and contrast, from a pixel off."""
    rng = np.random.default_rng(6)
    noise = cv2.GaussianBlur(rng.uniform(0, 255, (200, 200)).astype(np.float32), (0, 0), 2.0)
    here = ((noise - noise.min()) / np.ptp(noise) * 200 + 20) * 128
    warp = np.array([[1.05, 0.08], [-0.06, 0.92]])
    shift = np.array([3.37, -2.21])
    back = np.linalg.inv(warp)
    middle = np.array([100.0, 100.0])
    matrix = np.column_stack([back, middle - back @ (middle + shift)])
    there = cv2.warpAffine(here, matrix, (200, 200), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
    there = 0.8 * there + 1000
    images = [np.clip(image, 0, 65535).astype(np.uint16) for image in (here, there)]
    guess = np.round(middle + shift)[None]
    found, alike = np.zeros((1, 2)), np.zeros(1)
    warps = np.broadcast_to(np.eye(2), (1, 2, 2, 2)).copy()
    _align(images[0], images[1], middle[None], guess, warps, np.ones(1), found, alike)
    np.testing.assert_allclose(guess[0] + found[0], middle + shift, atol=0.02)
    assert alike[0] > 0.99


def test_pairs_are_near_each_other_and_each_once():
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    centre = 5 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    angles = view_angles(centre, np.zeros(3))
    pairs = choose_pairs(angles)
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert len(np.unique(pairs, axis=0)) == len(pairs)
    assert angles[pairs[:, 0], pairs[:, 1]].max() <= 60
    assert set(pairs.ravel()) == set(range(24))


def test_the_signed_rank_statistic_is_wilcoxons():
    from scipy.stats import wilcoxon

    gain = np.random.default_rng(7).normal(0.3, 1.0, 80)
    z = _signed_rank_z(gain)
    expected = wilcoxon(gain, alternative="greater", method="approx").zstatistic
    assert z == pytest.approx(expected, rel=1e-6)
    assert _signed_rank_z(-gain) == pytest.approx(-z)
