"""The decoder gives back the keypoints that fields were made from."""

import numpy as np
import pytest

from kronc_ns.capture.detection.cif import decode_cif

STRIDE = 8.0
GRID = (46, 81)  # rows, columns
SIZE = np.array([STRIDE * (GRID[1] - 1), STRIDE * (GRID[0] - 1)])


def encode(
    uv: np.ndarray, seed: int = 0, noise_px: float = 0.0, size_px: float = 20.0, height: float = 0.9
) -> np.ndarray:
    """Fields of K keypoints (px): the 4 x 4 cells around each vote for it, all others are unsure and point anywhere."""
    rng = np.random.default_rng(seed)
    shape = (len(uv), *GRID)
    row, column = np.indices(GRID)
    place = (uv / STRIDE)[:, :, None, None]
    near = (np.abs(column - place[:, 0]) < 2) & (np.abs(row - place[:, 1]) < 2)
    noise = rng.normal(0, noise_px / STRIDE, (2, *shape))
    x = np.where(near, place[:, 0] + noise[0], column + rng.normal(0, 3, shape))
    y = np.where(near, place[:, 1] + noise[1], row + rng.normal(0, 3, shape))
    confidence = np.where(near, height * rng.uniform(0.7, 1.0, shape), rng.uniform(0, 0.09, shape))
    return np.stack([confidence, x, y, np.ones(shape), np.full(shape, size_px / STRIDE)], axis=1)


def keypoints(seed: int, count: int = 66) -> np.ndarray:
    return np.random.default_rng([seed, 1]).uniform(20, SIZE - 20, (count, 2))


@pytest.mark.parametrize("size_px", [4.0, 20.0, 60.0])
def test_exact_votes_give_the_exact_place(size_px: float):
    uv = keypoints(0)
    cells, confidence = decode_cif(encode(uv, size_px=size_px))
    assert np.linalg.norm(STRIDE * cells - uv, axis=1).max() < 0.2
    assert (confidence > 0.5).all()
    assert (confidence <= 1).all()


@pytest.mark.parametrize("size_px", [4.0, 20.0, 60.0])
def test_noise_in_the_votes_averages_out(size_px: float):
    errors = []
    for seed in range(6):
        uv = keypoints(seed)
        cells, _ = decode_cif(encode(uv, seed, noise_px=4.0, size_px=size_px))
        errors.append(np.linalg.norm(STRIDE * cells - uv, axis=1))
    assert np.mean(errors) < 1.5  # the mean of 16 votes is off by 1.25 px on average: no estimate can do better


def test_confidence_follows_the_votes():
    uv = keypoints(1)
    sure, unsure = (decode_cif(encode(uv, height=height))[1] for height in (0.9, 0.45))
    np.testing.assert_allclose(unsure, sure / 2, rtol=1e-6)


def test_a_field_without_votes_finds_nothing():
    fields = encode(keypoints(2))
    fields[3, 0] *= 0.0
    cells, confidence = decode_cif(fields)
    assert confidence[3] == 0
    assert (cells[3] == 0).all()
    assert (np.delete(confidence, 3) > 0.5).all()
    assert (decode_cif(np.zeros((2, 5, 7, 9)))[1] == 0).all()


def test_the_second_car_neither_wins_nor_pulls():
    ours, theirs = keypoints(3), keypoints(4)
    apart = np.linalg.norm(ours - theirs, axis=1) > 60
    strong, weak = encode(ours, height=0.9), encode(theirs, height=0.6)
    both = np.where(weak[:, :1] > np.maximum(strong[:, :1], 0.1), weak, strong)
    cells, _ = decode_cif(both)
    assert apart.sum() > 40
    assert np.linalg.norm(STRIDE * cells - ours, axis=1)[apart].max() < 0.2


def test_what_is_allowed_decides_between_two_cars():
    shift = np.array([SIZE[0] / 2, 0.0])
    ours = np.random.default_rng(5).uniform(20, SIZE * (0.5, 1) - 20, (30, 2))
    weak, strong = encode(ours, height=0.5), encode(ours + shift, height=0.95)
    both = np.where(strong[:, :1] > np.maximum(weak[:, :1], 0.1), strong, weak)
    assert np.linalg.norm(STRIDE * decode_cif(both)[0] - (ours + shift), axis=1).max() < 0.2
    cells, _ = decode_cif(both, lambda places: places[..., 0] * STRIDE < SIZE[0] / 2)
    assert np.linalg.norm(STRIDE * cells - ours, axis=1).max() < 0.2


def test_places_move_with_the_votes():
    fields = encode(keypoints(6))
    moved = fields.copy()
    moved[:, 1] += 0.3
    moved[:, 2] -= 1.7
    np.testing.assert_allclose(decode_cif(moved)[0] - decode_cif(fields)[0], np.tile([0.3, -1.7], (66, 1)), atol=1e-9)
