"""Algorithm 1 of the paper: Adam on rotations (6D), translations and depths, all views and keypoints at once.

The gradient is written out (tests hold it against autograd on `kronc_ns.solve.objective`) so that a step runs in
preallocated buffers, without a graph: about three times the speed of autograd on a CPU.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from kronc_ns.geometry.camera import Camera
from kronc_ns.solve.options import AdamConfig

_TINY = 1e-12


@dataclass(frozen=True)
class AdamResult:
    """Where Algorithm 1 ended."""

    c2w: Float[np.ndarray, "n 3 4"]
    depths: Float[np.ndarray, "n j"]
    points: Float[np.ndarray, "j 3"]
    """Centroids C^j; zero for keypoints that no view sees."""
    steps: int
    seconds: float
    history: dict[str, list[float]]
    """"step" and "loss" at about a hundred steps."""
    path: Float[np.ndarray, "s n 3 4"]
    """Poses before each of them."""


def rotation_to_r6(rotation: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 6"]:
    """First two columns (a1, a2) of a rotation, stacked: the paper's f (Algorithm 1; Zhou et al. 2019)."""
    return torch.cat([rotation[..., :, 0], rotation[..., :, 1]], dim=-1)


def rotation_from_r6(r6: Float[Tensor, "*b 6"]) -> Float[Tensor, "*b 3 3"]:
    """Gram-Schmidt on the two unnormalised columns of ``r6``: the paper's inverse of f (section 4.2)."""
    a1, a2 = r6[..., :3], r6[..., 3:]
    b1 = torch.nn.functional.normalize(a1, dim=-1)
    b2 = torch.nn.functional.normalize(a2 - (b1 * a2).sum(-1, keepdim=True) * b1, dim=-1)
    return torch.stack([b1, b2, torch.linalg.cross(b1, b2)], dim=-1)


class LossGradient:
    """Value and gradient of the full objective (eq. 5) in buffers that are allocated once.

    ``parameters`` is one flat leaf tensor [6N r6 | 3N t | NJ depths]; ``r6``, ``t`` and ``z`` are views of it,
    and `evaluate` writes the gradient to ``parameters.grad``. Tensors are laid out [N, 3, J].
    """

    def __init__(
        self,
        c2w: Float[Tensor, "n 3 4"],
        depths: Float[Tensor, "n j"],
        uv: Float[Tensor, "n j 2"],
        m: Float[Tensor, "n j"],
        focal: tuple[float, float],
        principal: tuple[float, float],
        weights: tuple[float, float],
    ) -> None:
        n, j = m.shape
        self.parameters = torch.cat([rotation_to_r6(c2w[..., :3]).flatten(), c2w[..., 3].flatten(), depths.flatten()])
        self.parameters.grad = torch.zeros_like(self.parameters)
        self.r6, self.t, self.z = self._split(self.parameters, n, j)
        self._grad_r6, self._grad_t, self._grad_z = self._split(self.parameters.grad, n, j)

        self._focal = m.new_tensor(focal).view(1, 2, 1)
        centred = (uv - m.new_tensor(principal)).transpose(1, 2) / self._focal  # [N, 2, J]
        self._rays = torch.cat([centred, torch.ones_like(centred[:, :1])], dim=1).contiguous()
        self._share = (m / m.sum(0).clamp_min(_TINY)).unsqueeze(1)  # m / M^j
        weight_3d, weight_2d = weights
        self._weight_3d = (m * (weight_3d / j)).unsqueeze(1)
        # in the image the residual is kept in units of the focal length and scaled here
        self._weight_2d = (m * (weight_2d / j)).unsqueeze(1)
        buffer = torch.empty(n, 3, j, dtype=m.dtype, device=m.device)
        self._point_camera, self._point, self._grad_point = (torch.empty_like(buffer) for _ in range(3))
        self._offset, self._seen, self._grad_seen = (torch.empty_like(buffer) for _ in range(3))
        self._scratch = torch.empty_like(buffer)
        self._residual, self._plane, self._scratch_2d = (torch.empty_like(buffer[:, :2]) for _ in range(3))
        self._inverse_z, self._norm_2d, self._norm_3d = (torch.empty_like(buffer[:, :1]) for _ in range(3))

    @staticmethod
    def _split(flat: Tensor, n: int, j: int) -> tuple[Tensor, Tensor, Tensor]:
        return flat[: 6 * n].view(n, 6), flat[6 * n : 9 * n].view(n, 3), flat[9 * n :].view(n, j)

    def rotation(self) -> Float[Tensor, "n 3 3"]:
        """R_i of the current parameters."""
        return rotation_from_r6(self.r6)

    def pose(self) -> Float[Tensor, "n 3 4"]:
        """Camera poses (c2w) of the current parameters."""
        return torch.cat([self.rotation(), self.t.unsqueeze(2)], dim=2)

    def centroids(self) -> Float[Tensor, "3 j"]:
        """C^j of the current parameters (eq. 2), refreshing the back-projections."""
        rotation = self.rotation()
        torch.mul(self._rays, self.z.unsqueeze(1), out=self._point_camera)
        torch.baddbmm(self.t.unsqueeze(2), rotation, self._point_camera, out=self._point)
        torch.mul(self._point, self._share, out=self._scratch)
        return self._scratch.sum(0)

    def evaluate(self) -> tuple[Tensor, Tensor]:
        """Fill the gradient; returns the per-keypoint norms (3D [N, 1, J] in metres, 2D [N, 1, J] in pixels)."""
        # columns of the rotation, kept for the chain rule through Gram-Schmidt
        a1, a2 = self.r6[:, :3], self.r6[:, 3:]
        length_1 = a1.norm(dim=1, keepdim=True)
        b1 = a1 / length_1
        along = (b1 * a2).sum(1, keepdim=True)
        across = torch.addcmul(a2, along, b1, value=-1)
        length_2 = across.norm(dim=1, keepdim=True)
        b2 = across / length_2
        b3 = torch.linalg.cross(b1, b2)
        rotation = torch.stack([b1, b2, b3], dim=2)
        inverse = rotation.transpose(1, 2)

        torch.mul(self._rays, self.z.unsqueeze(1), out=self._point_camera)
        torch.baddbmm(self.t.unsqueeze(2), rotation, self._point_camera, out=self._point)  # eq. 1
        torch.mul(self._point, self._share, out=self._scratch)
        centroid = self._scratch.sum(0, keepdim=True)  # eq. 2

        # 3D term: unit vectors from the centroid to the back-projections
        torch.sub(self._point, centroid, out=self._grad_point)
        torch.mul(self._grad_point, self._grad_point, out=self._scratch)
        torch.sum(self._scratch, dim=1, keepdim=True, out=self._norm_3d).sqrt_()
        torch.div(self._weight_3d, self._norm_3d.clamp_min_(_TINY), out=self._inverse_z)
        self._grad_point.mul_(self._inverse_z)

        # 2D term: centroid in each view (eq. 3)
        torch.sub(centroid, self.t.unsqueeze(2), out=self._offset)
        torch.bmm(inverse, self._offset, out=self._seen)
        torch.reciprocal(self._seen[:, 2:], out=self._inverse_z)
        torch.mul(self._seen[:, :2], self._inverse_z, out=self._plane)
        torch.sub(self._plane, self._rays[:, :2], out=self._residual)
        self._residual.mul_(self._focal)
        torch.mul(self._residual, self._residual, out=self._scratch_2d)
        torch.sum(self._scratch_2d, dim=1, keepdim=True, out=self._norm_2d).sqrt_()
        self._residual.mul_(self._weight_2d).div_(self._norm_2d.clamp_min_(_TINY)).mul_(self._focal).mul_(
            self._inverse_z
        )
        self._grad_seen[:, :2] = self._residual
        torch.mul(self._residual, self._plane, out=self._plane)
        torch.sum(self._plane, dim=1, keepdim=True, out=self._inverse_z)
        torch.neg(self._inverse_z, out=self._grad_seen[:, 2:])
        self._grad_seen.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0)  # a centroid in the camera's plane

        torch.bmm(rotation, self._grad_seen, out=self._scratch)  # dL/dC through the images
        grad_centroid = self._scratch.sum(0, keepdim=True).sub_(self._grad_point.sum(0, keepdim=True))
        torch.sub(self._grad_point.sum(2), self._scratch.sum(2), out=self._grad_t)
        self._grad_point.addcmul_(self._share, grad_centroid)
        self._grad_t.add_((self._share * grad_centroid).sum(2))
        torch.bmm(inverse, self._grad_point, out=self._scratch)
        torch.sum(self._scratch.mul_(self._rays), dim=1, out=self._grad_z)
        grad_rotation = torch.bmm(self._grad_point, self._point_camera.transpose(1, 2))
        grad_rotation.baddbmm_(self._offset, self._grad_seen.transpose(1, 2))

        # chain rule of rotation_from_r6
        g1, g2, g3 = grad_rotation.unbind(2)
        g1 = g1 + torch.linalg.cross(b2, g3)
        g2 = g2 + torch.linalg.cross(g3, b1)
        g_across = torch.addcmul(g2, (b2 * g2).sum(1, keepdim=True), b2, value=-1).div_(length_2)
        g_along = (b1 * g_across).sum(1, keepdim=True)
        torch.addcmul(g_across, g_along, b1, value=-1, out=self._grad_r6[:, 3:])
        g1 = g1 - along * g_across - g_along * a2
        torch.div(torch.addcmul(g1, (b1 * g1).sum(1, keepdim=True), b1, value=-1), length_1, out=self._grad_r6[:, :3])
        return self._norm_3d, self._norm_2d

    def value(self, norms: tuple[Tensor, Tensor]) -> float:
        """The loss that belongs to the norms `evaluate` returned."""
        return float((self._weight_3d * norms[0]).sum() + (self._weight_2d * norms[1]).sum())


def minimise(
    c2w: Float[np.ndarray, "n 3 4"],
    depths: Float[np.ndarray, "n j"],
    uv: Float[np.ndarray, "n j 2"],
    m: Float[np.ndarray, "n j"],
    camera: Camera,
    config: AdamConfig,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    progress: Callable[[int, float], None] | None = None,
) -> AdamResult:
    """Run Algorithm 1 from the given poses (c2w, OpenCV axes) and z-depths, in float32.

    ``device`` auto takes a GPU if there is one.

    ``uv`` are undistorted pixels, ``m`` the visibility. ``progress(step, loss)`` is called about a hundred times.
    """
    start = time.perf_counter()
    on = torch.device("cuda" if device != "cpu" and torch.cuda.is_available() else "cpu")

    def tensor(array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(on, torch.float32)

    focal, principal = (camera.fx, camera.fy), (camera.cx, camera.cy)
    gradient = LossGradient(
        tensor(c2w), tensor(depths), tensor(uv), tensor(m), focal, principal, (config.weight_3d, config.weight_2d)
    )
    fused = on.type == "cuda" or torch.__version__ >= "2.4"
    optimiser = torch.optim.Adam([gradient.parameters], lr=config.learning_rate, fused=fused)
    report_every = max(1, config.steps // 100)
    history: dict[str, list[float]] = {"step": [], "loss": []}
    path: list[Tensor] = []
    best, best_step, step = math.inf, 0, 0
    floor = config.learning_rate * config.decay
    with torch.no_grad(), _one_thread():
        for step in range(1, config.steps + 1):
            norms = gradient.evaluate()
            if not config.optimise_depths:
                gradient.parameters.grad[-depths.size :] = 0.0  # pyright: ignore[reportOptionalSubscript]
            cosine = 0.5 * (1 + math.cos(math.pi * (step - 1) / config.steps))
            optimiser.param_groups[0]["lr"] = floor + (config.learning_rate - floor) * cosine
            if step % report_every == 0 or step == 1:
                value = gradient.value(norms)
                history["step"].append(float(step))
                history["loss"].append(value)
                path.append(gradient.pose())
                if progress is not None:
                    progress(step, value)
                if value < best * 0.999:
                    best, best_step = value, step
                elif config.patience and step - best_step >= config.patience:
                    break
            optimiser.step()
        points = gradient.centroids().T
    seconds = time.perf_counter() - start
    return AdamResult(
        c2w=_array(gradient.pose()),
        depths=_array(gradient.z),
        points=_array(points),
        steps=step,
        seconds=seconds,
        history=history,
        path=_array(torch.stack(path)),
    )


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.double().cpu().numpy()


@contextmanager
def _one_thread() -> Iterator[None]:
    """Compute on one CPU thread: the tensors are too small to share, and idle threads would only spin for the cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
