import math

import pytest
import torch

from kronc_ns.fit.depths import mean_distance, prior_depths, random_depths
from kronc_ns.fit.starts import circular_poses
from kronc_ns.geometry.camera import rays
from kronc_ns.geometry.poses import compose, invert, transform
from kronc_ns.geometry.rotations import so3_log
from kronc_ns.geometry.triangulation import triangulate
from kronc_ns.synthetic.scenes import make_capture
from kronc_ns.synthetic.variations import noisy_poses


def azimuths(c2w: torch.Tensor) -> torch.Tensor:
    return torch.rad2deg(torch.atan2(c2w[:, 1, 3], c2w[:, 0, 3])) % 360


def test_the_papers_circle():
    c2w = circular_poses(36)
    torch.testing.assert_close(c2w[:, :, 3].norm(dim=1), torch.full((36,), 4.0, dtype=torch.float64))
    torch.testing.assert_close(azimuths(c2w), torch.arange(36, dtype=torch.float64) * 10, atol=1e-9, rtol=0)
    torch.testing.assert_close(c2w[:, :, 2], -c2w[:, :, 3] / 4.0)  # facing the axis
    torch.testing.assert_close(
        c2w[:, :, 1], torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64).expand(36, 3)
    )  # no tilt


def test_direction_and_laps():
    clockwise = azimuths(circular_poses(4, direction="cw", laps=0.5))
    torch.testing.assert_close(clockwise, torch.tensor([0.0, 315.0, 270.0, 225.0], dtype=torch.float64))
    assert mean_distance(circular_poses(7, radius_m=2.5)) == pytest.approx(2.5)


def test_noise_turns_cameras_about_themselves():
    start = circular_poses(2000)
    noisy = noisy_poses(start, 4.0, 0.5, torch.Generator().manual_seed(0))
    noise = compose(invert(start), noisy)  # right multiplication: the noise in the camera's own frame
    turn, move = so3_log(noise[..., :3]), noise[..., 3]
    torch.testing.assert_close(turn.std(0), torch.full((3,), math.radians(4.0), dtype=torch.float64), rtol=0.06, atol=0)
    torch.testing.assert_close(move.std(0), torch.full((3,), 0.5, dtype=torch.float64), rtol=0.06, atol=0)
    assert turn.mean(0).abs().max() < math.radians(0.4)


def test_random_depths_fill_the_papers_range_and_follow_the_seed():
    c2w = circular_poses(50, radius_m=6.0)
    z = random_depths(c2w, 66, torch.Generator().manual_seed(1))
    assert 3.0 <= float(z.min()) < 3.05
    assert 5.95 < float(z.max()) <= 6.0
    assert torch.equal(z, random_depths(c2w, 66, torch.Generator().manual_seed(1)))
    assert not torch.equal(z, random_depths(c2w, 66, torch.Generator().manual_seed(2)))


def test_prior_depths_are_scaled_to_the_trajectory(walk_capture):
    """Depths in any unit come back in that of the poses, which need not be exact; unknown ones are replaced."""
    c2w, camera = walk_capture.c2w, walk_capture.camera
    points = torch.from_numpy(walk_capture.car.keypoints).expand(len(c2w), -1, -1)
    true = transform(invert(c2w), points)[..., 2]
    m = (walk_capture.keypoints[..., 2] > 0).double()
    directions, fallback = rays(walk_capture.keypoints[..., :2], camera), torch.full_like(true, 3.3)
    given = torch.where(m > 0, true / 7.3, math.nan)
    found = prior_depths(given, c2w, directions, m, fallback)
    torch.testing.assert_close(found[m > 0], true[m > 0], rtol=5e-3, atol=0)
    assert (found[m == 0] == 3.3).all()
    noisy = noisy_poses(c2w, 4.0, 0.5, torch.Generator().manual_seed(0))
    found = prior_depths(given, noisy, directions, m, fallback)
    torch.testing.assert_close(found[m > 0], true[m > 0], rtol=0.1, atol=0)
    circle = circular_poses(len(c2w), radius_m=8.0)
    ratio = prior_depths(given, circle, directions, m, fallback)[m > 0] / given[m > 0]
    assert ratio.std() < 1e-9  # one factor for all
    assert float((ratio * given[m > 0]).median()) == pytest.approx(8.0, rel=0.35)
    torch.testing.assert_close(prior_depths(given * math.nan, c2w, directions, m, fallback), fallback)


def test_triangulation_of_exact_keypoints_is_exact():
    capture = make_capture("walk", views=10, seed=2)
    seen = capture.keypoints[..., 2] > 0
    found = triangulate(capture.c2w, rays(capture.keypoints[..., :2], capture.camera), seen.double())
    known = seen.sum(0) >= 2
    torch.testing.assert_close(found[known], torch.as_tensor(capture.points)[known], atol=1e-7, rtol=0)
    never = seen.sum(0) == 0
    torch.testing.assert_close(found[never], capture.c2w[..., 3].mean(0).expand(int(never.sum()), 3), atol=1e-6, rtol=0)
