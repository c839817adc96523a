"""The pipeline of all our methods: training that cannot recover ends, and refined poses are evaluated fairly."""

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager
from nerfstudio.models.base_model import Model
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from kronc_ns.commands.console import exit_on_error
from kronc_ns.errors import KroncError
from kronc_ns.geometry.alignment import umeyama

_RATE_FINAL = 1e-4  # of a test pose: radians, and shares of the distance to the car
_RAYS = 512
_MARK = 0.05  # of the distance to the car: far enough to tell how cameras are turned, too near to tell their scale
_LOOK_EVERY = 100  # steps: what is drawn without what is NaN has a finite loss
_LOST = (
    "from which training cannot recover: expected finite numbers; go back to the method's defaults, or lower its "
    "learning rates"
)


@dataclass
class KroncPipelineConfig(VanillaPipelineConfig):
    """nerfstudio's pipeline for any method."""

    _target: type = field(default_factory=lambda: KroncPipeline)
    """The pipeline."""
    test_pose_steps: int = 60
    """Steps in which each test pose is found by its image, where poses were refined in training."""
    test_pose_rate: float = 2e-3
    """Learning rate at the first of them, in radians and shares of the distance to the car."""


class KroncPipeline(VanillaPipeline):
    """nerfstudio's pipeline, which stops at a loss that is not finite and refines test poses where it has to."""

    config: KroncPipelineConfig

    def get_train_loss_dict(self, step: int) -> tuple[Any, dict[str, Tensor], dict[str, Tensor]]:
        """Outputs, losses and metrics of a batch; ends the process with status 2 where training is lost."""
        outputs, losses, metrics = super().get_train_loss_dict(step)
        with exit_on_error():
            check_finite(losses, step)
            if step % _LOOK_EVERY == _LOOK_EVERY - 1:
                check_parameters(dict(self.model.named_parameters()), step)
        return outputs, losses, metrics

    def load_pipeline(self, loaded_state: dict[str, Any], step: int) -> None:
        """Load a checkpoint; for evaluation, let the test poses follow where training poses were refined.

        Training poses settle where the model wants them. Test poses had no part in that, so their images would be
        compared with renderings from elsewhere. As usual for such methods (NeRF--, BARF), they are carried along with
        the training poses, and each is then found by its own image with the model frozen before it is compared.
        """
        super().load_pipeline(loaded_state, step)
        camera_optimizer = getattr(self.model.config, "camera_optimizer", None)
        if self.test_mode == "test" and camera_optimizer is not None and camera_optimizer.mode != "off":
            self.refine_test_poses()

    def refine_test_poses(self) -> None:
        """Move every test camera to where the model, which stays as it is, explains its image best."""
        manager: Any = self.datamanager  # either of nerfstudio's two; their common ancestor declares less
        optimizer: Any = self.model.camera_optimizer
        dataset = manager.eval_dataset
        CONSOLE.print(f"poses were refined in training: refining the {len(dataset)} test poses by their images")
        self.eval()
        whole = isinstance(manager, FullImageDatamanager)
        config = self.config
        dataset.cameras.camera_to_worlds = carried_along(optimizer, manager.train_dataset.cameras, dataset.cameras)
        manager.setup_eval()  # what it prepared for evaluation may hold copies of the cameras
        for i, (camera, batch) in enumerate(manager.fixed_indices_eval_dataloader):
            generator = torch.Generator().manual_seed(i)
            dataset.cameras.camera_to_worlds[i] = refined_pose(
                self.model, camera, batch, whole, generator, config.test_pose_steps, config.test_pose_rate
            )
        manager.setup_eval()


def check_finite(losses: Mapping[str, Tensor], step: int) -> None:
    """Raise `KroncError` where a loss is NaN or infinite."""
    for name, loss in losses.items():
        if not bool(loss.isfinite().all()):
            raise KroncError(f"{name} is {float(loss.detach().sum())} at step {step}, {_LOST}")


def check_parameters(parameters: Mapping[str, Tensor], step: int) -> None:
    """Raise `KroncError` where nothing in a parameter is finite; a single stray Gaussian does no harm."""
    for name, values in parameters.items():
        if values.numel() and not bool(values.isfinite().any()):
            raise KroncError(f"{name} holds no finite number at step {step}, {_LOST}")


@torch.no_grad()
def carried_along(optimizer: CameraOptimizer, training: Cameras, others: Cameras) -> Float[Tensor, "n 3 4"]:
    """c2w of ``others`` after the similarity that carries ``training``'s poses to where ``optimizer`` has moved them.

    By centres and, for cameras that stand in a line, points a little above and behind them.
    """
    before = training.camera_to_worlds.cpu()
    after = corrected(optimizer, training)
    reach = _MARK * float(before[:, :, 3].norm(dim=-1).mean())
    marks = [
        torch.cat([c2w[:, :, 3], *(c2w[:, :, 3] + reach * c2w[:, :, axis] for axis in (1, 2))])
        for c2w in (before, after)
    ]
    similarity = umeyama(*(points.numpy().astype(np.float64) for points in marks))
    return torch.from_numpy(similarity.apply_to_poses(others.camera_to_worlds.cpu().numpy())).to(
        others.camera_to_worlds
    )


@torch.no_grad()
def corrected(optimizer: CameraOptimizer, cameras: Cameras) -> Float[Tensor, "n 3 4"]:
    """c2w (OpenGL axes, on the CPU) of all training cameras as a camera optimiser has them."""
    poses = []
    for i in range(len(cameras)):
        camera = cameras[i : i + 1]
        camera.metadata = {"cam_idx": i}
        poses.append(optimizer.apply_to_camera(camera)[0].cpu())
    return torch.stack(poses)


@torch.enable_grad()
def refined_pose(
    model: Model,
    camera: Cameras,
    batch: Mapping[str, Any],
    whole: bool,
    generator: torch.Generator,
    steps: int = KroncPipelineConfig.test_pose_steps,
    rate: float = KroncPipelineConfig.test_pose_rate,
) -> Float[Tensor, "3 4"]:
    """c2w (OpenGL axes) near that of ``camera [1]`` from which ``model`` explains the image in ``batch`` best.

    nerfstudio's own camera optimiser and the model's own loss, on random pixels or (``whole``, for models that render
    whole images only) on the image; where there is a mask, on its pixels.
    """
    adjustment = CameraOptimizerConfig(mode="SO3xR3").setup(num_cameras=1, device=str(camera.device))
    unit = torch.ones(6, device=camera.device)
    unit[:3] = camera.camera_to_worlds[0, :3, 3].norm()  # the dataparser puts the car at the origin
    change = torch.zeros(1, 6, device=camera.device)
    optimizer = torch.optim.Adam([change], lr=rate)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, (_RATE_FINAL / rate) ** (1 / max(steps, 1)))
    moved = copy.copy(camera)
    moved.metadata = {"cam_idx": 0}  # the optimiser's only one
    original = moved.camera_to_worlds
    usable = batch["mask"][..., 0] if "mask" in batch else torch.ones(batch["image"].shape[:2])
    usable = usable.to(batch["image"].device)  # nerfstudio moves masks to the model, but not always images
    pixels = usable.nonzero()
    if not len(pixels):
        return original[0]
    for _ in range(steps):
        moved.camera_to_worlds = original
        moved.camera_to_worlds = adjustment.apply_to_camera(moved)
        if whole:
            outputs, target = model(moved), dict(batch)
        else:
            rows, columns = pixels[torch.randint(len(pixels), (_RAYS,), generator=generator)].unbind(-1)
            coords = torch.stack([rows, columns], dim=-1) + 0.5
            outputs = model(moved.generate_rays(camera_indices=0, coords=coords.to(camera.device)))
            target = {"image": batch["image"][rows, columns]}
        loss = torch.stack(list(model.get_loss_dict(outputs, target).values())).sum()
        (gradient,) = torch.autograd.grad(loss, [adjustment.pose_adjustment])
        change.grad = gradient * unit
        optimizer.step()
        schedule.step()
        adjustment.pose_adjustment.data = change * unit
    moved.camera_to_worlds = original
    return adjustment.apply_to_camera(moved)[0].detach()
