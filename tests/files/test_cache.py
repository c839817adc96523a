"""Solutions are kept by the content of what was solved, beside nobody's data."""

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.files import cache
from kronc_ns.files.cache import cache_folder, fingerprint, solve_cached
from kronc_ns.files.output import claim_output
from kronc_ns.files.record import read_record, read_solution, write_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.fit.options import KroncConfig
from tests.files.conftest import listing

DEFAULTS = KroncConfig()


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("KRONC_NS_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(autouse=True)
def solves(monkeypatch, solution) -> list[KroncConfig]:
    """What was solved; it takes no time and the solution is known."""
    calls: list[KroncConfig] = []

    def solve(scene, config, progress):
        calls.append(config)
        return solution

    monkeypatch.setattr(cache, "solve_scene", solve)
    return calls


def test_the_folder_is_the_users(monkeypatch, place):
    assert cache_folder() == place
    monkeypatch.delenv("KRONC_NS_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "/somewhere")
    assert cache_folder() == Path("/somewhere/kronc_ns")
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder() == Path.home() / ".cache/kronc_ns"


def test_inputs_are_the_fingerprint_of_what_was_solved(solved, walk_folder, scene, solution):
    write_solution(solved, scene, solution, walk_folder, fingerprint(scene, DEFAULTS))
    assert read_record(solved)["inputs"] == fingerprint(load_scene(walk_folder), DEFAULTS)


def test_the_fingerprint_knows_what_the_solution_depends_on(scene, walk_capture):
    known = fingerprint(scene, DEFAULTS)
    moved = scene.keypoints.copy()
    moved[0, 0, 0] += 1e-3
    names = scene.schema.keypoints[::-1]  # another order under the same name
    others = [
        (replace(scene, keypoints=moved), DEFAULTS),
        (replace(scene, schema=replace(scene.schema, keypoints=names)), DEFAULTS),
        (replace(scene, camera=replace(scene.camera, fx=500.0)), DEFAULTS),
        (replace(scene, given_c2w=walk_capture.c2w), DEFAULTS),
        (scene, replace(DEFAULTS, seed=1)),
    ]
    prints = [fingerprint(*other) for other in others]
    assert len({known, *prints}) == 1 + len(others)


def test_the_fingerprint_knows_no_paths_and_nothing_that_has_no_say(scene, walk_capture):
    elsewhere = replace(scene, names=tuple(f"../other/{Path(name).name}" for name in scene.names))
    assert fingerprint(elsewhere, DEFAULTS) == fingerprint(scene, DEFAULTS)
    assert fingerprint(scene, replace(DEFAULTS, device="cpu")) == fingerprint(scene, DEFAULTS)
    circular = replace(DEFAULTS, init="circular")
    assert fingerprint(replace(scene, given_c2w=walk_capture.c2w), circular) == fingerprint(scene, circular)
    depths = replace(scene, given_depths=np.ones(scene.seen.shape))
    assert fingerprint(depths, DEFAULTS) == fingerprint(scene, DEFAULTS)


def test_a_scene_is_solved_once(walk_folder, scene, solution, solves, place):
    before = listing(walk_folder)
    folder = solve_cached(walk_folder, scene, DEFAULTS, None)
    assert folder.parent == place
    assert solve_cached(walk_folder, scene, DEFAULTS, None) == folder
    assert solves == [DEFAULTS]
    np.testing.assert_allclose(read_solution(folder)[1].c2w, solution.c2w, atol=1e-9)
    assert listing(walk_folder) == before


def test_other_options_have_another_place(walk_folder, scene, solves):
    options = [DEFAULTS, replace(DEFAULTS, seed=1)]
    first, second = (solve_cached(walk_folder, scene, config, None) for config in options)
    assert first != second
    assert solves == options


def spoil(text: str, file: str = "kronc.json") -> Callable[[Path], object]:
    return lambda folder: (folder / file).write_text(text)


SPOILT = [spoil("{"), spoil("[]"), spoil('{"inputs": "of something else"}'), claim_output]
SPOILT += [spoil(text, file) for text in ("null", "[") for file in ("transforms.json", "keypoints.json")]


@pytest.mark.parametrize("spoilt", SPOILT)
def test_what_is_broken_or_was_interrupted_is_made_anew(walk_folder, scene, solves, spoilt):
    folder = solve_cached(walk_folder, scene, DEFAULTS, None)
    spoilt(folder)
    assert solve_cached(walk_folder, scene, DEFAULTS, None) == folder
    assert len(solves) == 2
    assert read_record(folder)["inputs"] == fingerprint(scene, DEFAULTS)


def test_a_cache_that_cannot_be_written_is_named(walk_folder, scene, place):
    place.write_text("a file where the folder belongs")
    with pytest.raises(KroncError, match=f"{place}{os.sep}.* cannot be written"):
        solve_cached(walk_folder, scene, DEFAULTS, None)
