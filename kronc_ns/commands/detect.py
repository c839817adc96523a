"""`kronc detect`."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import tyro

from kronc_ns.capture.detection.choice import DetectorOptions
from kronc_ns.commands.options import Flag
from kronc_ns.errors import KroncError

if TYPE_CHECKING:
    from kronc_ns.capture.detection.detector import Detector


@dataclass(kw_only=True)
class Detect:
    """Find the keypoints of the car in photos or a video: keypoints.json, for `kronc solve` and ns-process-data."""

    data: Path
    """Video, folder of photos or scene folder, or a single photo."""
    output_dir: Path
    """New or empty folder; of a video it also gets the frames."""
    detection: Annotated[DetectorOptions, tyro.conf.arg(name="")] = field(default_factory=DetectorOptions)
    """How keypoints are found."""
    num_frames: int = 100
    """Frames taken from a video: the sharpest of as many equal spans of time, unless nothing has moved."""
    pictures: Flag = False
    """Draw what was found: pictures/NAME.jpg, in subfolders as the photos are; the car's own left orange, its right
    blue, large where less sure."""

    def run(self) -> int:
        """Detect and write. Returns 3 where no image shows a car, else 0."""
        from kronc_ns.capture.frames import find_frames, prepare_frames
        from kronc_ns.capture.selection import Sampling
        from kronc_ns.capture.source import find_images
        from kronc_ns.commands.console import progress_bar
        from kronc_ns.files.output import claim_output, release_output

        sampling = Sampling(self.num_frames)
        detector = self.detection.make(default="builtin")
        if detector is None:
            raise KroncError("--detector none finds nothing: leave it out, or name another one")
        source, out = find_images(self.data), self.output_dir
        if self.data.resolve() == out.resolve():
            raise KroncError(f"--output-dir {out} is --data: choose another output folder")
        claim_output(out, "capture")
        if source.kind == "video":
            frames = find_frames(source, out, sampling, num_downscales=0)
            if frames is None:
                with progress_bar("frames") as progress:
                    frames = prepare_frames(source, out, sampling, num_downscales=0, progress=progress)
            status = self._detect(detector, [out / name for name in frames.names], frames.names)
        else:
            with TemporaryDirectory(prefix="kronc-detect-") as folder:
                orient = source.cameras is None  # else transforms.json speaks of the pixels as stored
                images = _upright(source.images, Path(folder)) if orient else source.images
                status = self._detect(detector, images, source.names)
        release_output(out)
        return status

    def _detect(self, detector: "Detector", images: Sequence[Path], names: Sequence[str]) -> int:
        import numpy as np

        from kronc_ns.capture.detection.detector import CarImage
        from kronc_ns.capture.detection.finding import find_cars, no_car
        from kronc_ns.capture.detection.marking import write_marked
        from kronc_ns.capture.images import upright_size
        from kronc_ns.commands.console import progress_bar
        from kronc_ns.files.keypoints import sigma_of, write_keypoints
        from kronc_ns.keypoints.selection import select_instances

        sizes = [upright_size(image, orient=False) for image in images]
        with progress_bar("detecting") as progress:
            found = find_cars(detector, [CarImage(image) for image in images], names, sizes, self.data, progress)
        instances, note = [found.frames[name] for name in names], ""
        if found.size is not None:
            rows, note = select_instances(instances, [found.size] * len(instances))
        else:  # no walk around one car
            pairs = zip(instances, sizes, strict=True)
            rows = np.concatenate([select_instances([cars], [size])[0] for cars, size in pairs])
        sigma = sigma_of(found, tuple(names), rows)
        file = self.output_dir / "keypoints.json"
        write_keypoints(file, detector.schema, found.size, dict(zip(names, rows, strict=True)), sigma)
        if self.pictures:
            for i, (name, image) in enumerate(zip(names, images, strict=True)):
                target = self.output_dir / "pictures" / _within(name)
                write_marked(target, image, sizes[i], detector.schema, rows[i], None if sigma is None else sigma[i])
        counts = (rows[..., 2] > 0).sum(1)
        if not counts.any():
            print(no_car(detector, len(names), self.data), file=sys.stderr)
            return 3
        seen = counts[counts > 0]
        several = f"; {note}" if "several" in note else ""
        print(f"{len(seen)} of {len(names)} images show the car, {seen.mean():.1f} points each{several}: {file}")
        return 0


def _within(name: str) -> Path:
    """Where an image's picture goes; in a folder of ours, wherever transforms.json says that the image is."""
    path = Path(name.removeprefix("images/").removesuffix(".jpg") + ".jpg")
    return Path(*(part for part in path.parts if part not in ("..", path.anchor)))


def _upright(images: Sequence[Path], folder: Path) -> list[Path]:
    """The photos as ns-process-data would copy them; only those that are turned, or HEIF, are written anew."""
    from PIL import Image

    from kronc_ns.capture.frames import frame_names
    from kronc_ns.capture.images import HEIF_SUFFIXES, copy_upright, is_turned, upright_size

    upright = []
    for image, name in zip(images, frame_names(images), strict=True):
        upright_size(image)  # names a file that cannot be read
        with Image.open(image) as header:
            turned = is_turned(header) or image.suffix.lower() in HEIF_SUFFIXES
        if turned:
            (folder / "images").mkdir(exist_ok=True)
            copy_upright(image, folder / name)
        upright.append(folder / name if turned else image)
    return upright
