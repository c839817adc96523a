"""The `kronc` command."""

import gc
from typing import Annotated

import tyro

from kronc_ns.commands.bench import Bench
from kronc_ns.commands.console import exit_on_error
from kronc_ns.commands.convert_detector import ConvertDetector
from kronc_ns.commands.detect import Detect
from kronc_ns.commands.eval import Eval
from kronc_ns.commands.export import Export
from kronc_ns.commands.fleet import Fleet
from kronc_ns.commands.import_data import Import
from kronc_ns.commands.refine import Refine
from kronc_ns.commands.report import Report
from kronc_ns.commands.solve import Solve
from kronc_ns.commands.synth import Synth
from kronc_ns.commands.view import View

Command = (
    Annotated[Solve, tyro.conf.subcommand("solve")]
    | Annotated[Refine, tyro.conf.subcommand("refine")]
    | Annotated[Detect, tyro.conf.subcommand("detect")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
    | Annotated[Fleet, tyro.conf.subcommand("fleet")]
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
    gc.set_threshold(100_000)  # while modules load, to look for garbage at every 700 objects is a tenth of a solve
    command = tyro.cli(
        Command, prog="kronc", description="Camera poses of a walk around a car from semantic keypoints."
    )
    with exit_on_error():
        raise SystemExit(command.run())


if __name__ == "__main__":
    main()
