"""The poses of a trained run, wherever its method refined them, as a transforms.json in its input's world."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.utils.eval_utils import eval_setup

from kronc_ns.errors import KroncError
from kronc_ns.files.output import relative_path, write_json
from kronc_ns.files.transforms import read_transforms, transforms_dict
from kronc_ns.geometry.camera import Camera, Lenses
from kronc_ns.geometry.poses import flip_camera_axes
from kronc_ns.plugin.pipeline import corrected
from kronc_ns.plugin.trained import check_trained, photos_of, read_config


@dataclass(frozen=True)
class RefinedPoses:
    """What a run made of its training views' poses."""

    images: tuple[Path, ...]
    c2w: Float[np.ndarray, "n 3 4"]
    """In the world of the data set's own file, OpenCV axes."""
    cameras: tuple[Camera, ...]


def refined_poses(config_file: Path) -> RefinedPoses:
    """The training views of a run at its last checkpoint; test views took no part in it.

    Raises `KroncError` where ``config_file`` is of no trained run, or its method did not refine poses.
    """
    config = read_config(config_file)
    check_trained(config)
    refines = getattr(getattr(config.pipeline.model, "camera_optimizer", None), "mode", "off")
    if refines == "off":
        raise KroncError(
            f"{config_file}: poses were not refined in this run: train with --pipeline.model.camera-optimizer.mode "
            "SO3xR3, or with barf or l2g-nerf"
        )
    photos = photos_of(config.pipeline.datamanager, "train")
    _, pipeline, _, _ = eval_setup(config_file, test_mode="inference")
    # what all of nerfstudio's have, their base classes do not declare
    manager: Any = pipeline.datamanager
    optimizer: Any = pipeline.model.camera_optimizer
    poses = corrected(optimizer, manager.train_dataset.cameras)
    original = manager.train_dataparser_outputs.transform_poses_to_original_space(poses, camera_convention="opengl")
    c2w = flip_camera_axes(_as_in_file(config.pipeline.datamanager, original.numpy().astype(np.float64)))
    cameras = tuple(_camera(photos.cameras, i) for i in range(len(photos)))
    return RefinedPoses(tuple(photos.image_filenames), c2w, cameras)


def write_refined_poses(config_file: Path, output: Path) -> int:
    """Write `refined_poses` as a transforms.json; how many views it has."""
    found = refined_poses(config_file)
    names = [relative_path(Path(), str(image), output.parent) for image in found.images]
    lenses = Lenses.of(list(found.cameras))
    camera = found.cameras[0] if lenses is None else lenses.usual
    write_json(output, transforms_dict(camera, names, found.c2w, lenses=lenses))
    return len(names)


def _as_in_file(manager: Any, c2w: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "n 3 4"]:
    """Poses in the world of the data set's transforms.json.

    nerfstudio's own dataparser goes farther back, past the ``applied_transform`` that `ns-process-data` noted there.
    """
    data = manager.data or manager.dataparser.data
    file = data if data.suffix == ".json" else data / "transforms.json"
    if not isinstance(manager.dataparser, NerfstudioDataParserConfig) or not file.is_file():
        return c2w
    content = read_transforms(file)
    applied = np.asarray(content.get("applied_transform", np.eye(4)[:3]), dtype=np.float64)
    turned = applied[:, :3] @ c2w
    turned[..., 3] = float(content.get("applied_scale", 1.0)) * (turned[..., 3] + applied[:, 3])
    return turned


def _camera(cameras: Cameras, i: int) -> Camera:
    """One of nerfstudio's cameras."""
    fx, fy, cx, cy = (float(getattr(cameras, name)[i]) for name in ("fx", "fy", "cx", "cy"))
    width, height = int(cameras.width[i]), int(cameras.height[i])
    k1, k2, _, _, p1, p2 = [0.0] * 6 if cameras.distortion_params is None else cameras.distortion_params[i].tolist()
    return Camera(fx, fy, cx, cy, width, height, k1, k2, p1, p2)
