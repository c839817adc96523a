"""Views whose poses are wrong or unknown, placed by their features; detections that err alike."""

from dataclasses import replace

import numpy as np
import pytest

from kronc_ns.files.photos import photos
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.geometry.camera import Camera
from kronc_ns.geometry.poses import look_at
from kronc_ns.geometry.rotations import rotation_angle_deg, so3_exp
from kronc_ns.refine.adjustment import Adjusted
from kronc_ns.refine.gathering import Gathered
from kronc_ns.refine.keypoints import MOST_ALIKE, KeypointTracks, alike
from kronc_ns.refine.pipeline import refine_scene
from kronc_ns.refine.placement import across, placed, relocated, seated
from kronc_ns.refine.rig import Rig
from kronc_ns.refine.rounds import _mended
from kronc_ns.refine.search import Search, find_tracks
from kronc_ns.refine.tracks import Linked, of_held_views, rows_of, view_medians, without_views
from kronc_ns.solution import ViewStatus

CAMERA = Camera(500.0, 500.0, 320.0, 240.0, 640, 480)


def ring(count: int) -> Rig:
    """Cameras on an arc around the origin."""
    angle = np.linspace(0.0, 1.2, count)
    eyes = np.stack([6 * np.cos(angle), 6 * np.sin(angle), np.full(count, 1.5)], axis=1)
    c2w = look_at(eyes, np.zeros_like(eyes), np.array([0.0, 0.0, 1.0]))
    return Rig.of(c2w, (CAMERA,), np.zeros(count, np.int64), np.zeros((4, 3)))


def features(rig: Rig, points, rng, noise_px: float, unlike: int = 0):
    """All points seen by all cameras, each with a word of its own; and as many words of nothing, ``unlike`` a view."""
    words = rng.random((len(points), 128)).astype(np.float32)
    view, pixel, descriptor = [], [], []
    for n, (rotation, shift) in enumerate(zip(rig.rotation, rig.translation, strict=True)):
        seen = points @ rotation.T + shift
        uv = seen[:, :2] / seen[:, 2:] * CAMERA.fx + [CAMERA.cx, CAMERA.cy]
        own = words + 0.1 * rng.random(words.shape).astype(np.float32)
        pixel.append(np.concatenate([uv + rng.normal(0, noise_px, uv.shape), rng.uniform(0, 480, (unlike, 2))]))
        descriptor.append(np.concatenate([own, rng.random((unlike, 128)).astype(np.float32)]))
        view.append(np.full(len(uv) + unlike, n))
    descriptor = np.concatenate(descriptor)
    descriptor /= np.linalg.norm(descriptor, axis=1, keepdims=True)
    each = len(points) + unlike
    view = np.concatenate(view)
    return Gathered(
        each * np.arange(len(rig.rotation) + 1),
        descriptor,
        np.ones(len(view)),
        view,
        np.concatenate(pixel),
        None,
        np.zeros((len(view), 3), np.uint8),
        Linked.none(),
        (),
    )


def made(rng, views=8, count=80, hidden_from=5):
    """A rig, its features, and tracks in which view 5 takes no part but with a few."""
    rig = ring(views)
    points = rng.uniform([-2, -1, 0], [2, 1, 1.5], (count, 3))
    gathered = features(rig, points, rng, 0.2, unlike=30)
    each = count + 30
    numbers = np.arange(views)[None] * each + np.arange(count)[:, None]
    here = np.ones((count, views), bool)
    here[4:, hidden_from] = False
    tracks = rows_of(numbers[here], np.repeat(np.arange(count), here.sum(1)), points)
    return rig, gathered, tracks


def turned(rig: Rig, view: int, deg: float) -> Rig:
    """With one camera carried around the upright axis."""
    around = so3_exp(np.deg2rad([0.0, 0.0, deg]))
    rotation = rig.rotation.copy()
    rotation[view] = rotation[view] @ around
    return replace(rig, rotation=rotation)


def used(gathered):
    return np.ones(len(gathered.view), bool)


@pytest.mark.parametrize("deg", [8.0, 178.0])
def test_a_view_that_was_placed_wrongly_is_found(deg):
    rig, gathered, tracks = made(np.random.default_rng(0))
    wrong = Adjusted(turned(rig, 5, deg), tracks, gathered, 0.2, 1.0, 0.2)
    found = relocated(wrong, gathered, used(gathered))
    assert rotation_angle_deg(found.rotation @ rig.rotation.transpose(0, 2, 1)).max() < 0.1
    assert np.linalg.norm(found.cameras.centre - rig.cameras.centre, axis=1).max() < 0.01


@pytest.mark.parametrize(("astray", "moves"), [(20, True), (45, False)])
def test_a_wrong_pose_that_some_features_seem_to_confirm_gives_way_to_many_more(astray, moves):
    """Guided matching finds chance matches along the lines of a wrong pose, which then follow it."""
    rig, gathered, tracks = made(np.random.default_rng(3))
    wrong = turned(rig, 5, 25.0)
    seen = tracks.points[:astray] @ wrong.rotation[5].T + wrong.translation[5]
    gathered.pixel[gathered.first[5] + np.arange(astray)] = seen[:, :2] / seen[:, 2:] * 500.0 + [320.0, 240.0]
    found = relocated(Adjusted(wrong, tracks, gathered, 0.2, 1.0, 0.2), gathered, used(gathered))
    off = rotation_angle_deg(found.rotation[5].T @ (rig if moves else wrong).rotation[5])
    assert off < 0.1


def test_views_that_lie_right_or_have_features_enough_stay():
    rig, gathered, tracks = made(np.random.default_rng(1))
    right = relocated(Adjusted(rig, tracks, gathered, 0.2, 0.2, 0.2), gathered, used(gathered))
    np.testing.assert_array_equal(right.rotation, rig.rotation)
    well_seen = turned(rig, 2, 8.0)  # whose many tracks the next adjustment will heed
    left = relocated(Adjusted(well_seen, tracks, gathered, 0.2, 1.0, 0.2), gathered, used(gathered))
    np.testing.assert_array_equal(left.rotation, well_seen.rotation)


@pytest.mark.parametrize("told", [True, False])
@pytest.mark.parametrize("deg", [40.0, 178.0])
def test_views_that_stand_astray_are_seated_by_their_own_tracks(deg, told):
    """Of tracks that owe nothing to the poses; others stay where they are."""
    rig, gathered, tracks = made(np.random.default_rng(0), hidden_from=7)
    wrong = turned(turned(rig, 2, deg), 5, deg)
    astray = np.isin(np.arange(8), [2, 5]) & told
    used_so_far = without_views(tracks, gathered.view, astray)
    found, which = seated(Adjusted(wrong, used_so_far, gathered, 0.2, 1.0, 0.2), tracks, astray)
    assert np.flatnonzero(which).tolist() == [2, 5]
    off = rotation_angle_deg(found.rotation @ rig.rotation.transpose(0, 2, 1))
    assert off[[2, 5]].max() < 0.1
    assert np.linalg.norm(found.cameras.centre - rig.cameras.centre, axis=1).max() < 0.01
    rest = [0, 1, 3, 4, 6, 7]
    np.testing.assert_array_equal(found.rotation[rest], rig.rotation[rest])


def test_tracks_that_nothing_explains_seat_nobody():
    rng = np.random.default_rng(1)
    rig, gathered, tracks = made(rng, hidden_from=7)
    gathered.pixel[gathered.first[5] : gathered.first[6]] = rng.uniform(0, 480, (110, 2))
    found, which = seated(Adjusted(rig, tracks, gathered, 0.2, 1.0, 0.2), tracks, np.zeros(8, bool))
    assert not which.any()
    np.testing.assert_array_equal(found.rotation, rig.rotation)


def test_a_view_may_be_left_out_of_tracks():
    tracks = rows_of(np.arange(9), np.array([0, 0, 0, 1, 1, 2, 2, 2, 2]), np.arange(9.0).reshape(3, 3))
    view = np.array([0, 1, 2, 0, 1, 0, 1, 2, 3])
    left = without_views(tracks, view, np.array([False, True, False, False]))
    assert left.feature.tolist() == [0, 2, 5, 7, 8]
    assert left.of_track.tolist() == [0, 0, 1, 1, 1]
    np.testing.assert_array_equal(left.points, tracks.points[[0, 2]])
    assert without_views(tracks, view, np.zeros(4, bool)).feature.tolist() == tracks.feature.tolist()


def test_medians_are_those_of_sightings_that_others_confirm():
    tracks = rows_of(np.arange(10), np.array([0, 0, 0, 1, 1, 1, 1, 2, 2, 2]), np.zeros((3, 3)))
    view = np.array([0, 1, 2, 0, 1, 2, 3, 0, 1, 2])
    error = np.array([1.0, 5.0, 0.1, 3.0, 6.0, 0.2, 9.0, 2.0, 4.0, 0.3])
    np.testing.assert_array_equal(view_medians(tracks, error, view, 5), [2.0, 5.0, 0.2, 9.0, 0.0])
    pair = rows_of(np.arange(2), np.zeros(2, int), np.zeros((1, 3)))
    assert not view_medians(pair, np.ones(2), view, 5).any()


def test_features_that_may_not_be_used_place_nothing():
    rig, gathered, tracks = made(np.random.default_rng(2))
    wrong = turned(rig, 5, 178.0)
    barred = gathered.view != 5
    found = relocated(Adjusted(wrong, tracks, gathered, 0.2, 1.0, 0.2), gathered, barred)
    np.testing.assert_array_equal(found.rotation, wrong.rotation)


def test_photos_that_took_no_part_are_placed_and_others_are_not():
    rng = np.random.default_rng(3)
    rig, gathered, tracks = made(rng)
    known = tracks.points
    more = ring(3)
    absent = features(more, known, rng, 0.2)
    strangers = features(more, rng.uniform([-2, -1, 0], [2, 1, 1.5], known.shape), np.random.default_rng(99), 0.2)
    adjusted = Adjusted(rig, tracks, gathered, 0.2, 0.2, 0.2)
    # their words are those of the points they show
    first = gathered.descriptor[: len(known)]
    absent = replace(absent, descriptor=np.tile(first, (3, 1)))
    found = placed(adjusted, gathered, absent, used(absent), more)
    assert rotation_angle_deg(found.rotation @ more.rotation.transpose(0, 2, 1)).max() < 0.1
    nowhere = placed(adjusted, gathered, strangers, used(strangers), more)
    assert np.isnan(nowhere.rotation).all()


def test_sightings_of_views_that_features_hardly_hold_are_left_out():
    _, gathered, tracks = made(np.random.default_rng(4))
    held = of_held_views(tracks, gathered.view, 0.1)
    seen = np.bincount(gathered.view[held.feature], minlength=8)
    assert seen[5] == 0
    assert (np.delete(seen, 5) == 80).all()
    same = of_held_views(tracks, gathered.view, 0.01)
    np.testing.assert_array_equal(same.feature, tracks.feature)


def test_neighbours_that_stand_across_the_car_together_are_found_though_they_confirm_each_other():
    """A detector takes the front for the rear in photos side by side; what these share fits where they are put."""
    rig = ring(12)
    rng = np.random.default_rng(8)
    points = rng.uniform([-2, -1, 0], [2, 1, 1.5], (80, 3))
    gathered = features(rig, points, rng, 0.2, unlike=30)
    together = np.isin(np.arange(12), (4, 5, 6))
    here = np.concatenate([np.tile(~together, (40, 1)), np.tile(together, (40, 1))])
    numbers = np.arange(12)[None] * 110 + np.arange(80)[:, None]
    around = so3_exp(np.array([0.0, 0.0, np.pi]))
    carried = np.concatenate([points[:40], points[40:] @ around])
    tracks = rows_of(numbers[here], np.repeat(np.arange(80), here.sum(1)), carried)
    rotation = np.where(together[:, None, None], rig.rotation @ around, rig.rotation)
    wrong = Adjusted(replace(rig, rotation=rotation), tracks, gathered, 0.2, 0.2, 0.2)
    found = relocated(wrong, gathered, used(gathered))
    assert rotation_angle_deg(found.rotation @ rig.rotation.transpose(0, 2, 1)).max() < 0.1
    assert np.linalg.norm(found.cameras.centre - rig.cameras.centre, axis=1).max() < 0.01


def test_runs_across_the_car_are_told_from_laps_and_from_jumps():
    def between(azimuth):
        off = np.abs(np.subtract.outer(azimuth, azimuth)) % 360
        return np.minimum(off, 360 - off)

    lap = 25.0 * np.arange(12)
    assert not across(between(lap)).any()
    assert not across(between(np.concatenate([lap[:6], lap[:6] + 180]))).any()  # goes on there
    turned = lap.copy()
    turned[[2, 7, 8]] += 180
    assert across(between(turned)).tolist() == [0, 0, 1, 0, 0, 0, 0, 2, 2, 0, 0, 0]
    ends = 24.0 * np.arange(15)  # a whole lap: the first follows the last
    ends[[0, 14]] += 180
    assert across(between(ends)).tolist() == [1] + 13 * [0] + [1]
    assert not across(between(np.random.default_rng(0).permutation(6.0 * np.arange(60)))).any()  # in no order
    half = 15.0 * np.arange(12)
    half[0] += 180
    assert not across(between(half)).any()
    turned[3:8] = lap[3:8] + 180
    assert not across(between(turned))[3:8].any()  # too many of them to be the wrong ones


def seen_of(tracks, gathered, view: int) -> int:
    return int((gathered.view[tracks.feature] == view).sum())


def found_in_tilted(hidden_from: int) -> int:
    """Features of view 5 that are found though its pose has them 13 px off, where ``hidden_from`` has few tracks."""
    rig, gathered, tracks = made(np.random.default_rng(6), hidden_from=hidden_from)
    rotation = rig.rotation.copy()
    rotation[5] = so3_exp(np.array([13 / 500, 0.0, 0.0])) @ rotation[5]
    tilted = replace(rig, rotation=rotation, keypoints=tracks.points[:12])
    keypoints = detections(tilted, tracks.points[:12], np.zeros((8, 12, 2)))
    search = Search(np.stack(np.triu_indices(8, 1), axis=1), used(gathered), False, lambda: None)
    again = find_tracks(gathered, search, tilted, keypoints, Adjusted(tilted, tracks, gathered, 0.2, 0.2, 0.2))
    return seen_of(again, gathered, 5)


def test_a_view_that_features_do_not_hold_is_searched_for_as_widely_as_at_first():
    assert found_in_tilted(hidden_from=5) > 1.5 * found_in_tilted(hidden_from=0)


def test_what_was_seen_with_a_view_that_moved_is_believed_no_more():
    rig, gathered, tracks = made(np.random.default_rng(7))
    search = Search(np.zeros((0, 2), np.int64), used(gathered), False, lambda: None)
    mended = _mended(Adjusted(turned(rig, 5, 25.0), tracks, gathered, 0.2, 1.0, 0.2), gathered, search)
    assert rotation_angle_deg(mended.rig.rotation[5].T @ rig.rotation[5]) < 0.1
    assert seen_of(mended.tracks, gathered, 5) == 0
    assert len(mended.tracks) == len(tracks) - 4  # the four that it had seen
    left = _mended(Adjusted(rig, tracks, gathered, 0.2, 0.2, 0.2), gathered, search)
    assert len(left.tracks) == len(tracks)


def detections(rig: Rig, points, noise):
    """Every point in every view, point by point; ``noise`` [n j 2]."""
    seen = np.einsum("nij,pj->pni", rig.rotation, points) + rig.translation
    uv = seen[..., :2] / seen[..., 2:] * CAMERA.fx + [CAMERA.cx, CAMERA.cy] + noise.transpose(1, 0, 2)
    count, views = uv.shape[:2]
    return KeypointTracks(
        views * np.arange(count + 1),
        np.tile(np.arange(views), count),
        np.arange(count),
        uv.reshape(-1, 2),
        np.ones(views * count),
        np.ones(views * count, bool),
    )


def fitted(rig: Rig, points, keypoints: KeypointTracks) -> Rig:
    """Each view's pose as its detections have it."""
    from scipy.optimize import least_squares

    rotation, translation = rig.rotation.copy(), rig.translation.copy()
    uv = rig.ideal(keypoints.pixel, keypoints.view).reshape(len(points), -1, 2)
    for n in range(len(rotation)):

        def residual(x, n=n):
            seen = points @ (so3_exp(x[:3]) @ rig.rotation[n]).T + rig.translation[n] + x[3:]
            return (seen[:, :2] / seen[:, 2:] * CAMERA.fx - uv[:, n]).ravel()

        x = least_squares(residual, np.zeros(6)).x
        rotation[n], translation[n] = so3_exp(x[:3]) @ rig.rotation[n], rig.translation[n] + x[3:]
    return replace(rig, rotation=rotation, translation=translation)


def test_how_much_detections_err_alike_is_seen():
    rng = np.random.default_rng(5)
    rig = ring(40)
    points = rng.uniform([-2, -1, 0], [2, 1, 1.5], (30, 3))
    single = rng.normal(0, 1, (40, 30, 2))
    near = np.exp(-np.linalg.norm(points[:, None] - points[None], axis=-1) / 0.7)
    together = np.einsum("pq,nqk->npk", np.linalg.cholesky(near), single)
    for noise, least, most in ((single, 1.0, 1.4), (together, 2.0, MOST_ALIKE)):
        keypoints = detections(rig, points, noise)
        before = fitted(rig, points, keypoints)
        assert least <= alike(keypoints, before, rig) <= most
    assert alike(keypoints, before, before) == 1.0


def test_noisier_detections_weigh_less():
    keypoints = detections(ring(3), np.zeros((2, 3)), np.zeros((3, 2, 2)))
    np.testing.assert_allclose(keypoints.noisier(4.0).sigma_px, 2.0)


def unknown(solved, view: int, c2w):
    """The scene without one view's keypoints, and the solution with another pose of it."""
    scene, solution = solved
    keypoints = scene.keypoints.copy()
    keypoints[view, :, 2] = 0
    poses, reports = solution.c2w.copy(), list(solution.views)
    poses[view] = c2w
    status = ViewStatus.COMPLETED if np.isfinite(c2w).all() else ViewStatus.FAILED
    reports[view] = replace(reports[view], status=status, reason="it has no keypoints")
    return replace(scene, keypoints=keypoints), replace(solution, c2w=poses, views=tuple(reports))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["no pose", "the opposite pose"])
def test_a_photo_without_keypoints_is_placed_by_features(walk, solved, kind):
    view = 6
    around = so3_exp(np.array([0.0, 0.0, np.pi]))
    opposite = np.concatenate([around @ solved[1].c2w[view][:, :3], around @ solved[1].c2w[view][:, 3:]], axis=1)
    scene, solution = unknown(solved, view, opposite if kind != "no pose" else np.full((3, 4), np.nan))
    found = refine_scene(scene, solution, photos(walk[0], scene))
    assert found.images.accepted
    assert found.views[view].status is ViewStatus.SOLVED
    assert found.views[view].reason == ""
    assert pose_errors(found.c2w, walk[1].c2w)[0][view] < 0.5


@pytest.mark.slow
def test_a_photo_of_something_else_gets_no_pose(walk, solved):
    scene, solution = unknown(solved, 6, np.full((3, 4), np.nan))
    read = photos(walk[0], scene)
    rng = np.random.default_rng(0)
    other = rng.integers(0, 255, (60, 80, 3)).astype(np.uint8).repeat(6, 0).repeat(6, 1)

    def pictures(view):
        picture = read(view)
        return replace(picture, rgb=np.resize(other, picture.rgb.shape)) if view == 6 else picture

    found = refine_scene(scene, solution, pictures)
    assert found.images.accepted
    assert found.views[6].status is ViewStatus.FAILED
    assert np.isnan(found.c2w[6]).all()
