"""A solved folder read back is what was solved."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from kronc_ns.errors import KroncError
from kronc_ns.files.output import claim_output
from kronc_ns.files.record import read_solution, write_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.fit.verdict import inliers
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status, ViewStatus
from kronc_ns.synthetic.variations import swap_sides
from tests.conftest import scene_of


def written(folder, scene: Scene, solution: Solution):
    claim_output(folder)
    write_solution(folder, scene, solution, folder.parent / "scene", "abc")
    return folder


@pytest.fixture(scope="module")
def swapped_lap(lap) -> tuple[Scene, Solution]:
    """A walk with confused sides in some views and two views without keypoints, solved."""
    capture, _ = swap_sides(lap, 0.2, np.random.default_rng(1))
    keypoints = capture.keypoints.clone()
    keypoints[[4, 9], :, 2] = 0
    scene = scene_of(replace(capture, keypoints=keypoints))
    return scene, solve_scene(scene, KroncConfig())


def test_what_is_read_is_what_was_solved(tmp_path, swapped_lap):
    scene, solution = swapped_lap
    again_scene, again = read_solution(written(tmp_path / "out", scene, solution))
    for name in ("c2w", "points", "initial_c2w", "path"):
        torch.testing.assert_close(getattr(again, name), getattr(solution, name), atol=1e-5, rtol=0, equal_nan=True)
    straight = [i for i, view in enumerate(solution.views) if not view.swapped]
    torch.testing.assert_close(again.depths[straight], solution.depths[straight], atol=1e-9, rtol=0, equal_nan=True)
    same = {
        name: getattr(solution, name)
        for name in ("status", "reason", "camera", "views", "solver", "init", "iterations", "rmse_px", "median_px")
    }
    assert {name: getattr(again, name) for name in same} == same
    assert {key: list(values) for key, values in again.history.items()} == dict(solution.history)
    assert again.names == again_scene.names == tuple(f"../scene/{name}" for name in scene.names)


def test_detections_come_back_with_left_and_right_put_right(tmp_path, swapped_lap):
    """Then the solved points explain them as well as the solver said, view by view."""
    scene, solution = swapped_lap
    assert any(view.swapped for view in solution.views)
    _, inlier = inliers(*read_solution(written(tmp_path / "out", scene, solution)))
    solved = [i for i, view in enumerate(solution.views) if view.status is ViewStatus.SOLVED]
    assert inlier.sum(1)[solved].tolist() == [solution.views[i].inliers for i in solved]


def test_a_failed_solution_without_any_pose_is_read(tmp_path, swapped_lap):
    scene, solution = swapped_lap
    lost = tuple(replace(view, status=ViewStatus.FAILED) for view in solution.views)
    nothing = replace(
        solution,
        status=Status.FAILED,
        views=lost,
        c2w=torch.full_like(solution.c2w, torch.nan),
        initial_c2w=torch.full_like(solution.c2w, torch.nan),
    )
    _, again = read_solution(written(tmp_path / "out", scene, nothing))
    assert again.status is Status.FAILED
    assert again.c2w.isnan().all()
    assert again.camera == solution.camera


def test_images_of_equal_file_name_are_told_apart(tmp_path, swapped_lap):
    scene, solution = swapped_lap
    names = tuple(f"{'ab'[i % 2]}/{i // 2}.png" for i in range(len(scene)))
    views = tuple(replace(view, name=name) for view, name in zip(solution.views, names, strict=True))
    renamed = replace(scene, names=names), replace(solution, names=names, views=views)
    again_scene, again = read_solution(written(tmp_path / "out", *renamed))
    torch.testing.assert_close(again.c2w, solution.c2w, atol=1e-9, rtol=0, equal_nan=True)
    torch.testing.assert_close(again_scene.visibility.sum(1), scene.visibility.sum(1))


def test_a_solved_folder_can_be_solved_again_from_its_own_files(tmp_path, swapped_lap):
    scene, solution = swapped_lap
    again = load_scene(written(tmp_path / "out", scene, solution))
    posed = [i for i, known in enumerate(solution.solved) if known]
    seen = scene.visibility[posed]
    torch.testing.assert_close(again.visibility, seen)
    torch.testing.assert_close(again.uv * seen[..., None], scene.uv[posed] * seen[..., None], atol=1e-3, rtol=0)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda record: record.pop("history"), "history"),
        (lambda record: record["views"][0].update(status="perhaps"), "perhaps"),
        (lambda record: record["views"][0].pop("file_path"), "file_path"),
        (lambda record: record.update(views=3), "not as `kronc solve` writes it"),
        (lambda record: record["points"].pop(), "65 points"),
    ],
)
def test_a_broken_record_is_named(tmp_path, swapped_lap, edit, change, says):
    folder = written(tmp_path / "out", *swapped_lap)
    edit(folder / "kronc.json", change)
    with pytest.raises(KroncError, match=says) as caught:
        read_solution(folder)
    assert "kronc.json" in str(caught.value)
    assert "solve again" in str(caught.value)


def test_a_folder_that_is_not_solved_is_named(tmp_path):
    with pytest.raises(KroncError, match=r"kronc.json does not exist: expected a folder solved by"):
        read_solution(tmp_path)
    (tmp_path / "kronc.json").write_text("[]")
    with pytest.raises(KroncError, match="expected an object"):
        read_solution(tmp_path)


def test_the_record_says_how_it_was_made(tmp_path, swapped_lap, monkeypatch):
    monkeypatch.setattr("sys.argv", ["/somewhere/bin/kronc", "solve", "--data", "a b"])
    record = json.loads((written(tmp_path / "out", *swapped_lap) / "kronc.json").read_text())
    assert record["command"] == "kronc solve --data 'a b'"
    assert record["versions"]["torch"] == torch.__version__.split("+")[0]
