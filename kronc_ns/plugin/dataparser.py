"""`kronc-dataparser`: solves the poses of a scene folder before training and hands them to any nerfstudio method.

This module must not import ``nerfstudio.engine.trainer``, ``nerfstudio.pipelines`` or ``nerfstudio.plugins.types``:
nerfstudio loads dataparsers while those are still being imported.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from kronc_ns.commands.console import exit_on_error, exit_status, report_table, solving
from kronc_ns.commands.image_options import ImageOptions
from kronc_ns.commands.options import SolverOptions
from kronc_ns.commands.refining import refine_with_bar
from kronc_ns.files.cache import Refinement, solve_cached
from kronc_ns.files.record import read_record, read_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.files.transforms import check_file_names
from kronc_ns.geometry.camera import Camera
from kronc_ns.geometry.poses import flip_camera_axes
from kronc_ns.plugin.background import cut_out
from kronc_ns.plugin.checks import check_masks, check_not_negative, check_positive
from kronc_ns.plugin.seeds import Seeds, box_seeds, grey, ground_seeds
from kronc_ns.plugin.views import SolvedViews, image_level, solved_views, test_views
from kronc_ns.plugin.visual_hull import carve, read_pictures
from kronc_ns.plugin.world import world_around
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status


@dataclass
class KroncDataParserConfig(SolverOptions, ImageOptions, DataParserConfig):
    """Poses from semantic keypoints: a scene folder with images, transforms.json (intrinsics) and keypoints.json."""

    _target: type = field(default_factory=lambda: KroncDataParser)
    """The dataparser."""
    data: Path = Path()
    """Scene folder; it is only read. What `ns-process-data kronc` wrote is used as solved unless a solver option or
    keypoints are given."""
    keypoints: Path | None = None
    """Keypoints from elsewhere: our keypoints.json, COCO, OpenPifPaf, MMPose, Ultralytics or Label Studio
    (docs/keypoints.md)."""
    keypoint_names: str | None = None
    """Which points they are, where their file does not say: apollocar3d-66, openpifpaf-24, or a file with a name a
    line."""
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
        self._solved: tuple[Scene, Solution] | None = None

    def _generate_dataparser_outputs(self, split: str = "train", **_: Any) -> DataparserOutputs:
        config = self.config
        with exit_on_error():
            check_positive(scale_factor=config.scale_factor, scene_scale=config.scene_scale)
            check_not_negative(num_seed_points=config.num_seed_points)
            if self._solved is None:
                self._solved = self._solve()
            return self._outputs(split, *self._solved)

    def _solve(self) -> tuple[Scene, Solution]:
        """The scene, and its solution: that of a solved folder, else from the cache, else solved now."""
        config = self.config
        scene = load_scene(config.data, config.keypoints, config.keypoint_names)
        check_file_names(scene.names, config.data / "transforms.json")
        folder = config.data
        own_keypoints = config.keypoints is not None or config.keypoint_names is not None
        own_options = config.any_solver_option() or config.any_image_option()
        if not (folder / "kronc.json").exists() or own_keypoints or own_options:
            with solving("solving poses") as progress:
                folder = solve_cached(config.data, scene, config.solver_config(), progress, self._refinement(scene))
        solution = read_solution(folder)[1]  # which names what is broken
        record = read_record(folder)
        CONSOLE.print(report_table(record, scene.notes))
        doubt = exit_status(record)
        if record["status"] == Status.FAILED.value:
            sys.exit(doubt)
        return scene, solution

    def _refinement(self, scene: Scene) -> Refinement | None:
        """How solutions are refined by images, where there are any."""
        config, solver = self.config, self.config.solver_config()
        refine = config.refine_config(solver.refine_focal, solver.refine_k1, solver.seed)
        if refine is None or solver.solver == "none" or not (config.data / scene.names[0]).exists():
            return None

        def refined(solution: Solution) -> Solution:
            right = scene.with_sides_swapped(solution.swapped)
            return refine_with_bar(config.data, right, solution, refine)

        return refine, refined

    def _outputs(self, split: str, scene: Scene, solution: Solution) -> DataparserOutputs:
        config = self.config
        test = test_views(len(solution.names), config.eval_interval, config.eval_fraction)
        everyone = solved_views(config.data, scene, solution, test)
        # of the solution, whose intrinsics may have been refined
        sizes = [(camera.width, camera.height) for camera in everyone.cameras]
        largest = max(range(len(sizes)), key=lambda i: max(sizes[i]))
        level = image_level(everyone.images[largest], sizes[largest], config.downscale_factor)
        views = everyone.of_split(split).at_level(level)
        images, masks = self._images(views)
        points = solution.points[np.isfinite(solution.points).all(-1)]
        world = world_around(points, everyone.c2w[everyone.posed], config.scene_scale, config.scale_factor)
        seeds = grey(points)
        if solution.cloud is not None:
            seen = solution.cloud.on_vehicle | (views.masks is None or self.config.background == "keep")
            seeds += Seeds(solution.cloud.points[seen], solution.cloud.colours[seen])
        if split == "train":  # models start from the training views' metadata
            seeds += self._seeds(views, world.box)
        return DataparserOutputs(
            image_filenames=images,
            cameras=_cameras(world.of_poses(views.c2w), views.cameras, level),
            alpha_color=None if config.background == "keep" else torch.ones(3),
            scene_box=SceneBox(aabb=_tensor(world.of_points(world.box))),
            mask_filenames=masks,
            dataparser_transform=torch.cat([torch.eye(3), -_tensor(world.centre)[:, None]], dim=1),
            dataparser_scale=world.scale,
            metadata={
                "points3D_xyz": _tensor(world.of_points(seeds.points)),
                "points3D_rgb": torch.from_numpy(seeds.colours),
            },
        )

    def _images(self, views: SolvedViews) -> tuple[list[Path], list[Path] | None]:
        """The files of the images and masks to train on, as the background is to be treated."""
        if views.masks is None or self.config.background == "keep":
            return list(views.images), None
        check_masks(views.masks)
        if self.config.background == "mask":
            return list(views.images), list(views.masks)
        return cut_out(views.images, views.masks), None

    def _seeds(self, views: SolvedViews, box: Float[np.ndarray, "2 3"]) -> Seeds:
        """Points to start from, in the solved world: the visual hull, or else random points."""
        count = self.config.num_seed_points
        car = box_seeds(box, count)
        if views.masks is not None and self.config.seeds == "hull":
            hull = carve(read_pictures(views.images, views.masks, views.cameras), views.c2w, box, count)
            if len(hull.points):
                car = hull
            else:
                CONSOLE.print(
                    "[yellow]the masks leave nothing of the car in its box: starting from random points[/yellow]"
                )
        if views.masks is not None and self.config.background != "keep":
            return car
        return car + ground_seeds(box, views.c2w, count // 2)


def _cameras(c2w: Float[np.ndarray, "n 3 4"], of_views: Sequence[Camera], level: int) -> Cameras:
    """nerfstudio's cameras at ``c2w`` (OpenCV axes) for images at 1/``level`` of their size."""
    numbers = torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in of_views])[..., None]
    sizes = torch.tensor([[c.width, c.height] for c in of_views])[..., None]
    fx, fy, cx, cy = numbers.unbind(1)
    cameras = Cameras(
        camera_to_worlds=_tensor(flip_camera_axes(c2w)),
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        width=sizes[:, 0],
        height=sizes[:, 1],
        distortion_params=torch.tensor([[c.k1, c.k2, 0.0, 0.0, c.p1, c.p2] for c in of_views]),
        camera_type=CameraType.PERSPECTIVE,
        metadata={},  # where `ns-export cameras` notes which camera of a refined run it is
    )
    cameras.rescale_output_resolution(scaling_factor=1.0 / level)
    return cameras


def _tensor(array: Float[np.ndarray, "*n"]) -> Float[Tensor, "*n"]:
    """Numbers as nerfstudio takes them."""
    return torch.from_numpy(array).float()


kronc_dataparser = DataParserSpecification(
    config=KroncDataParserConfig(),
    description="Camera poses from semantic keypoints of a car, solved before training (KRONC).",
)
