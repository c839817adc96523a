import cv2
import numpy as np
import pytest

from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.training.augmentation import SIZE, Sample, augment, blot, covered, draw_placement, negative, place
from kronc_ns.training.degradation import degrade
from kronc_ns.training.occlusion import cover
from kronc_ns.training.shards import Picture


def _picture(seed=0):
    rng = np.random.default_rng(seed)
    mask = np.zeros((352, 480), np.uint8)
    mask[120:260, 90:400] = 255
    points = np.column_stack([rng.uniform(95, 395, 66), rng.uniform(125, 255, 66), rng.integers(0, 3, 66)])
    return Picture(rng.integers(0, 255, (352, 480, 3), dtype=np.uint8), mask, points, "noise")


@pytest.mark.parametrize("seed", range(20))
def test_a_dot_stays_under_its_point(seed):
    rng = np.random.default_rng(seed)
    picture, at = _picture(), np.array([240.5, 180.5]) + rng.uniform(-40, 40, 2)
    matrix, _ = draw_placement(picture.mask, rng)
    scale = np.sqrt(np.linalg.det(matrix[:, :2]))
    spread = max(4.0, 2.5 / scale)  # so that it is smooth where it is shrunk most
    matrix[:, 2] += np.array([160.2, 111.7]) - matrix @ [*at, 1]  # in the middle, wherever it was drawn
    row, column = np.indices(picture.mask.shape) + 0.5
    dot = 200 * np.exp(-((column - at[0]) ** 2 + (row - at[1]) ** 2) / (2 * spread**2))
    points = np.tile([*at, 1.0], (66, 1))
    moved, _, keypoints = place(np.repeat(dot[..., None], 3, 2).astype(np.uint8), picture.mask, points, matrix, "edge")
    assert (keypoints[:, 2] == 1).all()
    weight = np.where(moved[..., 0] > 2, moved[..., 0], 0).astype(np.float64)
    row, column = np.indices(weight.shape) + 0.5
    centre = np.array([(column * weight).sum(), (row * weight).sum()]) / weight.sum()
    np.testing.assert_allclose(centre, keypoints[0, :2], atol=0.04)


def test_points_outside_are_hidden():
    picture = _picture()
    aside = np.array([[1.0, 0.0, -245.0], [0.0, 1.0, -60.0]])
    _, _, keypoints = place(picture.rgb, picture.mask, picture.keypoints, aside, "grey")
    gone = (keypoints[:, 0] < 0) & (picture.keypoints[:, 2] == 1)
    assert gone.any()
    assert (keypoints[gone, 2] == 2).all()
    np.testing.assert_array_equal(keypoints[~gone, 2], picture.keypoints[~gone, 2])


def _match(sample: Sample, before: np.ndarray) -> tuple[bool, float]:
    """Whether ``before`` went to the input by an orientation-keeping map, and the residual of the best affine one."""
    plain = np.column_stack([before, np.ones(len(before))])
    fit, *_ = np.linalg.lstsq(plain, sample.keypoints[:, :2], rcond=None)
    return np.linalg.det(fit[:2]) > 0, float(np.abs(plain @ fit - sample.keypoints[:, :2]).max())


def test_mirrored_pictures_exchange_sides():
    picture = _picture()
    swapped = picture.keypoints[list(APOLLOCAR3D_66.flip), :2]
    found = set()
    for seed in range(20):
        sample = augment(picture, [], np.random.default_rng(seed))
        straight, residual = _match(sample, picture.keypoints[:, :2])
        mirrored, other = _match(sample, swapped)
        assert min(residual, other) < 1e-9
        assert straight if residual < other else not mirrored
        found.add(residual < other)
    assert found == {True, False}


def test_samples_are_consistent():
    flipped, picture = 0, _picture()
    for seed in range(40):
        sample = augment(picture, [_picture(1)], np.random.default_rng(seed))
        assert sample.rgb.shape == (SIZE[1], SIZE[0], 3)
        assert sample.mask.shape == (SIZE[1] // 4, SIZE[0] // 4)
        seen = sample.keypoints[:, 2] == 1
        assert (sample.keypoints[seen, :2] >= 0).all()
        assert (sample.keypoints[seen, :2] < SIZE).all()
        # what is unknown stays unknown, on the same side or, mirrored, on the other
        unknown, before = sample.keypoints[:, 2] == 0, picture.keypoints[:, 2] == 0
        mirrored = before[list(APOLLOCAR3D_66.flip)]
        assert (unknown == before).all() or (unknown == mirrored).all()
        flipped += not (unknown == before).all()
    assert 5 < flipped < 35


def test_the_same_seed_gives_the_same_sample():
    one, other = (augment(_picture(), [_picture(1)], np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(one.rgb, other.rgb)
    np.testing.assert_array_equal(one.keypoints, other.keypoints)


def test_negatives_show_nothing():
    sample = negative(np.random.default_rng(0), [_picture()])
    assert not sample.mask.any()
    assert (sample.keypoints[:, 2] == 2).all()


def test_no_car_remains_in_a_negative():
    mask = _picture().mask
    share = cv2.resize(mask, SIZE, interpolation=cv2.INTER_AREA)
    assert blot(mask)[share > 0].min() > 250


def test_covered_points_are_hidden():
    picture = _picture()
    hidden = np.zeros_like(picture.mask)
    hidden[:, :240] = 255
    mask, keypoints = covered(picture.mask, picture.keypoints, hidden)
    under, seen = picture.keypoints[:, 0] < 240, picture.keypoints[:, 2] == 1
    assert (keypoints[under & seen, 2] == 2).all()
    np.testing.assert_array_equal(keypoints[~under | ~seen], picture.keypoints[~under | ~seen])
    assert not mask[:, :240].any()
    assert mask[:, 240:].any()


def test_what_covers_the_car_is_marked():
    rgb = np.zeros((224, 320, 3), np.uint8)
    changed = 0
    for seed in range(20):
        out, hidden = cover(rgb, np.array([60.0, 60.0, 250.0, 160.0]), np.random.default_rng(seed))
        painted = out.any(2)
        assert not (painted & ~(cv2.dilate(hidden, np.ones((5, 5), np.uint8)) > 0)).any()
        changed += hidden.any()
    assert changed == 20


def test_degradation_moves_nothing():
    rng = np.random.default_rng(0)
    rgb = cv2.resize(rng.integers(20, 235, (14, 20, 3), dtype=np.uint8), SIZE, interpolation=cv2.INTER_CUBIC)
    window = cv2.createHanningWindow(SIZE, cv2.CV_64F)
    still, _ = cv2.phaseCorrelate(rgb.mean(2), rgb.mean(2), window)  # OpenCV's own half pixel
    shifts = []
    for seed in range(120):
        out = degrade(rgb, np.random.default_rng(seed))
        (x, y), response = cv2.phaseCorrelate(rgb.mean(2), out.mean(2), window)
        if response > 0.5:  # else too dark or too noisy to measure
            shifts.append(np.hypot(x - still[0], y - still[1]))
    assert len(shifts) > 25
    assert np.quantile(shifts, 0.95) < 0.3
