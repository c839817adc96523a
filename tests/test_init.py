import math

import pytest
import torch

from kronc_ns.geometry.poses import compose, invert
from kronc_ns.geometry.rotations import so3_log
from kronc_ns.init import circular_poses, mean_distance, noisy_poses, prior_depths, random_depths


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


def test_prior_depths():
    c2w, fallback = circular_poses(2), torch.full((2, 3), 3.3, dtype=torch.float64)
    given = torch.tensor([[10.0, math.nan, 20.0], [15.0, math.nan, 15.0]], dtype=torch.float64)
    metric = prior_depths(given, c2w, fallback, metric=True)
    torch.testing.assert_close(metric, torch.where(given.isnan(), fallback, given))
    scaled = prior_depths(given, c2w, fallback, metric=False)
    torch.testing.assert_close(scaled, torch.where(given.isnan(), fallback, given * 3.0 / 15.0))
    torch.testing.assert_close(prior_depths(given * math.nan, c2w, fallback, metric=False), fallback)
