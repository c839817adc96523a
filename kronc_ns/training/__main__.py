"""``python -m kronc_ns.training``: make the builtin detector's weights again, in steps that can be resumed."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")  # before OpenCV is imported: it reads the panoramas

import tyro

from kronc_ns.errors import KroncError
from kronc_ns.training.loop import Training


@dataclass(kw_only=True)
class Render:
    """Render training pictures; shards that are there stay."""

    cars_train: Path
    """Folder of NAME/car.glb."""
    output: Path
    """Folder of the shards."""
    cars: Path | None = None
    """Folder of cars that bring keypoints3d.json."""
    panoramas: Path | None = None
    """Folder of high dynamic range maps."""
    shards: tuple[int, int] = (0, 800)
    """Numbers of the first shard and of the one after the last; each holds some 60 pictures."""
    part: tuple[int, int] = (0, 1)
    """Which of how many processes this is."""
    seed: int = 0
    kept_out: bool = False
    """The cars that are kept out of training, to calibrate on."""

    def run(self) -> None:
        """Render and say what was written."""
        from kronc_ns.training.bodies import load_garage
        from kronc_ns.training.lighting import read_panoramas
        from kronc_ns.training.pictures import render_shards

        panoramas = [] if self.panoramas is None else read_panoramas(self.panoramas)
        numbers = range(self.shards[0] + self.part[0], self.shards[1], self.part[1])
        garage = load_garage(self.cars_train, self.cars, self.kept_out)
        for file in render_shards(garage, panoramas, self.output, numbers, self.seed):
            print(file, flush=True)


@dataclass(kw_only=True)
class Train:
    """Train; goes on from the checkpoint in the output folder."""

    training: Annotated[Training, tyro.conf.arg(name="")]
    device: str = "cpu"
    """cpu or cuda."""

    def run(self) -> None:
        """Train and print the log."""
        from kronc_ns.training.loop import train

        for line in train(self.training, self.device):
            print(line, flush=True)


@dataclass(kw_only=True)
class Export:
    """Write the ONNX file of a checkpoint."""

    checkpoint: Path
    output: Path

    def run(self) -> None:
        """Write it."""
        from kronc_ns.training.export import export

        export(self.checkpoint, self.output)
        print(self.output)


@dataclass(kw_only=True)
class Calibrate:
    """Measure how often the exported network is right on rendered pictures, and write its card beside it."""

    weights: Path
    """The ONNX file; NAME.json is written beside it."""
    pictures: Path
    """Folder of shards that were not trained on."""
    version: str
    """What the card calls these weights."""

    def run(self) -> None:
        """Measure and write."""
        from kronc_ns.training.calibration import calibrate

        print(calibrate(self.weights, self.pictures, self.version))


@dataclass(kw_only=True)
class Worst:
    """Draw the pictures that the network does worst on."""

    pictures: Path
    """Folder of shards that were not trained on."""
    output: Path
    """The sheet, a JPEG file."""
    weights: Path | None = None
    """The ONNX file (default: the builtin one)."""
    count: int = 10

    def run(self) -> None:
        """Draw and say what was drawn."""
        from kronc_ns.training.worst import worst_pictures

        print(worst_pictures(self.weights, self.pictures, self.output, self.count))


Command = (
    Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
    | Annotated[Worst, tyro.conf.subcommand("worst")]
)

if __name__ == "__main__":
    try:
        tyro.cli(Command, prog="python -m kronc_ns.training", description=__doc__).run()
    except KroncError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
