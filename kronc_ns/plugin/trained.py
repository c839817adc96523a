"""A trained nerfstudio run and its test views, rendered beside their photos."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import yaml
from jaxtyping import Bool, Float
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, _undistort_image
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import Pipeline
from nerfstudio.utils.eval_utils import eval_setup

from kronc_ns.errors import KroncError
from kronc_ns.metrics.images import Lpips
from kronc_ns.plugin.compatibility import UnavailableLpips
from kronc_ns.plugin.dataparser import KroncDataParserConfig


@dataclass(frozen=True)
class RenderedView:
    """A rendering beside the photo it is to equal; images are in [0, 1]."""

    image: Path
    rendered: Float[np.ndarray, "h w 3"]
    truth: Float[np.ndarray, "h w 3"]
    """The photo; where it has alpha, on the background that was trained on."""
    mask: Bool[np.ndarray, "h w"] | None
    """True on the vehicle; None where neither a mask nor alpha says where that is."""


@dataclass(frozen=True)
class TrainedRun:
    """A run at its last checkpoint."""

    method: str
    step: int
    pipeline: Pipeline
    photos: InputDataset
    """The test views' files, with the masks and the alpha that training may have used up."""

    def __len__(self) -> int:
        return len(self.photos)

    @property
    def lpips(self) -> Lpips | None:
        """The model's own LPIPS; None where its weights are missing."""
        lpips, device = getattr(self.pipeline.model, "lpips", None), self.pipeline.device
        if lpips is None or isinstance(lpips, UnavailableLpips):
            return None
        return lambda *images: float(lpips(*(torch.from_numpy(image).to(device) for image in images)))

    @torch.no_grad()
    def render(self) -> Iterator[RenderedView]:
        """Render one test view after the other."""
        datamanager: Any = self.pipeline.datamanager  # what all of nerfstudio's have, its base class does not declare
        model = self.pipeline.model
        for i, (camera, batch) in enumerate(datamanager.fixed_indices_eval_dataloader):
            image = self.photos.image_filenames[i]
            (height, width), expected = batch["image"].shape[:2], (int(camera.height), int(camera.width))
            if (height, width) != expected:
                raise KroncError(
                    f"{image} is {width}x{height}, its camera {expected[1]}x{expected[0]}: expected equal sizes"
                )
            outputs = model.get_outputs_for_camera(camera)
            # nerfstudio's models lay the photo, on their background, and the rendering side by side
            pair = model.get_image_metrics_and_images(outputs, batch)[1]["img"].clamp(0, 1).cpu().numpy()
            mask = self._mask(i, undistorted=isinstance(datamanager, FullImageDatamanager))
            yield RenderedView(image, pair[:, -width:], pair[:, :width], mask)

    def _mask(self, i: int, undistorted: bool) -> Bool[np.ndarray, "h w"] | None:
        """Where the vehicle is in a photo: by its mask, else by its alpha."""
        photo = self.photos.get_data(i)
        mask = photo["mask"] if "mask" in photo else photo["image"][..., 3:] >= 0.5
        if not mask.numel():
            return None
        camera = self.photos.cameras[i].reshape(())
        distortion = camera.distortion_params
        if undistorted and distortion is not None and distortion.any():
            image, intrinsics = photo["image"].numpy(), camera.get_intrinsics_matrices().numpy()
            mask = _undistort_image(camera, distortion.numpy(), {"mask": mask}, image, intrinsics)[2]
            assert mask is not None
        return mask[..., 0].numpy()


def load_run(config_file: Path) -> TrainedRun:
    """The run whose config.yml `ns-train` wrote.

    Raises `KroncError` where that is no such file, its method is not installed, or it has no checkpoint or test view.
    """
    config = read_config(config_file)
    check_trained(config)
    photos = photos_of(config.pipeline.datamanager, "test")
    if not len(photos):
        raise KroncError(f"{config_file}: its data set has no test views to render")
    _, pipeline, _, step = eval_setup(config_file)
    return TrainedRun(str(config.method_name), step, pipeline, photos)


def check_trained(config: TrainerConfig) -> None:
    """Raise `KroncError` where a run has no checkpoint."""
    checkpoints = config.get_checkpoint_dir()
    if not any(checkpoints.glob("step-*.ckpt")):
        raise KroncError(
            f"{checkpoints} holds no checkpoint: train to the end, or come to the folder where ns-train was started"
        )


def read_config(file: Path) -> TrainerConfig:
    """The config.yml that `ns-train` wrote; raises `KroncError` where it is none, or its method not installed."""
    if not file.is_file():
        raise KroncError(f"{file} does not exist: expected the config.yml of a run, whose path ns-train prints")
    try:
        config = yaml.load(file.read_text(encoding="utf-8"), Loader=yaml.Loader)
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, RecursionError):  # of objects that are none
        config = None
    if not isinstance(config, TrainerConfig):
        raise KroncError(f"{file} is no config.yml of a run: expected what ns-train wrote")
    if config.method_name not in all_methods:
        raise KroncError(f"{file}: the method {config.method_name} is not installed here; `ns-train --help` lists all")
    return config


def photos_of(manager: Any, split: Literal["train", "test"]) -> InputDataset:
    """A split of a datamanager's config, its files by their own names, at the size that is trained on."""
    parser = manager.dataparser if manager.data is None else dataclasses.replace(manager.dataparser, data=manager.data)
    if isinstance(parser, KroncDataParserConfig):
        # the same views under their own names, with the masks that other backgrounds use up or leave aside
        parser = dataclasses.replace(parser, background="mask")
    outputs = parser.setup().get_dataparser_outputs(split=split)
    return InputDataset(dataclasses.replace(outputs, alpha_color=None), manager.camera_res_scale_factor)
