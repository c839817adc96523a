"""What every task of a fleet has in common: where from, where to, and how."""

import hashlib
import json
import shlex
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import kronc_ns
from kronc_ns.capture.detection.choice import DetectorOptions
from kronc_ns.capture.detection.model import file_sha256
from kronc_ns.commands.options import SolverOptions
from kronc_ns.errors import KroncError
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fleet.options import FleetOptions
from kronc_ns.fleet.storage import Place

_SHIPPED = ("config", "camera", "keypoint_names")
"""Options whose (small) files go along to the nodes."""
_WEIGHTS = ("detector_weights", "detector_python", "segmenter_weights", "depth_weights")
"""Options whose files have to be on every node."""
_OF_THE_RUN = ("cpus", "gpus", "memory_gb", "scratch", "scratch_gb", "time_limit_min", "retries", "device")
"""Options that change no result."""


@dataclass(frozen=True)
class Job:
    """How the captures of a fleet are done; goes to every worker."""

    captures: Place
    output: Place
    options: FleetOptions
    config: KroncConfig
    """How scenes are solved."""
    salt: str
    """Hash of all options that change a result, and of the version."""
    files: Mapping[str, tuple[str, bytes]] = field(default_factory=dict)
    """Name and content of the files that options name."""
    command: tuple[str, ...] = ()
    """The command line, for the record in each result."""
    version: str = kronc_ns.__version__
    resumes: bool = False
    """Whether results may be there already."""

    def local_options(self, folder: Path) -> FleetOptions:
        """The options on a node, whose files are laid into ``folder``."""
        paths: dict[str, Any] = {}
        for option, (name, content) in self.files.items():
            file = folder / option / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(content)
            paths[option] = file if option == "camera" else str(file)
        return replace(self.options, **paths)


def make_job(
    captures: Place, output: Place, options: FleetOptions, resumes: bool = False, command: tuple[str, ...] | None = None
) -> Job:
    """Check the options and read the files they name; raises `KroncError` for what is wrong with them."""
    options.check()
    config = options.solver_config()
    files = {}
    for option in _SHIPPED:
        path = Path(str(getattr(options, option) or ""))
        if path.is_file():
            files[option] = (path.name, path.read_bytes())
        elif option == "camera" and options.camera is not None:
            raise KroncError(f"--camera {path} does not exist: expected a JSON file with intrinsics")
    if options.detection.detector == "none" and options.detection.detector_weights is None:
        options = replace(options, detection=DetectorOptions("none"))
    for option, path in _weights(options).items():
        if path.suffix and not path.exists():
            raise KroncError(f"--{option.replace('_', '-')} {path} does not exist: expected it here and on every node")
    return Job(
        captures,
        output,
        options,
        config,
        _salt(options, config, files),
        files,
        tuple(sys.argv if command is None else command),
        resumes=resumes,
    )


def missing_on_this_node(job: Job) -> list[str]:
    """Files that the options name and this machine lacks."""
    return [str(path) for path in _weights(job.options).values() if path.suffix and not path.exists()]


def described(job: Job) -> dict[str, Any]:
    """What fleet.json in the output says of the job."""
    return {
        "kind": "fleet",
        "version": job.version,
        "captures": job.captures.url,
        "options": job.salt,
        "command": shlex.join(job.command),
    }


def _weights(options: FleetOptions) -> dict[str, Path]:
    """Of the options that name files which do not go along."""
    given = {**asdict(options.detection), **{f.name: getattr(options, f.name) for f in fields(options)}}
    return {name: Path(given[name]) for name in _WEIGHTS if given.get(name) is not None}


def _salt(options: FleetOptions, config: KroncConfig, files: Mapping[str, tuple[str, bytes]]) -> str:
    solver = {f.name for f in fields(SolverOptions)}  # what they come to is in `config`
    own = {f.name: getattr(options, f.name) for f in fields(options) if f.name not in {*solver, *_OF_THE_RUN, *files}}
    own["detection"] = asdict(options.detection)
    settings = {**asdict(config), "device": None}
    weights = {name: file_sha256(path) for name, path in _weights(options).items() if path.is_file()}
    shipped = {name: hashlib.sha256(content).hexdigest() for name, (_, content) in files.items() if name != "config"}
    whole = json.dumps([kronc_ns.__version__, own, settings, weights, shipped], sort_keys=True, default=str)
    return hashlib.sha256(whole.encode()).hexdigest()
