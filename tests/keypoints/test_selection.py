import numpy as np

from kronc_ns.keypoints.selection import select_instances

SIZES = [(400, 300)] * 9


def car(u: float, v: float, half: float, confidence: float = 1.0) -> np.ndarray:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [0, 0]]) * half + [u, v]
    return np.concatenate([corners, np.full((5, 1), confidence)], axis=1)


def test_the_larger_and_more_central_car_wins():
    frames = [np.stack([car(60, 60, 20), car(200, 150, 80)])] * 3
    rows, note = select_instances(frames, SIZES)
    np.testing.assert_array_equal(rows, np.stack([car(200, 150, 80)] * 3))
    assert "3 images show several cars" in note
    assert "size and nearness" in note


def test_the_mask_overrules_size():
    mask = np.zeros((300, 400), dtype=np.uint8)
    mask[30:90, 30:90] = 255
    rows, note = select_instances([np.stack([car(60, 60, 20), car(200, 150, 80)])], SIZES, [mask])
    np.testing.assert_array_equal(rows[0], car(60, 60, 20))
    assert "mask" in note


def test_one_frame_with_a_bigger_passer_by_does_not_switch_cars():
    ours = [car(190 + i, 150, 60) for i in range(5)]
    frames = [np.stack([c]) for c in ours]
    frames[2] = np.stack([car(80, 150, 75), ours[2]])  # a car that passes close to the camera in one frame
    rows, _ = select_instances(frames, SIZES)
    np.testing.assert_array_equal(rows, np.stack(ours))


def test_frames_without_a_car_are_empty():
    rows, note = select_instances([np.zeros((0, 5, 3)), car(1, 2, 3)[None]], SIZES)
    assert (rows[0] == 0).all()
    assert (rows[1] == car(1, 2, 3)).all()
    assert "one car" in note


def test_a_car_without_a_single_point_is_no_warning(recwarn):
    nobody = np.zeros((5, 3))
    rows, _ = select_instances([np.stack([nobody, car(200, 150, 80)]), nobody[None]], SIZES)
    np.testing.assert_array_equal(rows, [car(200, 150, 80), nobody])
    assert not recwarn.list


def test_nothing_found_anywhere():
    rows, note = select_instances([np.zeros((0, 5, 3))] * 3, SIZES)
    assert rows.shape == (3, 5, 3)
    assert "no car" in note
