"""What is kept between runs, keyed by the content of what was solved; the user's own folder is never written."""

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path, PurePosixPath

import numpy as np

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import describe_schema
from kronc_ns.files.output import claim_output
from kronc_ns.files.record import read_record, read_solution, write_solution
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import Progress, solve_scene
from kronc_ns.refine.options import RefineConfig
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status

Refinement = tuple[RefineConfig, Callable[[Solution], Solution]]
"""How solutions are refined by image features, and what does it."""
_FORMAT = 9  # raised whenever the same input and options give another solution


def cache_folder() -> Path:
    """``$KRONC_NS_CACHE``, else the user's cache folder."""
    chosen = os.environ.get("KRONC_NS_CACHE")
    return Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "kronc_ns"


def fingerprint(
    scene: Scene, config: KroncConfig, refine: RefineConfig | None = None, folder: Path | None = None
) -> str:
    """Hash of everything the solution of a scene depends on: contents, options and version, but no paths.

    With ``refine`` also of the images in ``folder``, and their masks.
    """
    settings = {**asdict(config), "device": None}
    given = scene.given_c2w if config.init in ("auto", "given") else None
    depths = scene.given_depths if config.depth_init != "random" else None
    names = [PurePosixPath(name).name for name in scene.names]
    cameras = [asdict(scene.camera), *(map(asdict, scene.lenses.each) if scene.lenses else ())]
    header = json.dumps([_FORMAT, names, cameras, describe_schema(scene.schema), settings], sort_keys=True)
    digest = hashlib.sha256(header.encode())
    for array in (scene.keypoints, scene.sigma_px, given, depths):
        digest.update(b"-" if array is None else np.ascontiguousarray(array, dtype=np.float64).tobytes())
    if refine is not None and folder is not None:
        digest.update(json.dumps(asdict(refine)).encode())
        for name in (*scene.names, *(scene.masks or ())):
            digest.update(hashlib.blake2b(_content(folder / name)).digest())
    return digest.hexdigest()


def solve_cached(
    data: Path,
    scene: Scene,
    config: KroncConfig,
    progress: Progress | None,
    refine: Refinement | None = None,
) -> Path:
    """Folder with the solution of a scene that was read from ``data``: the cached one, else solved now.

    A cache that cannot be written is an error.
    """
    inputs = fingerprint(scene, config, refine[0], data) if refine else fingerprint(scene, config)
    folder = cache_folder() / inputs[:32]
    if not _holds(folder, inputs):
        solution = solve_scene(scene, config, progress)
        if refine is not None and solution.status is not Status.FAILED:
            solution = refine[1](solution)
        claim_output(folder)
        write_solution(folder, scene, solution, data, inputs)
    return folder


def _content(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise KroncError(f"{file} cannot be read: {error.strerror}") from None


def _holds(folder: Path, inputs: str) -> bool:
    """Whether the cached solution is of these inputs; one that cannot be read is made anew."""
    try:
        if read_record(folder).get("inputs") != inputs:
            return False
        read_solution(folder)
        return True
    except KroncError:
        return False
