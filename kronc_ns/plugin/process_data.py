"""`ns-process-data kronc` and its twin `kronc-process-data`: video or photos to a dataset with solved poses."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType
from typing import Annotated, Union

import tyro
from rich.console import Console

from kronc_ns.capture.depth import depth_estimator, with_depths
from kronc_ns.capture.detection.choice import DetectorOptions
from kronc_ns.capture.detection.detector import Detector
from kronc_ns.capture.detection.finding import find_keypoints
from kronc_ns.capture.detection.guided import GuidedDetector, second_look
from kronc_ns.capture.duplicates import without_duplicates
from kronc_ns.capture.frames import Frames, check_source, find_frames, plan_frames, prepare_frames, usual_size
from kronc_ns.capture.intrinsics import Intrinsics, find_all_intrinsics, read_calibration
from kronc_ns.capture.masks import check_masks, find_masks, write_masks
from kronc_ns.capture.matching import Matched, match_frames
from kronc_ns.capture.segmentation.choice import SegmenterOptions, segment_car
from kronc_ns.capture.segmentation.segmenter import Segmenter
from kronc_ns.capture.selection import Sampling
from kronc_ns.capture.sidecars import check_sidecars, copy_depths, copy_reference
from kronc_ns.capture.source import Source, find_source
from kronc_ns.commands.console import exit_on_error, exit_status, progress_bar, report_table, solving
from kronc_ns.commands.image_options import ImageOptions
from kronc_ns.commands.options import Flag, SolverOptions
from kronc_ns.commands.refining import refine_with_bar
from kronc_ns.errors import KroncError
from kronc_ns.files.cache import fingerprint
from kronc_ns.files.keypoints import FORMATS, Detections, read_keypoints, write_keypoints
from kronc_ns.files.output import check_output, claim_output, write_json
from kronc_ns.files.record import write_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.files.transforms import transforms_dict
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.fit.starts import MIN_POINTS
from kronc_ns.geometry.camera import Camera, Lenses
from kronc_ns.scene import Scene
from kronc_ns.show.report import write_report
from kronc_ns.solution import Solution, Status


@dataclass
class KroncToNerfstudio:
    """Process a walk around a car: camera poses from its semantic keypoints.

    The keypoints come from a file, else from a detector; with --detector none you get the frames alone.
    """

    data: Path
    """Video, folder of photos, or scene folder (transforms.json with intrinsics, images, keypoints.json)."""
    output_dir: Path
    """New or empty folder, or one that this command wrote; gets nerfstudio's layout and kronc.json."""
    keypoints: Path | None = None
    """Our keypoints.json, COCO, OpenPifPaf, MMPose, Ultralytics or Label Studio (docs/keypoints.md). Default: those in
    DATA, if any."""
    keypoint_names: str | None = None
    """Which points they are, where their file does not say: apollocar3d-66, openpifpaf-24, or a file with a name a
    line."""
    detection: Annotated[DetectorOptions, tyro.conf.arg(name="")] = field(default_factory=DetectorOptions)
    """How keypoints are found, where no file holds them."""
    masks: Path | None = None
    """Folder with a mask for each image, of the same stem (in the same subfolder), or one image for all: above 127 the
    car, else ignored. Default: those of transforms.json, or DATA/masks, if any."""
    segmentation: Annotated[SegmenterOptions, tyro.conf.arg(name="")] = field(default_factory=SegmenterOptions)
    """How masks are made, where there are none."""
    num_frames: int = 100
    """Frames taken from a video: the sharpest of as many equal spans of time, unless nothing has moved."""
    fps: float | None = None
    """Frames per second taken from a video, sharp or not, instead (5 in the paper)."""
    keep_duplicates: Flag = False
    """Take also photos and frames that show nothing new; of a row of those, the sharpest is taken otherwise."""
    focal_length_px: float | None = None
    """Focal length in pixels of the full-size image. Default: from transforms.json, else from EXIF."""
    camera: Path | None = None
    """JSON with calibrated intrinsics and distortion of images of this shape (fl_x, fl_y, cx, cy, w, h, k1, k2, p1, p2,
    as in transforms.json)."""
    fov_deg: float = 65.0
    """Field of view across the longer side that is assumed where nothing tells the focal length."""
    num_downscales: int = 3
    """Downscaled copies: 3 makes images_2, images_4 and images_8, while the smaller side keeps 100 px."""
    depth_weights: Path | None = None
    """For --depth-init prior without depth maps: folder or Hugging Face name of a DINOv2 model with a DPT head (default
    facebook/dpt-dinov2-base-kitti, downloaded)."""
    solve: Annotated[SolverOptions, tyro.conf.arg(name="")] = field(default_factory=SolverOptions)
    """How the poses are solved."""
    images: Annotated[ImageOptions, tyro.conf.arg(name="")] = field(default_factory=ImageOptions)
    """How they are refined by features of the images."""

    def main(self) -> None:
        """Process, and end the program with the status of what happened (0, 2, 3 or 130)."""
        with exit_on_error():
            status = self.run()
        if status:
            sys.exit(status)

    def run(self) -> int:
        """Process; raises `KroncError` for what the user can mend. Returns 3 for a doubtful solution, else 0."""
        config = self.solve.solver_config()
        self._check_options()
        source, out = find_source(self.data), self.output_dir
        given = self.keypoints or source.keypoints
        check_output(out, "data set")  # all that is wrong is told before the work begins
        if config.init == "given" and source.c2w is None:
            raise KroncError(
                f"--init given: {self.data} has no transforms.json with a pose for every frame: use --init auto"
            )
        detector = self.detection.make(default="builtin" if given is None else "none")
        if detector is not None and self.keypoint_names is not None:
            raise KroncError(f"--keypoint-names {self.keypoint_names}: expected --keypoints, whose points they name")
        segmenter = self.segmentation.make()
        if source.depths is None:
            depth_estimator(config, self.depth_weights)
        sampling = Sampling(self.num_frames, self.fps, self.keep_duplicates)
        sizes = check_source(source, sampling)
        check_sidecars(source)
        found = None if detector else self._read_keypoints(source, given)
        intrinsics = self._intrinsics(source, sizes)
        every_name = source.names
        frames = find_frames(source, out, sampling, self.num_downscales)
        if frames is None and self.keypoints is not None and self.keypoints.resolve().is_relative_to(out.resolve()):
            raise KroncError(
                f"the frames in {out / 'images'} are not of this command, so the keypoints beside them do not fit: "
                "repeat the options of the first run, or run without --keypoints and detect anew"
            )
        if frames is None and not self.keep_duplicates:
            with progress_bar("comparing photos") as progress:
                source = without_duplicates(source, usual_size(sizes), progress)
        planned = frames or plan_frames(source, self.num_downscales)
        given_masks = None if segmenter else self.masks or source.masks
        if given_masks is not None:
            check_masks(given_masks, planned, usual_size(sizes))
        if found is not None and planned is not None:
            match_frames(found, every_name, planned, intrinsics.camera)
        claim_output(out, "data set")
        if frames is None:
            with progress_bar("frames") as progress:
                keep = [self.masks if self.masks.is_dir() else self.masks.parent] if self.masks else []
                frames = prepare_frames(source, out, sampling, self.num_downscales, keep, progress)
        if intrinsics.assumed:
            print(_assumption(intrinsics), file=sys.stderr)
        masks, mask_note = self._write_masks(segmenter, given_masks, frames)
        own = dict(zip(every_name, intrinsics.cameras, strict=True)) if intrinsics.cameras else {}
        lenses = Lenses.of([own[name] for name in frames.source_names]) if own else None
        camera = intrinsics.camera if lenses is None else lenses.usual
        depths = copy_depths(source, frames, out)
        write_json(
            out / "transforms.json", transforms_dict(camera, frames.names, source.c2w, masks, depths, lenses=lenses)
        )
        copy_reference(source, frames, out)
        if detector is not None:
            found = _detect(detector, frames, masks, out)
        if found is None:
            print(_how_to_go_on(frames, out))
            return 0
        mask_files = [out / mask for mask in masks] if masks else None
        note = _write_keypoints(match_frames(found, every_name, frames, intrinsics.camera, mask_files), frames, out)

        scene = load_scene(out)
        if intrinsics.assumed and config.solver == "lm":
            config = replace(config, refine_focal=True)
        with progress_bar("estimating depths") as progress:
            scene = with_depths(scene, out, config, self.depth_weights, progress)
        with solving() as progress:
            solution = solve_scene(scene, config, progress)
        again = ""
        if isinstance(detector, GuidedDetector) and solution.status is not Status.FAILED:
            scene, solution, again = _look_again(detector, scene, solution, config, out)
        refine = self.images.refine_config(config.refine_focal, config.refine_k1, config.seed)
        if refine is not None and solution.status is not Status.FAILED and config.solver != "none":
            right = scene.with_sides_swapped(solution.swapped)
            solution = refine_with_bar(out, right, solution, refine)
        report = write_solution(out, scene, solution, out, fingerprint(scene, config))

        table = report_table(report, (*scene.notes, *([note] if note else [])))
        levels = "".join(f", 1/{factor}" for factor in frames.factors)
        origin = "as an earlier run left them" if frames.reused else f"from {source.kind} {self.data}"
        left_out = f"; {frames.note}" if frames.note else ""
        measures = " and ".join(f"{width}x{height}" for width, height in dict.fromkeys(frames.sizes))
        table.add_row("frames", f"{len(frames.names)} of {measures}{levels}, {origin}{left_out}")
        if mask_note:
            table.add_row("masks", mask_note)
        table.add_row("keypoints", _seen(scene))
        if again:
            table.add_row("second look", again)
        refined = f", refined to {_focal(solution.camera, solution.lenses)}" if config.refine_focal else ""
        table.add_row("focal length", f"{_focal(camera, lenses)}: {intrinsics.source}{refined}")
        table.add_row("report", str(write_report(out)))
        Console().print(table)
        status = exit_status(report)
        if status == 0:
            print(f"ns-train nerfacto --data {out}")
        return status

    def _check_options(self) -> None:
        Sampling(self.num_frames, self.fps)
        if self.num_downscales < 0:
            raise KroncError(f"--num-downscales is {self.num_downscales}: expected 0 or more")
        data, out = self.data.resolve(), self.output_dir.resolve()
        if data == out or out in data.parents:
            raise KroncError(f"--data {self.data} lies in --output-dir {self.output_dir}: choose another output folder")
        if self.keypoints is not None and self.detection.detector not in (None, "none"):
            raise KroncError(f"--keypoints {self.keypoints} and --detector {self.detection.detector}: give one of them")
        if self.masks is not None and self.segmentation.segmenter is not None:
            raise KroncError(f"--masks {self.masks} and --segmenter {self.segmentation.segmenter}: give one of them")
        if self.masks is not None and not self.masks.exists():
            raise KroncError(
                f"--masks {self.masks} is no folder and no image: expected a mask for each photo, of the same stem, or "
                "one for all"
            )

    def _read_keypoints(self, source: Source, given: Path | None) -> Detections | None:
        """Detections of a file, or None where frames alone are wanted."""
        if given is not None:
            return read_keypoints(given, self.keypoint_names)
        if source.kind == "scene folder":
            raise KroncError(
                f"{self.data} has no keypoints.json: give --keypoints ({FORMATS}), or find them with --detector builtin"
            )
        if (self.output_dir / "kronc.json").exists():
            raise KroncError(
                f"{self.output_dir} is solved already: give --keypoints ({FORMATS}) or another --detector to solve it "
                "anew"
            )
        return None

    def _intrinsics(self, source: Source, sizes: Sequence[tuple[int, int]]) -> Intrinsics:
        given, given_by = source.cameras, "transforms.json"
        if self.camera is not None:
            given, given_by = tuple(read_calibration(self.camera, size) for size in sizes), str(self.camera)
        return find_all_intrinsics(sizes, source.images, given, self.focal_length_px, self.fov_deg, given_by)

    def _write_masks(
        self, segmenter: Segmenter | None, given: Path | tuple[Path, ...] | None, frames: Frames
    ) -> tuple[tuple[str, ...] | None, str]:
        """Paths of the masks, if there are any, and a note on how they were made."""
        out = self.output_dir
        if segmenter is not None:
            with TemporaryDirectory(prefix="kronc-masks-") as folder, progress_bar("segmenting") as progress:
                files, note = segment_car(segmenter, [out / name for name in frames.names], Path(folder), progress)
                return write_masks(files, frames, out), note
        return (None if given is None else write_masks(find_masks(given, frames), frames, out)), ""


def extend_commands(script: ModuleType) -> None:
    """Add the subcommand ``kronc`` to nerfstudio's ``ns-process-data`` module; called by the import hook."""
    subcommand = Annotated[KroncToNerfstudio, tyro.conf.subcommand(name="kronc")]
    script.Commands = Union[script.Commands, subcommand]  # pyright: ignore[reportAttributeAccessIssue]  # noqa: UP007


def main() -> None:
    """Entry point of `kronc-process-data`."""
    tyro.cli(KroncToNerfstudio, prog="kronc-process-data").main()


def _detect(detector: Detector, frames: Frames, masks: tuple[str, ...] | None, out: Path) -> Detections:
    with progress_bar("detecting") as progress:
        return find_keypoints(detector, out, frames.names, frames.sizes, masks, progress)


def _look_again(
    detector: GuidedDetector, scene: Scene, solution: Solution, config: KroncConfig, out: Path
) -> tuple[Scene, Solution, str]:
    """Look for the points where the solution expects them; the keypoints file follows if that is better."""
    with progress_bar("looking again") as progress:
        looked, solution, note = second_look(detector, out, scene, solution, config, progress)
    if looked is not scene:
        rows = dict(zip(looked.names, looked.keypoints, strict=True))
        size = None if scene.lenses else (scene.camera.width, scene.camera.height)
        write_keypoints(out / "keypoints.json", looked.schema, size, rows, looked.sigma_px)
    return looked, solution, note


def _seen(scene: Scene) -> str:
    """How many frames have enough points for a pose, and how many points they have."""
    counts = scene.visibility.sum(1)
    enough = int((counts >= MIN_POINTS).sum())
    without = int((counts == 0).sum())
    missing = f"; none in {without}" if without else ""
    return f"{enough} of {len(counts)} frames with {MIN_POINTS} or more, {counts.mean():.1f} a frame{missing}"


def _write_keypoints(matched: Matched, frames: Frames, out: Path) -> str:
    """Write keypoints of one car as OUT/keypoints.json under the new names; a note on choices made."""
    target = out / "keypoints.json"
    if matched.source.resolve() == target.resolve():
        return ""
    size = frames.size if len({*frames.sizes}) == 1 else None
    write_keypoints(target, matched.schema, size, dict(zip(frames.names, matched.rows, strict=True)), matched.sigma_px)
    return matched.note


def _focal(camera: Camera, lenses: Lenses | None) -> str:
    """Focal lengths in words."""
    cameras = (camera,) if lenses is None else lenses.cameras
    return f"{', '.join(f'{one.fx:.1f}' for one in cameras)} px"


def _assumption(intrinsics: Intrinsics) -> str:
    return (
        f"warning: focal length {intrinsics.camera.fx:.0f} px is an {intrinsics.source}; "
        "give --focal-length-px or --camera for exact poses"
    )


def _how_to_go_on(frames: Frames, out: Path) -> str:
    images = out / "images"
    note = f" ({frames.note})" if frames.note else ""
    return (
        f"{len(frames.names)} frames are ready in {images}{note}: for their poses run the same command again without "
        f"`--detector none`, or with `--keypoints` ({FORMATS})"
    )


if __name__ == "__main__":
    main()
