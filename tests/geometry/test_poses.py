import torch

from kronc_ns.geometry.poses import compose, flip_camera_axes, invert, look_at, make_pose, transform
from kronc_ns.geometry.rotations import so3_exp


def poses(n: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    draw = torch.randn(n, 6, dtype=torch.float64, generator=generator)
    return make_pose(so3_exp(draw[:, :3]), draw[:, 3:])


def identity(n: int) -> torch.Tensor:
    return torch.eye(4, dtype=torch.float64)[:3].expand(n, 3, 4)


def test_group_axioms():
    a, b, c = poses(20, 0), poses(20, 1), poses(20, 2)
    torch.testing.assert_close(compose(compose(a, b), c), compose(a, compose(b, c)))
    torch.testing.assert_close(compose(a, invert(a)), identity(20))
    torch.testing.assert_close(compose(invert(a), a), identity(20))
    torch.testing.assert_close(compose(a, identity(20)), a)
    torch.testing.assert_close(invert(compose(a, b)), compose(invert(b), invert(a)))


def test_transform_acts_as_a_group():
    a, b = poses(5, 0), poses(5, 1)
    points = torch.randn(5, 7, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    torch.testing.assert_close(transform(compose(a, b), points), transform(a, transform(b, points)))


def test_look_at_puts_the_target_on_the_axis_and_up_upwards():
    centres = torch.tensor([[3.0, 1.0, 2.0], [-2.0, 4.0, 0.5]], dtype=torch.float64)
    target = torch.tensor([[0.1, 0.2, 0.3], [0.0, 0.0, 0.7]], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    w2c = invert(look_at(centres, target, up))
    seen = transform(w2c, target[:, None])[:, 0]
    torch.testing.assert_close(seen[:, :2], torch.zeros(2, 2, dtype=torch.float64))
    assert (seen[:, 2] > 0).all()
    higher = transform(w2c, (target + 0.1 * up)[:, None])[:, 0]
    assert (higher[:, 1] < 0).all(), "image y points down"


def test_flip_is_its_own_inverse_and_keeps_rotations():
    a = poses(10)
    flipped = flip_camera_axes(a)
    torch.testing.assert_close(flip_camera_axes(flipped), a)
    torch.testing.assert_close(torch.linalg.det(flipped[..., :3]), torch.ones(10, dtype=torch.float64))
    torch.testing.assert_close(flipped[..., 2], -a[..., 2])
    torch.testing.assert_close(flipped[..., 3], a[..., 3])
