"""Solutions on disk: what is written is what is read, and nobody's data is touched."""

import errno
import json
import math
import os
import zlib  # noqa: F401 - before pycolmap, which aborts the process otherwise
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from kronc_ns.errors import KroncError
from kronc_ns.files.cache import fingerprint
from kronc_ns.files.colmap import write_colmap
from kronc_ns.files.output import MARKER, claim_output, release_output
from kronc_ns.files.ply import write_ply
from kronc_ns.files.record import write_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.files.transforms import read_poses
from kronc_ns.fit.options import KroncConfig
from kronc_ns.geometry.camera import project
from kronc_ns.geometry.poses import invert, transform
from kronc_ns.solution import Solution, Status, ViewReport, ViewStatus

FAILED_VIEW = 5


@pytest.fixture
def scene(walk_folder):
    return load_scene(walk_folder)


@pytest.fixture
def solution(scene, walk_capture) -> Solution:
    """The true poses as a solution in which one view failed and one keypoint is unknown."""
    points = torch.from_numpy(walk_capture.car.keypoints).clone()
    points[3] = torch.nan
    c2w = walk_capture.c2w.clone()
    c2w[FAILED_VIEW] = torch.nan
    views = [ViewReport(name, ViewStatus.SOLVED, 20, 18, 0.7) for name in scene.names]
    views[FAILED_VIEW] = ViewReport(scene.names[FAILED_VIEW], ViewStatus.FAILED, 3, 0, None, reason="3 keypoints")
    depths = transform(invert(c2w), points.expand(16, -1, -1))[..., 2]
    return Solution(
        status=Status.CONVERGED,
        reason="all is well",
        names=scene.names,
        camera=scene.camera,
        c2w=c2w,
        points=points,
        depths=depths,
        views=tuple(views),
        initial_c2w=walk_capture.c2w,
        solver="adam",
        init="circular",
        iterations=10,
        seconds=1.0,
        rmse_px=0.7,
        median_px=0.6,
        history={"step": [1.0], "loss": [2.0]},
    )


@pytest.fixture
def solved(tmp_path, walk_folder, scene, solution):
    """The solution written to a folder."""
    folder = tmp_path / "out"
    claim_output(folder)
    write_solution(folder, scene, solution, walk_folder, "abc")
    return folder


def kept(solution):
    return [i for i in range(len(solution.names)) if i != FAILED_VIEW]


def test_poses_come_back_as_they_were_without_failed_views(solved, solution):
    poses = read_poses(solved / "transforms.json")
    assert [name.split("/")[-1] for name in poses] == [solution.names[i].split("/")[-1] for i in kept(solution)]
    torch.testing.assert_close(torch.stack(list(poses.values())), solution.c2w[kept(solution)], atol=1e-12, rtol=0)


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
    torch.testing.assert_close(again.keypoints, scene.keypoints[[i for i in range(16) if i != FAILED_VIEW]])
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
    known = solution.points[solution.points.isfinite().all(-1)]
    cloud = trimesh.load(solved / "keypoints.ply")
    np.testing.assert_allclose(cloud.vertices, known, atol=1e-6)
    assert json.loads((solved / "transforms.json").read_text())["ply_file_path"] == "keypoints.ply"


# ---- whose folder


def listing(folder):
    return {path.relative_to(folder): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize("name", ["photo.jpg", "transforms.json", "images/a.png"])
def test_foreign_data_is_refused_and_stays(tmp_path, name):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("mine")
    before = listing(tmp_path)
    with pytest.raises(KroncError, match="choose a new or empty folder"):
        claim_output(tmp_path)
    assert listing(tmp_path) == before


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / "out").write_text("mine")
    with pytest.raises(KroncError, match="is a file"):
        claim_output(tmp_path / "out")
    assert (tmp_path / "out").read_text() == "mine"


def test_new_empty_and_own_folders_are_claimed(tmp_path):
    claim_output(tmp_path / "a" / "new")
    assert listing(tmp_path / "a" / "new").keys() == {(tmp_path / MARKER).relative_to(tmp_path)}
    (tmp_path / "empty").mkdir()
    claim_output(tmp_path / "empty")
    claim_output(tmp_path / "empty")  # holds the marker of an interrupted run
    release_output(tmp_path / "empty")
    assert not any((tmp_path / "empty").iterdir())


def test_a_finished_result_is_taken_back_before_it_is_written_over(solved):
    claim_output(solved)
    assert (solved / MARKER).exists()
    assert not (solved / "kronc.json").exists()


def test_results_of_another_kind_are_not_replaced(solved, tmp_path):
    """Rendering a capture, or solving another, must not take a data set with its detections."""
    before = listing(solved)
    with pytest.raises(KroncError, match="holds a solution, which is not for a capture to replace"):
        claim_output(solved, "capture")
    assert listing(solved) == before
    claim_output(tmp_path / "data", "data set")
    for other in ("solution", "capture"):
        with pytest.raises(KroncError, match="holds a data set"):
            claim_output(tmp_path / "data", other)
    claim_output(tmp_path / "data", "data set")


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(KroncError, match="out cannot be written"):
        claim_output(tmp_path / "file" / "out")


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


def test_inputs_are_the_fingerprint_of_what_was_solved(tmp_path, walk_folder, scene, solution):
    claim_output(tmp_path / "out")
    write_solution(tmp_path / "out", scene, solution, walk_folder, fingerprint(scene, KroncConfig()))
    again = load_scene(walk_folder)
    assert json.loads((tmp_path / "out/kronc.json").read_text())["inputs"] == fingerprint(again, KroncConfig())


# ---- other formats


@pytest.fixture
def model(solved, tmp_path):
    import pycolmap

    assert write_colmap(tmp_path / "colmap", solved) == 15
    return pycolmap.Reconstruction(str(tmp_path / "colmap"))


def test_a_colmap_model_needs_file_names_of_their_own(solved, edit, tmp_path):
    edit(solved / "transforms.json", lambda c: [f.update(file_path=f"{i}/a.png") for i, f in enumerate(c["frames"])])
    with pytest.raises(KroncError, match=r"15 images in different folders are called a\.png"):
        write_colmap(tmp_path / "colmap", solved)


def test_colmap_camera_images_and_poses(model, solution):
    (camera,) = model.cameras.values()
    ours = solution.camera
    assert camera.model.name == "OPENCV"
    assert (camera.width, camera.height) == (ours.width, ours.height)
    np.testing.assert_allclose(camera.params, [ours.fx, ours.fy, ours.cx, ours.cy, *ours.distortion])
    images = {image.name: image for image in model.images.values()}
    assert sorted(images) == [solution.names[i].split("/")[-1] for i in kept(solution)]
    for i in kept(solution):
        w2c = images[solution.names[i].split("/")[-1]].cam_from_world().matrix()
        np.testing.assert_allclose(w2c, invert(solution.c2w[i]).numpy(), atol=1e-9)


def test_colmap_projects_as_we_do(model, solution):
    images = {image.name: image for image in model.images.values()}
    for i in kept(solution)[::4]:
        pixels = project(transform(invert(solution.c2w[i]), solution.points), solution.camera)
        for j in (0, 10, 40, 65):
            theirs = images[solution.names[i].split("/")[-1]].project_point(solution.points[j].numpy())
            np.testing.assert_allclose(theirs, pixels[j].numpy(), atol=1e-6)


def test_colmap_holds_the_keypoints(model, solution):
    known = solution.points[solution.points.isfinite().all(-1)].numpy()
    theirs = np.array([model.points3D[k].xyz for k in sorted(model.points3D)])
    np.testing.assert_allclose(theirs, known, atol=1e-12)


def test_ply_holds_camera_centres_and_keypoints(solved, solution, tmp_path):
    count = write_ply(tmp_path / "new" / "cameras.ply", solved)
    cloud = trimesh.load(tmp_path / "new" / "cameras.ply")
    centres = solution.c2w[kept(solution), :, 3]
    known = solution.points[solution.points.isfinite().all(-1)]
    assert count == len(cloud.vertices) == 15 + 65
    np.testing.assert_allclose(cloud.vertices, torch.cat([centres, known]), atol=1e-5)
    blue, red = cloud.colors[:15], cloud.colors[15:]
    assert (blue[:, 2] > blue[:, 0]).all()
    assert (red[:, 0] > red[:, 2]).all()
