"""Bundle adjustment with the points eliminated: derivatives, the Schur step, the gauge and the covariance."""

import numpy as np
import pytest

from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.solve import bundle, elimination, sandwich
from kronc_ns.solve.sightings import Sightings, Unknowns, gauge_of

NOISE = 0.3


def problem(rng, views=5, points=40, intrinsics=(False, False), lenses=1):
    """Cameras on an arc around random points, each of which two or more of them see."""
    angle = np.linspace(0, 1.5, views)
    rotation = np.stack([so3_exp(np.array([0.1 * i, a, 0.05 * i])) for i, a in enumerate(angle)])
    world = rng.uniform(-1, 1, (points, 3))
    translation = np.tile([0.0, 0.0, 5.0], (views, 1)) + rng.normal(0, 0.1, (views, 3))
    seen = rng.random((points, views)) < 0.7
    seen[:, :2] = True
    _, view = np.nonzero(seen)
    first = np.concatenate([[0], np.cumsum(seen.sum(1))]).astype(np.int64)
    lens = (np.arange(views) % lenses).astype(np.int64)
    empty = np.zeros((len(view), 2))
    weight, scale = rng.uniform(0.5, 2, len(view)), np.full(len(view), 3.0)
    data = Sightings(first, view.astype(np.int64), empty, weight, scale, np.array([500.0, 480.0]), lens, *intrinsics)
    now = Unknowns(rotation, translation, world, np.zeros((lenses, 2)))
    error = np.empty((len(view), 2))
    elimination.errors(data, now, error)
    return data._replace(uv=error), now


def moved(now, change, data):
    """The unknowns after a small change of all of them: cameras, intrinsics, points."""
    views = len(now.rotation)
    twist = change[: 6 * views].reshape(views, 6)
    turn = so3_exp(twist[:, :3])
    rest = change[6 * views : data.unknowns].reshape(len(now.intrinsics), -1)
    intrinsics = now.intrinsics.copy()
    for column, unknown in enumerate(k for k, on in enumerate((data.with_focal, data.with_k1)) if on):
        intrinsics[:, unknown] += rest[:, column]
    points = now.points + change[data.unknowns :].reshape(-1, 3)
    return Unknowns(
        turn @ now.rotation, np.einsum("nij,nj->ni", turn, now.translation) + twist[:, 3:], points, intrinsics
    )


def jacobian(data, now):
    """Of all errors by all unknowns, by central differences."""
    size = data.unknowns + now.points.size
    columns = []
    for k in range(size):
        ends = []
        for sign in (1, -1):
            change = np.zeros(size)
            change[k] = sign * 1e-6
            error = np.empty((len(data.camera), 2))
            elimination.errors(data, moved(now, change, data), error)
            ends.append(error.ravel())
        columns.append((ends[0] - ends[1]) / 2e-6)
    return np.stack(columns, axis=1)


def dense(data, now, power=1):
    """Normal matrix and gradient of all unknowns, with the IRLS weights to a power."""
    j, error = jacobian(data, now), np.empty((len(data.camera), 2))
    elimination.errors(data, now, error)
    factor = 1 / (1 + (error**2).sum(1) / data.scale**2)
    bend = np.repeat(data.weight * factor**power, 2)
    weight = np.repeat(data.weight * factor, 2)
    return j.T @ (bend[:, None] * j), j.T @ (weight * error.ravel())


@pytest.mark.parametrize("intrinsics", [(False, False), (True, False), (False, True), (True, True)])
@pytest.mark.parametrize("lenses", [1, 2])
def test_the_reduced_system_is_the_schur_complement(intrinsics, lenses):
    rng = np.random.default_rng(3)
    data, now = problem(rng, intrinsics=intrinsics, lenses=lenses)
    data = data._replace(uv=data.uv + rng.normal(0, 1.0, data.uv.shape))
    whole, gradient = dense(data, now)
    cut = data.unknowns
    inverse = np.linalg.inv(whole[cut:, cut:])
    expected = whole[:cut, :cut] - whole[:cut, cut:] @ inverse @ whole[cut:, :cut]
    found = bundle.normal_matrix(data, now)
    np.testing.assert_allclose(found, expected, atol=2e-5 * np.abs(expected).max())
    np.testing.assert_allclose(found, found.T, atol=1e-6 * np.abs(found).max())
    room = elimination.Reduced.of(data)
    elimination.reduce(data, now, 0.0, False, room)
    np.testing.assert_allclose(
        room.gradient[0],
        gradient[:cut] - whole[:cut, cut:] @ inverse @ gradient[cut:],
        atol=1e-4 * np.abs(gradient).max(),
    )


def test_the_gauge_changes_no_image():
    data, now = problem(np.random.default_rng(1))
    matrix = bundle.normal_matrix(data, now)
    gauge = gauge_of(now, len(matrix))
    assert np.linalg.matrix_rank(gauge) == 7
    assert np.abs(matrix @ gauge).max() < 1e-5 * np.abs(matrix).max() * np.abs(gauge).max()
    assert (np.linalg.eigvalsh(matrix)[7:] > 1e-3).all()


@pytest.mark.parametrize("intrinsics", [(False, False), (True, True)])
def test_exact_sightings_are_met_exactly(intrinsics):
    rng = np.random.default_rng(5)
    data, truth = problem(rng, views=6, points=60, intrinsics=intrinsics)
    change = rng.normal(0, 0.01, data.unknowns + truth.points.size)
    start = moved(truth, change, data)
    found = bundle.adjust(data, start, 50, 1e-14)
    assert bundle.error_px(data, found.now).max() < 1e-4
    np.testing.assert_allclose(found.now.intrinsics, truth.intrinsics, atol=1e-5)


def test_outliers_hardly_move_the_result():
    rng = np.random.default_rng(6)
    data, truth = problem(rng, views=6, points=80)
    uv = data.uv + rng.normal(0, NOISE, data.uv.shape)
    uv[rng.random(len(uv)) < 0.05] += 40.0
    data = data._replace(uv=uv, scale=np.full(len(uv), NOISE))
    found = bundle.adjust(data, truth, 50, 1e-12)
    assert np.median(bundle.error_px(data, found.now)) < 1.3 * NOISE


def test_a_point_behind_a_camera_is_an_outlier_and_no_step_creates_one():
    data, now = problem(np.random.default_rng(7))
    behind = now.points.copy()
    behind[0] = -now.rotation[0].T @ (now.translation[0] + [0, 0, 2.0])
    error = bundle.error_px(data, now._replace(points=behind))
    assert error[0] == pytest.approx(1e4)
    assert np.isfinite(bundle.adjust(data, now._replace(points=behind), 10, 1e-9).now.rotation).all()


def test_the_sandwich_is_the_spread_of_estimates():
    """Over many draws of the noise the poses spread as the covariance says, Cauchy's loss and all.

    With points of seven sightings; of three, which show less noise than they have, it is a fifth too small.
    """
    rng = np.random.default_rng(8)
    clean, truth = problem(rng, views=10, points=60)
    weight = np.full(len(clean.camera), NOISE**-2)
    clean = clean._replace(weight=weight, scale=np.full(len(weight), NOISE))
    draws, predicted = [], []
    gauge = np.linalg.qr(gauge_of(truth, clean.unknowns))[0]
    project = np.eye(clean.unknowns) - gauge @ gauge.T
    for _ in range(150):
        data = clean._replace(uv=clean.uv + rng.normal(0, NOISE, clean.uv.shape))
        found = bundle.adjust(data, truth, 30, 1e-10).now
        turn = found.rotation @ truth.rotation.transpose(0, 2, 1)
        w = (
            np.stack([turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1)
            / 2
        )
        v = found.translation - np.einsum("nij,nj->ni", turn, truth.translation)
        draws.append(project @ np.concatenate([w, v], axis=1).ravel())
        matrix, scores = sandwich.sandwich(data, found)
        inverse = project @ np.linalg.inv(matrix + np.trace(matrix) * (gauge @ gauge.T))
        predicted.append(np.diag(inverse @ scores @ inverse.T))
    measured = 2 * len(weight) - truth.points.size
    taken_up = measured / (measured - clean.unknowns + 7)  # of the noise, by the cameras
    ratio = np.sqrt(taken_up * np.mean(predicted, axis=0) / np.var(draws, axis=0))
    assert 0.8 < np.median(ratio) < 1.15
