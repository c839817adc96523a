"""Solutions on disk: what is written is what is read, and an interrupted write is no result."""

import errno
import json
import math
import os
from dataclasses import replace
from importlib.metadata import version

import numpy as np
import pytest
import trimesh

from kronc_ns.errors import KroncError
from kronc_ns.files.output import MARKER, claim_output
from kronc_ns.files.record import left_out_views, read_solution, solved_points, write_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.files.transforms import read_poses
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.fit.verdict import inliers
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution, Status, ViewStatus
from kronc_ns.synthetic.variations import swap_sides
from tests.conftest import scene_of
from tests.files.conftest import FAILED_VIEW, KEPT


def test_poses_come_back_as_they_were_without_failed_views(solved, solution):
    poses = read_poses(solved / "transforms.json")
    assert [name.split("/")[-1] for name in poses] == [solution.names[i].split("/")[-1] for i in KEPT]
    np.testing.assert_allclose(list(poses.values()), solution.c2w[KEPT], atol=1e-12)


def test_images_are_found_from_the_output_folder(solved, walk_folder, scene):
    for name in scene.names:
        (walk_folder / name).parent.mkdir(exist_ok=True)
        (walk_folder / name).touch()
    for frame in json.loads((solved / "transforms.json").read_text())["frames"]:
        assert (solved / frame["file_path"]).resolve().parent == (walk_folder / "images").resolve()
        assert (solved / frame["file_path"]).is_file()


def test_a_solution_is_a_scene_again_whose_poses_are_no_start(solved, walk_folder, scene):
    """Camera and keypoints of the solved views as before; a solution's poses are never taken for given ones."""
    content = json.loads((walk_folder / "keypoints.json").read_text())
    del content["frames"][FAILED_VIEW]
    (solved / "keypoints.json").write_text(json.dumps(content))
    again = load_scene(solved)
    assert again.camera == scene.camera
    np.testing.assert_array_equal(again.keypoints, scene.keypoints[KEPT])
    assert again.given_c2w is None


def test_distortion_is_written(tmp_path, walk_folder, scene, solution):
    bent = replace(scene.camera, k1=-0.1, k2=0.01, p1=0.002, p2=-0.003)
    claim_output(tmp_path / "out")
    write_solution(tmp_path / "out", scene, replace(solution, camera=bent), walk_folder, "abc")
    content = json.loads((tmp_path / "out/transforms.json").read_text())
    assert [content[key] for key in ("k1", "k2", "p1", "p2")] == [-0.1, 0.01, 0.002, -0.003]


def test_the_report_names_every_view_and_holds_no_nan(solved, solution):
    def refuse(token):
        raise AssertionError(f"{token} is no JSON")

    report = json.loads((solved / "kronc.json").read_text(), parse_constant=refuse)
    assert (report["status"], report["solver"], report["inputs"]) == ("converged", "adam", "abc")
    assert [view["file_path"] for view in report["views"]] == list(solution.names)
    assert report["views"][FAILED_VIEW]["status"] == "failed"
    assert report["views"][FAILED_VIEW]["rmse_px"] is None
    assert report["views"][0] == {
        "file_path": solution.names[0],
        "status": "solved",
        "visible": 20,
        "inliers": 18,
        "rmse_px": 0.7,
        "sigma_rot_deg": None,
        "sigma_trans_m": None,
        "reason": "",
        "swapped": False,
    }
    assert report["points"][3] == [None] * 3
    np.testing.assert_allclose(report["points"][4], solution.points[4])


def test_a_loss_that_was_not_finite_is_null(tmp_path, walk_folder, scene, solution):
    wild = replace(solution, history={"step": [1.0, 2.0], "loss": [5.0, math.nan]}, rmse_px=math.nan)
    claim_output(tmp_path / "out")
    write_solution(tmp_path / "out", scene, wild, walk_folder, "abc")
    report = json.loads((tmp_path / "out/kronc.json").read_text())
    assert (report["history"]["loss"], report["rmse_px"]) == ([5.0, None], None)


def test_the_keypoint_cloud_holds_the_known_points(solved, solution):
    known = solution.points[np.isfinite(solution.points).all(-1)]
    cloud = trimesh.load(solved / "keypoints.ply")
    np.testing.assert_allclose(cloud.vertices, known, atol=1e-6)
    assert json.loads((solved / "transforms.json").read_text())["ply_file_path"] == "keypoints.ply"


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))])
@pytest.mark.parametrize("file", ["keypoints.ply", "transforms.json", "keypoints.json", "kronc.json"])
def test_an_interrupted_write_is_marked_and_the_next_one_works(
    solved, walk_folder, scene, solution, monkeypatch, file, error
):
    replace_file = os.replace

    def interrupted(source, target):
        if str(target).endswith(file):
            raise error
        replace_file(source, target)

    claim_output(solved)
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", interrupted)
        with pytest.raises((KeyboardInterrupt, KroncError)):
            write_solution(solved, scene, solution, walk_folder, "abc")
    assert (solved / MARKER).exists()
    assert not (solved / "kronc.json").exists()
    claim_output(solved)
    write_solution(solved, scene, solution, walk_folder, "abc")
    assert sorted(os.listdir(solved)) == ["keypoints.json", "keypoints.ply", "kronc.json", "transforms.json"]


# ---- read back


def written(folder, scene: Scene, solution: Solution):
    claim_output(folder)
    write_solution(folder, scene, solution, folder.parent / "scene", "abc")
    return folder


@pytest.fixture(scope="module")
def swapped_lap(lap) -> tuple[Scene, Solution]:
    """A walk with confused sides in some views and two views without keypoints, solved."""
    capture, _ = swap_sides(lap, 0.2, np.random.default_rng(1))
    keypoints = capture.keypoints.copy()
    keypoints[[4, 9], :, 2] = 0
    scene = scene_of(replace(capture, keypoints=keypoints))
    return scene, solve_scene(scene, KroncConfig())


def test_what_is_read_is_what_was_solved(tmp_path, swapped_lap):
    scene, solution = swapped_lap
    again_scene, again = read_solution(written(tmp_path / "out", scene, solution))
    for name in ("c2w", "points", "initial_c2w", "path"):
        np.testing.assert_allclose(getattr(again, name), getattr(solution, name), atol=1e-5)
    straight = [i for i, view in enumerate(solution.views) if not view.swapped]
    np.testing.assert_allclose(again.depths[straight], solution.depths[straight], atol=1e-9)
    same = {
        name: getattr(solution, name)
        for name in ("status", "reason", "camera", "views", "solver", "init", "iterations", "rmse_px", "median_px")
    }
    assert {name: getattr(again, name) for name in same} == same
    assert {key: list(values) for key, values in again.history.items()} == dict(solution.history)
    assert again.names == again_scene.names == tuple(f"../scene/{name}" for name in scene.names)


def test_paths_that_were_rewritten_since_are_told_by_file_name(tmp_path, swapped_lap, edit):
    scene, solution = swapped_lap
    folder = written(tmp_path, scene, solution)

    def move(content):
        for frame in content["frames"]:
            frame["file_path"] = f"/elsewhere/{frame['file_path'].split('/')[-1]}"

    edit(folder / "transforms.json", move)
    _, again = read_solution(folder)
    np.testing.assert_allclose(again.c2w, solution.c2w, atol=1e-12)
    posed = [name for name, there in zip(again.names, again.posed, strict=True) if there]
    assert all(name.startswith("/elsewhere/") for name in posed)


def test_a_loss_that_was_not_finite_is_read_as_that(tmp_path, swapped_lap):
    scene, solution = swapped_lap
    history = {"step": [1.0, 2.0], "loss": [math.inf, 3.0]}
    _, again = read_solution(written(tmp_path, scene, replace(solution, history=history)))
    np.testing.assert_array_equal(again.history["loss"], [math.nan, 3.0])


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
        c2w=np.full_like(solution.c2w, np.nan),
        initial_c2w=np.full_like(solution.c2w, np.nan),
    )
    _, again = read_solution(written(tmp_path / "out", scene, nothing))
    assert again.status is Status.FAILED
    assert np.isnan(again.c2w).all()
    assert again.camera == solution.camera


def test_images_of_equal_file_name_are_told_apart(tmp_path, swapped_lap):
    scene, solution = swapped_lap
    names = tuple(f"{'ab'[i % 2]}/{i // 2}.png" for i in range(len(scene)))
    views = tuple(replace(view, name=name) for view, name in zip(solution.views, names, strict=True))
    renamed = replace(scene, names=names), replace(solution, names=names, views=views)
    again_scene, again = read_solution(written(tmp_path / "out", *renamed))
    np.testing.assert_allclose(again.c2w, solution.c2w, atol=1e-9)
    np.testing.assert_array_equal(again_scene.seen.sum(1), scene.seen.sum(1))


def test_a_solved_folder_can_be_solved_again_from_its_own_files(tmp_path, swapped_lap):
    scene, solution = swapped_lap
    again = load_scene(written(tmp_path / "out", scene, solution))
    seen = scene.seen[solution.posed]
    np.testing.assert_array_equal(again.seen, seen)
    np.testing.assert_allclose(again.uv[seen], scene.uv[solution.posed][seen], atol=1e-3)


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
    assert record["versions"]["torch"] == version("torch")


def test_points_and_left_out_views_are_told_without_the_rest(solved, solution):
    known = solution.points[np.isfinite(solution.points).all(-1)]
    np.testing.assert_allclose(solved_points(solved), known, atol=1e-12)
    assert left_out_views(solved) == {solution.names[FAILED_VIEW].split("/")[-1]}


@pytest.mark.parametrize(("read", "key"), [(solved_points, "points"), (left_out_views, "views")])
def test_a_record_that_lacks_them_is_named(solved, edit, read, key):
    edit(solved / "kronc.json", lambda record: record.pop(key))
    with pytest.raises(KroncError, match=rf'kronc.json: expected "{key}", as .* writes them: solve again'):
        read(solved)
