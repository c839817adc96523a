"""What can be chosen about a fleet; imports nothing, so that the command can show its help."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import tyro

from kronc_ns.capture.detection.choice import DetectorOptions
from kronc_ns.commands.image_options import ImageOptions
from kronc_ns.commands.options import Flag, SolverOptions
from kronc_ns.errors import KroncError

Reports: TypeAlias = Literal["all", "doubtful", "none"]
SegmenterName: TypeAlias = Literal["maskrcnn", "mask2former", "saliency"]


@dataclass(kw_only=True)
class FleetOptions(SolverOptions, ImageOptions):
    """How each capture is done, and what it may take."""

    poses_only: Flag = False
    """Of each capture write transforms.json, kronc.json, the keypoints and the report alone, no images. Where keypoints
    are there already, the images are not even read."""
    reports: Reports = "all"
    """Which captures get a report.html (about 5 MB each): all, those that are not converged, or none."""
    keypoint_names: str | None = None
    """Which points the captures' keypoints are, where their files do not say: apollocar3d-66, openpifpaf-24, or a file
    with a name a line."""
    detection: Annotated[DetectorOptions, tyro.conf.arg(name="")] = field(default_factory=DetectorOptions)
    """How keypoints are found, where a capture has none."""
    segmenter: SegmenterName | None = None
    """Make masks of captures that have none, as in ns-process-data kronc."""
    segmenter_weights: Path | None = None
    """Weights of the segmenter; as all weights, in the same place on every node."""
    num_frames: int = 100
    """Frames taken from a video: the sharpest of as many equal spans of time, unless nothing has moved."""
    fps: float | None = None
    """Frames per second taken from a video, sharp or not, instead."""
    keep_duplicates: Flag = False
    """Take also photos and frames that show nothing new."""
    focal_length_px: float | None = None
    """Focal length in pixels of the full-size images. Default: from transforms.json, else from EXIF."""
    camera: Path | None = None
    """JSON with calibrated intrinsics and distortion of the images of all captures."""
    fov_deg: float = 65.0
    """Field of view across the longer side that is assumed where nothing tells the focal length."""
    num_downscales: int = 3
    """Downscaled copies of the images."""
    depth_weights: Path | None = None
    """For --depth-init prior without depth maps: folder or Hugging Face name of a DINOv2 model with a DPT head."""

    cpus: int = 2
    """CPUs that a capture with images is given (at most those of the largest node); one without takes one."""
    gpus: float | None = None
    """GPUs that a capture with images is given (default: 1 with --device cuda or a --segmenter that uses one, where the
    cluster has any; else 0)."""
    memory_gb: float = 8.0
    """Memory that a capture may take; beyond, it fails and the others go on."""
    scratch: Path | None = None
    """Folder on each node for what a capture needs while it is done (default: the system's temporary folder)."""
    scratch_gb: float = 20.0
    """Disk that a capture may take there; beyond, it fails and the others go on."""
    time_limit_min: float = 60.0
    """Minutes that a capture may take; beyond, it is ended and counts as a worker's death."""
    retries: int = 2
    """How often a capture is tried again whose worker died or whose data could not be read or written."""

    def check(self) -> None:
        """Raise `KroncError` for values that cannot be."""
        least = {"--cpus": (self.cpus, 1), "--retries": (self.retries, 0), "--num-downscales": (self.num_downscales, 0)}
        for name, (value, minimum) in least.items():
            if value < minimum:
                raise KroncError(f"{name} is {value}: expected {minimum} or more")
        positive = {
            "--memory-gb": self.memory_gb,
            "--scratch-gb": self.scratch_gb,
            "--time-limit-min": self.time_limit_min,
        }
        for name, value in positive.items():
            if not 0 < value < math.inf:
                raise KroncError(f"{name} is {value:g}: expected a finite number above 0")
        if self.gpus is not None and not 0 <= self.gpus < math.inf:
            raise KroncError(f"--gpus is {self.gpus:g}: expected a finite number from 0 on")
        if self.segmenter_weights is not None and self.segmenter is None:
            raise KroncError("--segmenter-weights says what a --segmenter uses: give that too")
