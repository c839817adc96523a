"""Small problems for the solver's tests."""

import torch
from torch import Tensor

from kronc_ns.fit.starts import circular_poses
from kronc_ns.geometry.alignment import Similarity
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.solve.problem import Problem, State
from kronc_ns.synthetic.variations import noisy_poses

FOCAL = (400.0, 390.0)
SIMILARITY = Similarity(
    torch.tensor(1.7, dtype=torch.float64),
    so3_exp(torch.tensor([0.4, -1.1, 0.7], dtype=torch.float64)),
    torch.tensor([0.5, -2.0, 3.0], dtype=torch.float64),
)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def randn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=generator(seed))


def scene(
    views: int = 8,
    joints: int = 12,
    batch: int = 1,
    noise_px: float = 0.0,
    outliers: float = 0.0,
    seen: float = 0.8,
    seed: int = 0,
    **options,
) -> tuple[Problem, State]:
    """Cameras in a lap around a cloud of points 1 m wide, what they see of it, and the truth."""
    points = 0.7 * randn(joints, 3, seed=seed)
    c2w = noisy_poses(circular_poses(views), 6.0, 0.3, generator(seed + 1))
    truth = State.of(c2w.expand(batch, -1, -1, -1), points.expand(batch, -1, -1).contiguous())
    camera = truth.rotation @ truth.points.mT[:, None] + truth.translation[..., None]
    focal = torch.tensor(FOCAL, dtype=torch.float64).expand(batch, 2).contiguous()
    uv = camera[:, :, :2] / camera[:, :, 2:] * focal[:, None, :, None]
    uv = uv + noise_px * randn(batch, views, 2, joints, seed=seed + 2)
    lot = torch.rand(3, batch, views, joints, dtype=torch.float64, generator=generator(seed + 3))
    wild = 300 * (torch.rand(uv.shape, dtype=torch.float64, generator=generator(seed + 4)) - 0.5)
    uv = torch.where((lot[0] < outliers)[:, :, None], wild, uv)
    weight = torch.where(lot[1] < seen, 0.5 + lot[2], 0.0)
    return Problem(uv, weight, focal, **options), truth


def started(truth: State, rotation_deg: float = 4.0, metres: float = 0.3, seed: int = 9, unknown: int = 0) -> State:
    """Off from the truth: every camera by so much, every point by 0.2 m."""
    flat = truth.c2w.flatten(0, 1)
    c2w = noisy_poses(flat, rotation_deg, metres, generator(seed)).view(truth.c2w.shape)
    return State.of(c2w, truth.points + 0.2 * randn(*truth.points.shape, seed=seed), unknown)


def moved(state: State, world: Similarity) -> State:
    """The same scene in another world."""
    c2w = world.apply_to_poses(state.c2w.flatten(0, 1)).view(state.c2w.shape)
    return State.of(c2w, world.apply(state.points), state.intrinsics.shape[1])
