"""A radiance field that trains from coarse to fine while the poses of its cameras are found: BARF and L2G-NeRF.

What is switched on at a step follows from the step alone, so training resumes from any checkpoint.
"""

from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from jaxtyping import Float
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.model_components.renderers import RGBRenderer
from nerfstudio.models.base_model import Model, ModelConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor
from torch.nn import Parameter

from kronc_ns.commands.console import exit_on_error
from kronc_ns.errors import KroncError
from kronc_ns.plugin.barf.cameras import GlobalPoses, GlobalPosesConfig, LocalToGlobalPosesConfig
from kronc_ns.plugin.barf.field import CoarseToFineField
from kronc_ns.plugin.barf.settling import last_tenth, verdict
from kronc_ns.plugin.checks import check_not_negative, check_positive
from kronc_ns.plugin.dvgo.equations import render_weights
from kronc_ns.plugin.dvgo.sampling import ray_box
from kronc_ns.plugin.pictures import compare
from kronc_ns.plugin.transparency import rgba

_FEWEST_VIEWS = 3


@dataclass
class BarfModelConfig(ModelConfig):
    """BARF; defaults are the paper's for its synthetic scenes."""

    _target: type = field(default_factory=lambda: BarfModel)
    """The model."""
    frequencies: int = 10
    """Frequencies of the positional encoding: the finest has a period of 2^(1 - frequencies) boxes."""
    direction_frequencies: int | None = 4
    """Those of the viewing direction; None: colours are the same from everywhere."""
    coarse_until: int = 20_000
    """Step up to which the network sees plain coordinates; below 0 some frequencies are on from the start."""
    fine_from: int = 100_000
    """Step from which on all frequencies are switched on; 0: from the first on, which is no longer coarse to fine."""
    depth: int = 8
    """Layers of the network before density and colour."""
    width: int = 256
    """Their width."""
    skip: int | None = 4
    """Layer at which the input enters again."""
    samples: int = 128
    """Samples of each ray in the scene box."""
    background_color: Literal["random", "black", "white"] = "white"
    """What rays see behind the scene box."""
    poses_from: int = 0
    """Step from which on poses are moved: gradients of a field that has seen nothing lead anywhere."""
    camera_optimizer: GlobalPosesConfig = field(default_factory=lambda: GlobalPosesConfig(mode="SE3"))
    """How poses are found; mode off: they are taken as they are."""
    enable_collider: bool = False
    """Near and far planes; not needed, since rays are cut to the scene box."""


@dataclass
class L2GModelConfig(BarfModelConfig):
    """L2G-NeRF: BARF's field and schedule, and local motions of rays instead of one twist a camera."""

    camera_optimizer: LocalToGlobalPosesConfig = field(default_factory=lambda: LocalToGlobalPosesConfig(mode="SE3"))
    """How poses are found; mode off: they are taken as they are."""


class BarfModel(Model):
    """The field, the poses, and volume rendering of the scene box."""

    config: BarfModelConfig
    before_last_tenth: Tensor
    box: Tensor

    def populate_modules(self) -> None:
        """Field, poses, renderer and metrics."""
        super().populate_modules()
        config = self.config
        with exit_on_error():
            self._check()
        self.field = CoarseToFineField(
            config.frequencies,
            config.direction_frequencies,
            config.depth,
            config.width,
            config.skip,
            (config.coarse_until, config.fine_from),
        )
        self.camera_optimizer: GlobalPoses = config.camera_optimizer.setup(
            num_cameras=self.num_train_data, device="cpu"
        )
        self.register_buffer("before_last_tenth", torch.full((self.num_train_data, 3, 4), torch.nan))
        self.renderer_rgb = RGBRenderer(background_color=config.background_color)
        self.register_buffer("box", self.scene_box.aabb.float())
        self.unit = float((self.box[1] - self.box[0]).max() / 2)
        self._step = 0
        self._last_tenth_at = -1

        from torchmetrics.functional import structural_similarity_index_measure
        from torchmetrics.image import PeakSignalNoiseRatio
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        self.psnr = PeakSignalNoiseRatio(data_range=1.0)
        self.ssim = structural_similarity_index_measure
        self.lpips = LearnedPerceptualImagePatchSimilarity(normalize=True)

    def _check(self) -> None:
        config = self.config
        check_positive(frequencies=config.frequencies, depth=config.depth, width=config.width, samples=config.samples)
        check_not_negative(fine_from=config.fine_from, poses_from=config.poses_from)
        if 0 < config.fine_from <= config.coarse_until:
            raise KroncError(
                f"fine_from is {config.fine_from}: expected more than coarse_until, which is {config.coarse_until}"
            )
        if config.camera_optimizer.mode != "off" and self.num_train_data < _FEWEST_VIEWS:
            raise KroncError(
                f"{self.num_train_data} training views: expected at least {_FEWEST_VIEWS} to find poses by images; "
                "give more, or take the poses as they are with --pipeline.model.camera-optimizer.mode off"
            )

    def get_param_groups(self) -> dict[str, list[Parameter]]:
        """The field, and what poses are found by."""
        groups = {"fields": list(self.field.parameters())}
        self.camera_optimizer.get_param_groups(param_groups=groups)
        return groups

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Begin at the data set's poses; count steps; in the end say whether poses have settled."""
        pipeline, trainer = training_callback_attributes.pipeline, training_callback_attributes.trainer
        assert pipeline is not None
        assert trainer is not None
        assert pipeline.datamanager.train_dataset is not None
        self.camera_optimizer.begin_at(pipeline.datamanager.train_dataset.cameras.to(self.device), self.unit)
        run = trainer.config.max_num_iterations
        return [
            TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], self.advance, args=[run]),
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN], self.report),
        ]

    def update_to_step(self, step: int) -> None:
        """What is switched on in a checkpoint."""
        self._step = step

    def advance(self, run: int, step: int) -> None:
        """Note the step, and the poses where the last tenth of a ``run`` of so many steps begins."""
        if self._last_tenth_at < 0:
            self._last_tenth_at = last_tenth(step, run)
        self._step = step
        if step == self._last_tenth_at:
            with torch.no_grad():
                self.before_last_tenth.copy_(self.camera_optimizer.poses())

    @torch.no_grad()
    def report(self, step: int) -> None:
        """Print how far cameras moved in the last tenth, and whether that is still on the way."""
        if self.config.camera_optimizer.mode == "off":
            return
        poses = self.camera_optimizer.poses().cpu().numpy()
        settled, words = verdict(self.before_last_tenth.cpu().numpy(), poses)
        CONSOLE.print(words if settled else f"[bold yellow]{words}[/bold yellow]")

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:
        """Colours, accumulation and depth of rays."""
        if self.training and self._step >= self.config.poses_from:
            self.camera_optimizer.apply_to_raybundle(ray_bundle)
        origins, directions = ray_bundle.origins, ray_bundle.directions
        with torch.no_grad():
            near, far = ray_box(origins, directions, self.box)
            near = near.clamp(min=0)
            hits = (~(far <= near)).nonzero()[:, 0]  # also of what is NaN, so that the loss tells
            near, far = near[hits, None], far[hits, None]
        samples = self.config.samples
        edges = torch.arange(samples, device=origins.device)
        offset = torch.rand(len(hits), samples, device=origins.device) if self.training else 0.5
        length = (far - near) / samples
        distance = near + (edges + offset) * length
        towards = directions[hits, None]
        points = (origins[hits, None] + towards * distance[..., None]) / self.unit
        density, colour = self.field(points, towards.expand_as(points), self._step)
        weights, _ = render_weights(density * length / self.unit)
        rays, total = hits.repeat_interleave(samples), len(origins)
        packed = weights.reshape(-1, 1)
        rgb = self.renderer_rgb(colour.reshape(-1, 3), packed, ray_indices=rays, num_rays=total)
        accumulation, depth = torch.zeros(2, total, 1, device=origins.device).unbind()
        accumulation = accumulation.index_add(0, hits, weights.sum(-1, keepdim=True))
        depth = depth.index_add(0, hits, (weights * distance).sum(-1, keepdim=True)) / accumulation.clamp(min=1e-6)
        # as nerfstudio's median depth: of a ray that is hardly held up, a surface would be anywhere
        leaving = torch.zeros_like(depth).index_copy(0, hits, far)
        depth = torch.where(accumulation < 0.5, leaving, depth)
        return {"rgb": rgb, "accumulation": accumulation, "depth": depth}

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Float[Tensor, "*n 4"]:
        """Colour and opacity of a rendering."""
        return rgba(outputs[output_name], outputs["accumulation"], self.config.background_color)

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Any]) -> dict[str, Tensor]:
        """PSNR of the batch, and how far poses have come."""
        image = self.renderer_rgb.blend_background(batch["image"].to(self.device))
        metrics = {"psnr": self.psnr(outputs["rgb"], image)}
        self.camera_optimizer.get_metrics_dict(metrics)
        return metrics

    def get_loss_dict(
        self, outputs: dict[str, Any], batch: dict[str, Any], metrics_dict: dict[str, Any] | None = None
    ) -> dict[str, Tensor]:
        """Mean squared error of colours; of L2G-NeRF in training also the alignment term."""
        predicted, image = self.renderer_rgb.blend_background_for_loss_computation(
            pred_image=outputs["rgb"],
            pred_accumulation=outputs["accumulation"],
            gt_image=batch["image"].to(self.device),
        )
        losses = {"rgb_loss": (predicted - image).square().mean()}
        if self.training:
            self.camera_optimizer.get_loss_dict(losses)
        return losses

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """PSNR, SSIM and LPIPS of an image; truth beside rendering, accumulation and depth."""
        truth = self.renderer_rgb.blend_background(batch["image"].to(outputs["rgb"].device))
        return compare(truth, outputs, {"psnr": self.psnr, "ssim": self.ssim, "lpips": self.lpips})
