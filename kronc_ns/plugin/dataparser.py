"""`kronc-dataparser`: solves the poses of a scene folder before training and hands them to any nerfstudio method.

This module must not import ``nerfstudio.engine.trainer``, ``nerfstudio.pipelines`` or ``nerfstudio.plugins.types``:
nerfstudio loads dataparsers while those are still being imported.
"""

import sys
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from kronc_ns.commands.console import exit_on_error, exit_status, progress_bar, report_table
from kronc_ns.commands.options import SolverOptions
from kronc_ns.errors import KroncError
from kronc_ns.files.cache import read_report, solve_cached
from kronc_ns.files.output import read_json
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.files.transforms import camera_and_frames, check_file_names, read_poses
from kronc_ns.geometry.camera import Camera
from kronc_ns.geometry.poses import flip_camera_axes
from kronc_ns.plugin.checks import check_masks, check_not_negative, check_positive
from kronc_ns.plugin.images import cut_out, downscaled
from kronc_ns.plugin.seeds import Seeds, box_seeds, grey, ground_seeds
from kronc_ns.plugin.visual_hull import carve, read_pictures
from kronc_ns.scene import Scene
from kronc_ns.solution import Status

_BOX_MARGIN = 0.1  # of the car's length: keypoints stop short of tyres, mirrors and the roof


@dataclass
class KroncDataParserConfig(SolverOptions, DataParserConfig):
    """Poses from semantic keypoints: a scene folder with images, transforms.json (intrinsics) and keypoints.json."""

    _target: type = field(default_factory=lambda: KroncDataParser)
    """The dataparser."""
    data: Path = Path()
    """Scene folder; it is only read. What `ns-process-data kronc` wrote is used as solved unless a solver option or
    keypoints are given."""
    keypoints: Path | None = None
    """Keypoints from elsewhere: our keypoints.json, a folder of OpenPifPaf *.predictions.json, or COCO JSON."""
    background: Literal["white", "mask", "keep"] = "white"
    """white: train on the vehicle alone, cut out by the masks or the images' alpha; mask: ignore what the masks
    leave out; keep: train on the full frame."""
    eval_interval: int = 8
    """Every so manieth image is a test image (LLFF protocol: 8), counted before views are left out."""
    eval_fraction: float | None = None
    """Share of the images to test on, evenly spread, instead of every eval_interval-th."""
    scale_factor: float = 1.0
    """Size of the scene: the farthest camera stands at this distance from the car's centre."""
    scene_scale: float = 1.0
    """Size of the scene box relative to the car's (a margin of a tenth of its length is included)."""
    downscale_factor: int | None = None
    """Use images_2, images_4, ... of a processed folder; by default such that the longer side is below 1600 px."""
    seeds: Literal["hull", "box"] = "hull"
    """What splatfacto starts from besides the keypoints. hull: the surface that the masks leave, with its colours;
    box (and where there are no masks): random points in the car's box and on the ground."""
    num_seed_points: int = 10_000
    """How many such points, at the most."""


@dataclass
class KroncDataParser(DataParser):
    """Reads a scene folder, solves it or takes the cached solution, and splits it for training and evaluation."""

    config: KroncDataParserConfig

    def __init__(self, config: KroncDataParserConfig) -> None:
        super().__init__(config=config)
        self._solved: tuple[Scene, dict[str, Tensor], dict[str, Any]] | None = None

    def _generate_dataparser_outputs(self, split: str = "train", **_: Any) -> DataparserOutputs:
        config = self.config
        with exit_on_error():
            check_positive(scale_factor=config.scale_factor, scene_scale=config.scene_scale)
            check_not_negative(num_seed_points=config.num_seed_points)
            if self._solved is None:
                self._solved = self._solve()
            return self._outputs(split, *self._solved)

    def _solve(self) -> tuple[Scene, dict[str, Tensor], dict[str, Any]]:
        """The scene, poses (OpenCV c2w) by file name of the views that have one, and the report of the solution."""
        config = self.config
        scene = load_scene(config.data, config.keypoints)
        check_file_names(scene.names, config.data / "transforms.json")
        report = read_report(config.data)
        if report is not None and config.keypoints is None and not config.any_solver_option():
            folder = config.data
        else:
            with progress_bar("solving poses") as progress:
                folder = solve_cached(config.data, scene, config.solver_config(), progress)
            report = read_report(folder)
        assert report is not None
        CONSOLE.print(report_table(report, scene.notes))
        doubt = exit_status(report)
        if report["status"] == Status.FAILED.value:
            sys.exit(doubt)
        poses = read_poses(folder / "transforms.json")
        camera, _ = camera_and_frames(read_json(folder / "transforms.json"), folder / "transforms.json")
        scene = replace(scene, camera=camera)  # its intrinsics may have been refined
        return scene, {PurePosixPath(name).name: pose for name, pose in poses.items()}, report

    def _outputs(self, split: str, scene: Scene, poses: dict[str, Tensor], report: dict[str, Any]) -> DataparserOutputs:
        config = self.config
        everyone = [PurePosixPath(view["file_path"]).name for view in report["views"]]
        tested = test_views(len(everyone), config.eval_interval, config.eval_fraction).tolist()
        is_test = dict(zip(everyone, tested, strict=True))
        test = torch.tensor([is_test.get(PurePosixPath(name).name, False) for name in scene.names])
        posed = torch.tensor([PurePosixPath(name).name in poses for name in scene.names])
        chosen = {"train": ~test & posed, "val": test & posed, "test": test & posed, "all": posed}.get(split)
        if chosen is None:
            raise KroncError(f"unknown split {split!r}: expected train, val, test or all")
        if not chosen.any():
            raise KroncError(
                f"no view is left for the {split} split: {int(posed.sum())} of {len(scene)} views have a pose"
            )
        indices = chosen.nonzero()[:, 0].tolist()

        all_c2w = torch.stack([poses[PurePosixPath(scene.names[i]).name] for i in posed.nonzero()[:, 0].tolist()])
        points = torch.tensor([p for p in report["points"] if None not in p], dtype=torch.float64).reshape(-1, 3)
        box = car_box(points, all_c2w, config.scene_scale)
        centre = box.mean(0)
        scale = config.scale_factor / float((all_c2w[..., 3] - centre).norm(dim=-1).max())
        c2w = torch.stack([poses[PurePosixPath(scene.names[i]).name] for i in indices])
        c2w[..., 3] = (c2w[..., 3] - centre) * scale
        move = torch.cat([torch.eye(3), -centre.float()[:, None]], dim=1)

        camera, factor = scene.camera, downscaled(config.data, scene, config.downscale_factor)
        images = [factor.path(scene.names[i]) for i in indices]
        masks = [factor.path(scene.masks[i]) for i in indices] if scene.masks else None
        missing = [path for path in [*images, *(masks or [])] if not path.exists()]
        if missing:
            remedy = "" if factor.factor == 1 else "; `ns-process-data kronc` writes those of 1/2, 1/4 and 1/8"
            raise KroncError(
                f"{missing[0]} does not exist: training needs the images ({len(missing)} are missing){remedy}"
            )
        if masks is not None and config.background != "keep":
            check_masks(masks)
        seeds = grey(points)
        if split == "train":  # models start from the training views' metadata
            chosen_c2w = torch.stack([poses[PurePosixPath(scene.names[i]).name] for i in indices])
            seeds += self._seeds(box, chosen_c2w, images, masks, camera)
        if config.background == "white" and masks is not None:
            images = cut_out(images, masks)
        cameras = Cameras(
            camera_to_worlds=flip_camera_axes(c2w).float(),
            fx=camera.fx,
            fy=camera.fy,
            cx=camera.cx,
            cy=camera.cy,
            width=camera.width,
            height=camera.height,
            distortion_params=torch.tensor([camera.k1, camera.k2, 0.0, 0.0, camera.p1, camera.p2]).expand(
                len(indices), -1
            ),
            camera_type=CameraType.PERSPECTIVE,
        )
        cameras.rescale_output_resolution(scaling_factor=1.0 / factor.factor)
        return DataparserOutputs(
            image_filenames=images,
            cameras=cameras,
            alpha_color=None if config.background == "keep" else torch.ones(3),
            scene_box=SceneBox(aabb=((box - centre) * scale).float()),
            mask_filenames=masks if config.background == "mask" else None,
            dataparser_transform=move,
            dataparser_scale=scale,
            metadata={"points3D_xyz": ((seeds.points - centre) * scale).float(), "points3D_rgb": seeds.colours},
        )

    def _seeds(
        self,
        box: Float[Tensor, "2 3"],
        c2w: Float[Tensor, "n 3 4"],
        images: list[Path],
        masks: list[Path] | None,
        camera: Camera,
    ) -> Seeds:
        """Points to start from, in the solved world: the visual hull, or else random points."""
        count = self.config.num_seed_points
        if masks is not None and self.config.seeds == "hull":
            points, colours = carve(read_pictures(images, masks, camera), c2w, box, count)
            if len(points) and self.config.background == "keep":
                return Seeds(points, colours) + ground_seeds(box, c2w, count // 2)
            if len(points):
                return Seeds(points, colours)
            CONSOLE.print("[yellow]the masks leave nothing of the car in its box: starting from random points[/yellow]")
        if masks is not None and self.config.background != "keep":
            return box_seeds(box, count)
        return box_seeds(box, count) + ground_seeds(box, c2w, count // 2)


def test_views(views: int, interval: int, fraction: float | None) -> Bool[Tensor, "n"]:
    """Which views are test views: every ``interval``-th from the first on, or an evenly spread ``fraction``."""
    test = torch.zeros(views, dtype=torch.bool)
    if fraction is None:
        if interval < 2:
            raise KroncError(f"eval_interval is {interval}: expected 2 or more, or nothing is left to train on")
        test[::interval] = True
    else:
        if not 0 < fraction < 1:
            raise KroncError(f"eval_fraction is {fraction}: expected a share above 0 and below 1")
        count = min(max(1, round(views * fraction)), views - 1)
        test[torch.from_numpy(np.linspace(0, views, count, endpoint=False).astype(np.int64))] = True
    return test


def car_box(points: Float[Tensor, "j 3"], c2w: Float[Tensor, "n 3 4"], scale: float = 1.0) -> Float[Tensor, "2 3"]:
    """Lower and upper corner of the solved keypoints' box with a margin, scaled about its centre."""
    if len(points) < 2:
        raise KroncError(f"{len(points)} solved keypoints: expected at least 2 to know where the object is")
    low, high = points.amin(0), points.amax(0)
    margin = _BOX_MARGIN * (high - low).max()
    centre, half = (low + high) / 2, (high - low) / 2 + margin
    return torch.stack([centre - scale * half, centre + scale * half])


kronc_dataparser = DataParserSpecification(
    config=KroncDataParserConfig(),
    description="Camera poses from semantic keypoints of a car, solved before training (KRONC).",
)
