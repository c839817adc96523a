"""Depth under the keypoints by DINOv2 with a DPT head (Oquab et al., 2023), as in the paper's ablation."""

import hashlib
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from kronc_ns.capture.detection.model import file_sha256
from kronc_ns.capture.pretrained import load_pretrained, transformers_for
from kronc_ns.capture.progress import Count
from kronc_ns.errors import KroncError
from kronc_ns.files.cache import cache_folder
from kronc_ns.files.images import depth_under
from kronc_ns.files.output import atomic_path
from kronc_ns.fit.options import KroncConfig
from kronc_ns.scene import Scene

MODEL = "facebook/dpt-dinov2-base-kitti"
_PATCH = 14  # px of DINOv2's patches, of which the input holds a whole number
_LONG_SIDE = 56 * _PATCH


@runtime_checkable
class DepthEstimator(Protocol):
    """A monocular depth network that is ready to run."""

    @property
    def identity(self) -> str:
        """Changes with everything that may change the answer to the same image."""
        ...

    def estimate(self, rgb: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h2 w2"]:
        """z-depth up to a factor common to all images, of the whole image at any resolution; 0: unknown."""
        ...


class DinoDepth:
    """DINOv2 and DPT through transformers."""

    def __init__(self, weights: Path | None) -> None:
        transformers = transformers_for("--depth-init prior without depth maps", "depth")
        model_class = transformers.AutoModelForDepthEstimation
        self._network = load_pretrained(model_class, weights, MODEL, "--depth-weights")

    @property
    def identity(self) -> str:
        """Model, its revision or content, and resolution."""
        return f"depth {self._network.name} {_LONG_SIDE}"

    def estimate(self, rgb: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "h2 w2"]:
        """The network's depth at its own resolution."""
        import cv2
        import torch

        factor = _LONG_SIDE / max(rgb.shape[:2])
        height, width = (max(1, round(side * factor / _PATCH)) * _PATCH for side in rgb.shape[:2])
        whole = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA)
        # the processor's own padding would have to be cut off again
        network = self._network
        inputs = network.processor(images=whole, do_resize=False, do_pad=False, return_tensors="pt").to(network.device)
        with torch.inference_mode():
            return network.model(**inputs).predicted_depth[0].float().cpu().numpy()


def depth_estimator(config: KroncConfig, weights: Path | None) -> DepthEstimator | None:
    """What estimates the depths that ``config`` starts from, if it wants any; raises `KroncError` for what is missing.

    ``weights``: a folder, or a name on the Hugging Face hub (default: `MODEL`).
    """
    if config.depth_init == "random":
        if weights is not None:
            raise KroncError(f"--depth-weights {weights} without a prior: give --depth-init prior or prior-fixed, too")
        return None
    return _dino(weights)


def with_depths(
    scene: Scene, folder: Path, config: KroncConfig, weights: Path | None, progress: Count | None = None
) -> Scene:
    """The scene with depths, where ``config`` starts from them and it has no depth maps."""
    if config.depth_init != "random" and scene.given_depths is not None:
        return scene
    estimator = depth_estimator(config, weights)
    return scene if estimator is None else estimate_depths(estimator, scene, folder, progress)


def estimate_depths(estimator: DepthEstimator, scene: Scene, folder: Path, progress: Count | None = None) -> Scene:
    """The scene, whose images lie in ``folder``, with the estimated depth under each keypoint; NaN where there is none.

    Maps are kept by image content, so that an interrupted run goes on where it stopped.
    """
    depths = np.full(scene.keypoints.shape[:2], np.nan)
    for number, (name, rows) in enumerate(zip(scene.names, scene.keypoints, strict=True)):
        if (rows[:, 2] > 0).any():
            depths[number] = depth_under(rows, _map_of(estimator, folder / name), scene.camera)
        if progress is not None:
            progress(number + 1, len(scene), None)
    if not np.isfinite(depths).any():
        raise KroncError(f"no depth was estimated under any keypoint ({estimator.identity}): use --depth-init random")
    return replace(scene, given_depths=depths)


@lru_cache(maxsize=1)
def _dino(weights: Path | None) -> DinoDepth:
    """Loaded once for many scenes."""
    return DinoDepth(weights)


def _map_of(estimator: DepthEstimator, image: Path) -> Float[np.ndarray, "h w"]:
    if not image.is_file():
        raise KroncError(f"{image} does not exist: --depth-init prior estimates depths from the images; use random")
    key = hashlib.sha256(f"{estimator.identity}\n{file_sha256(image)}".encode()).hexdigest()
    file = cache_folder() / "depths" / key[:2] / f"{key[2:]}.npy"
    if not file.exists():
        from kronc_ns.capture.detection.pixels import read_rgb

        depth = estimator.estimate(read_rgb(image)).astype(np.float32)
        with atomic_path(file) as temporary:
            np.save(temporary, depth)
    return np.load(file).astype(np.float64)
