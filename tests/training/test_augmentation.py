import cv2
import numpy as np
import pytest

from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.training.augmentation import SIZE, augment, draw_placement, negative, place
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
    at = np.array([240.5, 180.5]) + rng.integers(-40, 40, 2)
    rgb = np.zeros((352, 480, 3), np.uint8)
    cv2.circle(rgb, (int(at[0]), int(at[1])), 9, (255, 255, 255), -1)
    picture = _picture()
    matrix, outside = draw_placement(picture.mask, rng)
    points = np.zeros((66, 3))
    points[:] = [*at, 1]
    moved, _, keypoints = place(rgb, picture.mask, points, matrix, outside)
    if keypoints[0, 2] != 1 or not (keypoints[0, :2] > 14).all() or not (keypoints[0, :2] < np.array(SIZE) - 14).all():
        return
    weight = np.maximum(moved[..., 0].astype(float) - 130, 0)  # above the grey of what lies outside
    row, column = np.indices(weight.shape) + 0.5
    centre = np.array([(column * weight).sum(), (row * weight).sum()]) / weight.sum()
    np.testing.assert_allclose(centre, keypoints[0, :2], atol=0.35)


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
