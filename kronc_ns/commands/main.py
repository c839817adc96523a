"""The `kronc` command."""

import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
from rich.console import Console
from rich.table import Table

from kronc_ns.benchmark.command import Bench
from kronc_ns.capture.datasets import import_dataset
from kronc_ns.capture.depth import with_depths
from kronc_ns.capture.detection.conversion import ConvertDetector
from kronc_ns.commands.batch import expand, solve_folders
from kronc_ns.commands.console import exit_on_error, exit_status, metrics_table, progress_bar, report_table
from kronc_ns.commands.options import SolverOptions
from kronc_ns.errors import KroncError
from kronc_ns.files.cache import fingerprint
from kronc_ns.files.colmap import write_colmap
from kronc_ns.files.output import claim_output
from kronc_ns.files.ply import write_ply
from kronc_ns.files.record import write_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.files.transforms import read_poses
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.metrics.poses import evaluate_poses
from kronc_ns.synthetic.folder import Renderer, write_capture
from kronc_ns.synthetic.mesh import load_mesh_car
from kronc_ns.synthetic.scenes import default_camera, make_capture
from kronc_ns.synthetic.variations import noisy_poses


@dataclass(kw_only=True)
class Solve(SolverOptions):
    """Find the camera poses of scene folders (transforms.json with intrinsics, keypoints.json)."""

    data: tuple[Path, ...]
    """Scene folder; several (or a quoted pattern such as 'captures/*') are solved together."""
    output_dir: Path
    """New or empty folder, or one with an earlier result; gets transforms.json, kronc.json and keypoints.ply. Of
    several scenes each gets a folder of its name in it."""
    keypoints: Path | None = None
    """Keypoints from elsewhere (of a single scene): our keypoints.json, a folder of OpenPifPaf *.predictions.json, or
    COCO JSON."""
    depth_weights: Path | None = None
    """For --depth-init prior without depth maps: folder or Hugging Face name of a DINOv2 model with a DPT head (default
    facebook/dpt-dinov2-base-kitti, downloaded)."""

    def run(self) -> int:
        """Solve and write."""
        config = self.solver_config()
        folders = expand(self.data)
        if len(folders) > 1:
            if self.keypoints is not None:
                raise KroncError(f"--keypoints {self.keypoints} with {len(folders)} scenes: expected a single scene")
            return solve_folders(folders, self.output_dir, config, self.depth_weights)
        scene = load_scene(folders[0], self.keypoints)
        if self.output_dir.resolve() == folders[0].resolve():
            raise KroncError(f"--output-dir {self.output_dir} is the scene itself: choose another folder")
        with progress_bar("estimating depths") as progress:
            scene = with_depths(scene, folders[0], config, self.depth_weights, progress)
        claim_output(self.output_dir)
        with progress_bar("solving") as progress:
            solution = solve_scene(scene, config, progress)
        report = write_solution(self.output_dir, scene, solution, folders[0], fingerprint(scene, config))
        Console().print(report_table(report, scene.notes))
        print(f"{self.output_dir / 'transforms.json'}")
        return exit_status(report)


@dataclass(kw_only=True)
class Eval:
    """Compare poses with a reference (--poses, --reference), or a trained run with its test views (--nvs)."""

    poses: Path | None = None
    """transforms.json with the poses to judge, after similarity alignment."""
    reference: Path | None = None
    """transforms.json (or reference.json) with the true or trusted poses."""
    nvs: Path | None = None
    """config.yml of a trained run of any nerfstudio method. PSNR, SSIM and LPIPS are given of the full frame and,
    where masks or alpha tell it, of the vehicle alone."""
    pictures: Path | None = None
    """With --nvs: new folder for a picture of every test view, rendered | truth | error (brightest from 0.25 on)."""
    json: bool = False
    """Print one JSON object instead of a table."""

    def run(self) -> int:
        """Print the errors."""
        if self.nvs is not None:
            if self.poses is not None or self.reference is not None:
                raise KroncError("--nvs with --poses or --reference: expected either a trained run or poses")
            return self._views(self.nvs)
        if self.poses is None or self.reference is None:
            raise KroncError("expected --poses and --reference, or --nvs with the config.yml of a trained run")
        if self.pictures is not None:
            raise KroncError(f"--pictures {self.pictures} without --nvs: only test views can be drawn")
        return self._poses(self.poses, self.reference)

    def _poses(self, poses: Path, reference: Path) -> int:
        errors = evaluate_poses(read_poses(poses), read_poses(reference)).as_dict()
        if self.json:
            print(json.dumps(errors))
            return 0
        table = Table("error", "mean", "median", "max", title=f"{errors['registered']} of {errors['views']} views")
        for label, key in (("rotation (deg)", "rotation_deg"), ("camera centre (reference's unit)", "translation")):
            table.add_row(label, *(f"{errors[key][which]:.4f}" for which in ("mean", "median", "max")))
        Console().print(table)
        print("  ".join(f"{key} {errors[key]:.4f}" for key in errors if key.startswith("auc")))
        return 0

    def _views(self, config: Path) -> int:
        # seconds of nerfstudio's imports, which no other command needs
        from kronc_ns.plugin.compatibility import lpips_remedy
        from kronc_ns.plugin.evaluate import evaluate_run

        with progress_bar("rendering") as progress:
            result = evaluate_run(config, self.pictures, progress)
        if result["full"]["lpips"] is None:
            print(f"LPIPS is not available: {lpips_remedy()}", file=sys.stderr)
        if self.json:
            print(json.dumps(result, allow_nan=False))
            return 0
        Console().print(metrics_table(result))
        return 0


@dataclass(kw_only=True)
class Synth:
    """Make a synthetic capture with exact ground truth: keypoints only, or rendered (--render)."""

    output_dir: Path
    """New or empty folder for the scene; the truth goes to reference.json."""
    preset: Literal["carpatch", "walk"] = "walk"
    """carpatch: cameras on a hemisphere, 400x400; walk: a handheld lap, 480x270."""
    views: int = 100
    """Number of images."""
    width: int | None = None
    """Image width in pixels (default: the preset's); the height follows."""
    noise_px: float = 0.0
    """Standard deviation of the keypoint noise per axis."""
    outliers: float = 0.0
    """Share of keypoints that lie anywhere on the car's box."""
    missing: float = 0.0
    """Share of visible keypoints that are not found."""
    pose_noise_deg: float = 0.0
    """Rotation noise of the poses written to transforms.json (with --pose-noise-m; 0 and 0: no poses)."""
    pose_noise_m: float = 0.0
    """Translation noise of the poses written to transforms.json."""
    render: bool = False
    """Draw images, masks and depth maps."""
    renderer: Renderer = "builtin"
    """builtin: a quick ray caster of the procedural car; blender: path-traced, of that car or any --mesh
    (pip install 'kronc-ns[blender]', Python 3.11)."""
    mesh: Path | None = None
    """A car of your own instead of the procedural one: .glb or .gltf in true size, with its 66 keypoints in
    keypoints3d.json beside it."""
    seed: int = 0
    """Seed of trajectory, detections and pose noise."""

    def run(self) -> int:
        """Make and write the capture."""
        shares = {"--outliers": self.outliers, "--missing": self.missing}
        for name, share in shares.items():
            if not 0 <= share < 1:
                raise KroncError(f"{name} is {share}: expected a share from 0 to below 1")
        noises = {
            "--noise-px": self.noise_px,
            "--pose-noise-deg": self.pose_noise_deg,
            "--pose-noise-m": self.pose_noise_m,
        }
        for name, noise in noises.items():
            if not 0 <= noise < math.inf:
                raise KroncError(f"{name} is {noise}: expected a finite standard deviation, 0 or more")
        if not 0 <= self.seed < 2**63:
            raise KroncError(f"--seed is {self.seed}: expected 0 to 2**63 - 1")
        if self.views < 1 or (self.width is not None and self.width < 16):
            raise KroncError(
                f"--views {self.views} --width {self.width}: expected at least 1 view of at least 16 pixels"
            )
        if self.renderer != "builtin" and not self.render:
            raise KroncError(f"--renderer {self.renderer} without --render: add --render, or nothing is drawn")
        camera = default_camera(self.preset, self.width)
        car = load_mesh_car(self.mesh) if self.mesh is not None else None
        capture = make_capture(
            self.preset, self.views, self.seed, self.noise_px, self.missing, self.outliers, camera, car
        )
        start = None
        if self.pose_noise_deg or self.pose_noise_m:
            generator = torch.Generator().manual_seed(self.seed)
            start = noisy_poses(capture.c2w, self.pose_noise_deg, self.pose_noise_m, generator)
        ground = self.preset == "walk"
        with progress_bar("rendering" if self.render else "writing") as progress:
            write_capture(
                self.output_dir,
                capture,
                start,
                self.render,
                ground,
                lambda view: progress(view, self.views, None),
                self.renderer,
            )
        mean = float(capture.keypoints[..., 2].sum(1).mean())
        print(f"{self.views} views, {mean:.1f} keypoints a view: {self.output_dir}")
        return 0


@dataclass(kw_only=True)
class Import:
    """Make a scene folder from a CarPatch scene, or from images with keypoints and a COLMAP model (KRONC-dataset)."""

    data: Path
    """CarPatch: transforms_SPLIT.json as of NeRF-synthetic, images, and keypoints_SPLIT.json or SPLIT/keypoints.json.
    Else: images/ or frames/, COLMAP's sparse/0, keypoints.json or keypoints/, and optionally masks/."""
    output_dir: Path
    """New or empty folder for the scene; the poses that came along go to reference.json."""
    splits: tuple[str, ...] = ("train", "test")
    """Splits of CarPatch to take, one after the other."""

    def run(self) -> int:
        """Write the scene folder."""
        views = import_dataset(self.data, self.output_dir, self.splits)
        print(f"{views} views: {self.output_dir}")
        return 0


@dataclass(kw_only=True)
class Export:
    """Write solved poses in another format."""

    data: Path
    """Folder that `kronc solve` or `ns-process-data kronc` wrote."""
    format: Literal["colmap", "ply"]
    """colmap: binary COLMAP model in a folder; ply: camera centres and keypoints as a point cloud."""
    output: Path | None = None
    """Where to (default: DATA/colmap/sparse/0, or DATA/cameras.ply); must not exist."""

    def run(self) -> int:
        """Export."""
        if not (self.data / "kronc.json").exists():
            raise KroncError(f"{self.data / 'kronc.json'} does not exist: expected a folder solved by `kronc solve`")
        default = self.data / ("colmap/sparse/0" if self.format == "colmap" else "cameras.ply")
        output = self.output or default
        if output.is_file() or (output.is_dir() and any(output.iterdir())):
            raise KroncError(f"{output} exists already: give another --output")
        write = write_colmap if self.format == "colmap" else write_ply
        count = write(output, self.data)
        print(f"{count} {'images' if self.format == 'colmap' else 'points'}: {output}")
        return 0


@dataclass(kw_only=True)
class Report:
    """Write report.html: cameras before and after, keypoints over images, residuals, every view; in a single file."""

    data: Path
    """Folder that `kronc solve` or `ns-process-data kronc` wrote; gets report.html."""

    def run(self) -> int:
        """Write the report."""
        # plotly takes half a second, which no other command needs
        from kronc_ns.show.report import write_report

        print(write_report(self.data))
        return 0


@dataclass(kw_only=True)
class View:
    """See solved cameras and keypoints in 3D in the browser: images, rays, before and after, every view's residuals."""

    data: Path
    """Folder that `kronc solve` or `ns-process-data kronc` wrote."""
    port: int = 8080
    """Where the browser finds it: http://localhost:PORT, on this machine only."""

    def run(self) -> int:
        """Serve until Ctrl-C."""
        from kronc_ns.show.viewer import view

        view(self.data, self.port)
        return 0


Command = (
    Annotated[Solve, tyro.conf.subcommand("solve")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
    | Annotated[Synth, tyro.conf.subcommand("synth")]
    | Annotated[Import, tyro.conf.subcommand("import")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[ConvertDetector, tyro.conf.subcommand("convert-detector")]
)


def main() -> None:
    """Entry point of `kronc`."""
    command = tyro.cli(
        Command, prog="kronc", description="Camera poses of a walk around a car from semantic keypoints."
    )
    with exit_on_error():
        raise SystemExit(command.run())


if __name__ == "__main__":
    main()
