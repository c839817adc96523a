"""Direct Voxel Grid Optimization: a coarse stage that finds the object, then a fine one within what it found.

One run of the trainer covers both. What the model is at a step follows from the step alone, so training resumes from
any checkpoint; the tensors in the checkpoint bring their shapes along.
"""

import warnings
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from jaxtyping import Float
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.field_components.field_heads import FieldHeadNames
from nerfstudio.model_components.renderers import AccumulationRenderer, RGBRenderer
from nerfstudio.models.base_model import Model, ModelConfig
from torch import Tensor
from torch.nn import Parameter

from kronc_ns.commands.console import exit_on_error
from kronc_ns.errors import KroncError
from kronc_ns.plugin.checks import check_not_negative, check_positive, check_shares
from kronc_ns.plugin.dvgo import equations
from kronc_ns.plugin.dvgo.field import CoarseField, DensityGridField, FineField, view_rates
from kronc_ns.plugin.dvgo.grid import UnknownSpace
from kronc_ns.plugin.dvgo.losses import StageLosses, beside_photometric
from kronc_ns.plugin.dvgo.sampling import ray_box, sample_rays
from kronc_ns.plugin.pictures import compare
from kronc_ns.plugin.transparency import rgba


@dataclass
class DVGOModelConfig(ModelConfig):
    """Direct Voxel Grid Optimization; defaults are the paper's."""

    _target: type = field(default_factory=lambda: DVGOModel)
    """The model."""
    coarse_iterations: int = 5000
    """Steps of the coarse stage; the rest of the run is the fine stage."""
    coarse_voxels: int = 100**3
    """Voxels of the coarse grids, over the scene box."""
    fine_voxels: int = 160**3
    """Voxels of the fine grids in the end, over the box around what the coarse stage found."""
    growth_steps: tuple[int, ...] = (1000, 2000, 3000)
    """Steps of the fine stage at which the number of voxels doubles."""
    step_size: float = 0.5
    """Distance between samples, in voxels."""
    coarse_alpha_init: float = 1e-6
    """Alpha of a voxel at the start of the coarse stage: low, or clouds form in front of the cameras."""
    fine_alpha_init: float = 1e-2
    """Alpha of a voxel at the start of the fine stage."""
    free_space_threshold: float = 1e-3
    """Space is known to be free where the coarse alpha of a step is below this."""
    colour_threshold: float = 1e-4
    """Samples of the fine stage whose alpha or weight is below this are skipped."""
    feature_channels: int = 12
    """Channels of the fine stage's feature grid."""
    mlp_width: int = 128
    """Width of the two hidden layers of the fine stage's colour network."""
    coarse_losses: StageLosses = field(default_factory=lambda: StageLosses(0.1, 0.01))
    """Losses of the coarse stage."""
    fine_losses: StageLosses = field(default_factory=lambda: StageLosses(0.01, 0.001))
    """Losses of the fine stage."""
    background_color: Literal["random", "black", "white"] = "white"
    """What rays see behind the scene box."""
    camera_optimizer: CameraOptimizerConfig = field(default_factory=lambda: CameraOptimizerConfig(mode="off"))
    """Refinement of the poses during training."""
    enable_collider: bool = False
    """Near and far planes; not needed, since rays are cut to the scene box."""


class DVGOModel(Model):
    """Both stages; ``stage`` says which one renders."""

    config: DVGOModelConfig
    stage: Tensor

    def populate_modules(self) -> None:
        """Fields, renderers and metrics."""
        super().populate_modules()
        config, aabb = self.config, self.scene_box.aabb.float()
        with exit_on_error():
            check_not_negative(coarse_iterations=config.coarse_iterations)
            check_positive(coarse_voxels=config.coarse_voxels, fine_voxels=config.fine_voxels)
            check_positive(step_size=config.step_size, mlp_width=config.mlp_width)
            check_shares(coarse_alpha_init=config.coarse_alpha_init, fine_alpha_init=config.fine_alpha_init)
        self.register_buffer("stage", torch.tensor(0))  # 0 coarse, 1 fine
        self.coarse = CoarseField(aabb, config.coarse_voxels, config.coarse_alpha_init)
        self.fine = FineField(aabb, config.fine_alpha_init, config.feature_channels, config.mlp_width)
        self.unknown = UnknownSpace(aabb)
        self.camera_optimizer: CameraOptimizer = config.camera_optimizer.setup(
            num_cameras=self.num_train_data, device="cpu"
        )
        self.renderer_rgb = RGBRenderer(background_color=config.background_color)
        self.renderer_accumulation = AccumulationRenderer()

        from torchmetrics.functional import structural_similarity_index_measure
        from torchmetrics.image import PeakSignalNoiseRatio
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        self.psnr = PeakSignalNoiseRatio(data_range=1.0)
        self.ssim = structural_similarity_index_measure
        self.lpips = LearnedPerceptualImagePatchSimilarity(normalize=True)

    @property
    def is_fine(self) -> bool:
        """Whether the fine stage has begun."""
        return bool(self.stage)

    @property
    def field(self) -> DensityGridField:
        """The field of the present stage."""
        return self.fine if self.is_fine else self.coarse

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        """Grids of the coarse stage, grids of the fine stage, its network, and poses if they are refined."""
        groups = {
            "coarse": list(self.coarse.parameters()),
            "fine": [self.fine.density_grid.values, self.fine.feature_grid.values],
            "mlp": list(self.fine.mlp.parameters()),
        }
        self.camera_optimizer.get_param_groups(param_groups=groups)
        return groups

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Learning rates by view counts once; before every step, what the step asks for."""
        optimizers, pipeline = training_callback_attributes.optimizers, training_callback_attributes.pipeline
        assert optimizers is not None
        assert pipeline is not None
        # schedules of the fine stage count from the first step, at which its optimisers have nothing to do yet
        warnings.filterwarnings("ignore", "Detected call of `lr_scheduler.step\\(\\)`", UserWarning)
        if not self.is_fine:
            grid = self.coarse.density_grid
            assert pipeline.datamanager.train_dataset is not None
            cameras = pipeline.datamanager.train_dataset.cameras
            grid.rate.copy_(view_rates(grid.nodes(), cameras)[..., None])
        return [
            TrainingCallback(
                where_to_run=[TrainingCallbackLocation.BEFORE_TRAIN_ITERATION],
                func=self.advance,
                args=[optimizers],
            )
        ]

    def advance(self, optimizers: Optimizers, step: int) -> None:
        """Begin the fine stage or grow its grids where ``step`` is that far, however training got there."""
        config = self.config
        if step < config.coarse_iterations:
            return
        voxels = self.voxels_at(step - config.coarse_iterations)
        if not self.is_fine:
            with exit_on_error():
                self.begin_fine(voxels)
            self._renew(optimizers, "coarse")
            self._renew(optimizers, "fine")
        elif self.fine.grow(voxels):
            self._renew(optimizers, "fine")

    def _renew(self, optimizers: Optimizers, group: str) -> None:
        """Hand the new Parameters of a group to its optimiser, whose learning rate and schedule go on.

        Moments start anew: a finer grid's points get smaller gradients, for which the old ones would be too large.
        """
        parameters = self.get_param_groups()[group]
        optimizer = optimizers.optimizers[group]
        optimizer.state.clear()
        optimizer.param_groups[0]["params"] = parameters
        optimizers.parameters[group] = parameters

    def voxels_at(self, fine_step: int) -> int:
        """Voxels of the fine grids at a step of the fine stage: doubled at every growth step, full after the last."""
        left = sum(fine_step < growth for growth in self.config.growth_steps)
        return self.config.fine_voxels // 2**left

    def begin_fine(self, voxels: int) -> None:
        """Take the box and the free space from the coarse stage, whose grids are then released (section 5.2)."""
        aabb = self.coarse.density_grid.aabb
        alpha = self.coarse.alpha_at_nodes(self.config.step_size)
        occupied = alpha > self.config.free_space_threshold
        box = equations.occupied_box(occupied, aabb)
        if box is None:
            raise KroncError(
                f"the coarse stage found nothing in the scene box (largest alpha {float(alpha.max()):.1g}, expected "
                f"more than {self.config.free_space_threshold:g}): look whether masks are empty, images one colour, "
                "or the object outside the box; or give more coarse_iterations"
            )
        self.unknown.mark(occupied)
        self.fine.begin(box, voxels, self.config.fine_voxels)
        self.coarse.release()
        self.stage.fill_(1)

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        """Colours, accumulation and depth of rays; in training also what the losses need."""
        if self.training:
            self.camera_optimizer.apply_to_raybundle(ray_bundle)
        field, threshold = self.field, self.config.colour_threshold if self.is_fine else 0.0
        step = self.config.step_size * field.density_grid.voxel_size()
        unknown = self.unknown if self.is_fine else None
        packed = sample_rays(ray_bundle, field.density_grid.aabb, step, unknown, jitter=self.training)
        density, _ = field.get_density(packed.samples)
        optical = density[:, 0] * step
        optical = optical * (-torch.expm1(-optical.detach()) >= threshold)
        all_weights, background = equations.render_weights(packed.along_rays(optical))

        weights = all_weights[packed.rays, packed.slots]
        seen = weights >= threshold
        samples, rays, weights = packed.samples[seen], packed.rays[seen], weights[seen][:, None]
        colours = field.get_outputs(samples)[FieldHeadNames.RGB]
        rgb = self.renderer_rgb(colours, weights, ray_indices=rays, num_rays=packed.num_rays)
        accumulation = self.renderer_accumulation(weights, ray_indices=rays, num_rays=packed.num_rays)
        distance = (samples.frustums.starts + samples.frustums.ends) / 2
        depth = torch.zeros_like(accumulation).index_add(0, rays, weights * distance) / accumulation.clamp(min=1e-6)
        # as nerfstudio's median depth: of a ray that is hardly held up, a surface would be anywhere
        leaving = ray_box(ray_bundle.origins, ray_bundle.directions, field.density_grid.aabb)[1][:, None]
        depth = torch.where(accumulation < 0.5, leaving.clamp(min=0), depth)
        outputs = {"rgb": rgb, "accumulation": accumulation, "depth": depth}
        if self.training:
            outputs |= {"background": background, "point_rgb": colours, "point_weights": weights, "point_rays": rays}
        return outputs

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Float[Tensor, "*n 4"]:
        """Colour and opacity of a rendering."""
        return rgba(outputs[output_name], outputs["accumulation"], self.config.background_color)

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Tensor]:
        """PSNR of the batch."""
        image = self.renderer_rgb.blend_background(batch["image"].to(self.device))
        metrics = {"psnr": self.psnr(outputs["rgb"], image)}
        self.camera_optimizer.get_metrics_dict(metrics)
        return metrics

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: dict[str, Any] | None = None
    ) -> dict[str, Tensor]:
        """The stage's weighted losses (equations 3 and 10 to 12)."""
        predicted, image = self.renderer_rgb.blend_background_for_loss_computation(
            pred_image=outputs["rgb"],
            pred_accumulation=outputs["accumulation"],
            gt_image=batch["image"].to(self.device),
        )
        losses = {"rgb_loss": (predicted - image).square().sum(-1).mean()}
        if self.training:
            weight = self.config.fine_losses if self.is_fine else self.config.coarse_losses
            losses |= beside_photometric(outputs, image, self.field.density_grid, weight)
            self.camera_optimizer.get_loss_dict(losses)
        return losses

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """PSNR, SSIM and LPIPS of an image; truth beside rendering, accumulation and depth."""
        truth = self.renderer_rgb.blend_background(batch["image"].to(outputs["rgb"].device))
        return compare(truth, outputs, {"psnr": self.psnr, "ssim": self.ssim, "lpips": self.lpips})
