"""Folders of a capture by several cameras: read, solved, written, read again, and as other programs read them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.files.cache import fingerprint
from kronc_ns.files.colmap import write_colmap
from kronc_ns.files.keypoints import write_keypoints
from kronc_ns.files.output import claim_output, write_json
from kronc_ns.files.record import read_solution, write_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.files.transforms import camera_and_frames, transforms_dict
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.geometry.camera import Camera, Lenses
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.synthetic.scenes import make_capture

WIDE, TALL = Camera(400.0, 400.0, 240.0, 135.0, 480, 270), Camera(900.0, 900.0, 300.0, 400.0, 600, 800)
IS_TALL = np.arange(20) % 3 == 1
LENSES = Lenses.of([TALL if is_tall else WIDE for is_tall in IS_TALL])


@pytest.fixture(scope="module")
def capture():
    """The walk as the wide camera took it, its tall views as the tall one did."""
    wide, tall = (make_capture("walk", views=20, seed=3, noise_px=0.5, camera=camera) for camera in (WIDE, TALL))
    keypoints = np.where(IS_TALL[:, None, None], tall.keypoints, wide.keypoints)
    assert np.array_equal(wide.c2w, tall.c2w)
    return replace(wide, keypoints=keypoints)


@pytest.fixture
def folder(tmp_path, capture) -> Path:
    folder = tmp_path / "two"
    claim_output(folder)
    names = [f"images/{i:02d}.png" for i in range(20)]
    write_json(folder / "transforms.json", transforms_dict(WIDE, names, None, lenses=LENSES))
    rows = dict(zip(names, capture.keypoints, strict=True))
    write_keypoints(folder / "keypoints.json", APOLLOCAR3D_66, None, rows)
    return folder


def test_every_frame_has_its_own_camera(folder):
    scene = load_scene(folder)
    assert scene.lenses is not None
    assert scene.lenses.each == LENSES.each
    assert scene.camera == WIDE, "of most views"
    content = json.loads((folder / "transforms.json").read_text())
    assert "fl_x" not in content, "nerfstudio would take it for all"
    assert {(frame["fl_x"], frame["w"], frame["h"]) for frame in content["frames"]} == {
        (400, 480, 270),
        (900, 600, 800),
    }


def test_a_solution_keeps_the_cameras_also_of_views_that_failed(folder, edit, tmp_path, capture):
    def without_the_first(content):
        content["frames"] = content["frames"][1:]

    edit(folder / "keypoints.json", without_the_first)
    scene = load_scene(folder)
    solution = solve_scene(scene, KroncConfig(min_status="solved"))
    assert not solution.posed[0]
    write_solution(folder, scene, solution, folder, fingerprint(scene, KroncConfig()))
    again_scene, again = read_solution(folder)
    assert again.lenses is not None
    assert again_scene.lenses is not None
    assert again.lenses.each == again_scene.lenses.each == LENSES.each
    np.testing.assert_allclose(again.c2w[1:], solution.c2w[1:], atol=1e-9)
    assert [view.status for view in again.views] == [view.status for view in solution.views]
    assert pose_errors(again.c2w[1:], capture.c2w[1:])[0].mean() < 0.6


def test_colmap_gets_a_camera_for_each(folder, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    scene = load_scene(folder)
    write_solution(folder, scene, solve_scene(scene), folder, "")
    write_colmap(tmp_path / "model", folder)
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    assert {(camera.width, camera.height, camera.params[0]) for camera in model.cameras.values()} == {
        (480, 270, 400.0),
        (600, 800, 900.0),
    }
    widths = {image.name: model.cameras[image.camera_id].width for image in model.images.values()}
    assert widths["01.png"] == 600
    assert widths["02.png"] == 480


def test_another_camera_of_one_view_is_another_input(folder):
    scene = load_scene(folder)
    other = Lenses.of([*LENSES.each[:-1], replace(WIDE, fx=401.0)])
    assert fingerprint(scene, KroncConfig()) != fingerprint(replace(scene, lenses=other), KroncConfig())


def test_what_needs_one_camera_says_so(folder):
    content = json.loads((folder / "transforms.json").read_text())
    with pytest.raises(KroncError, match="different sizes"):
        camera_and_frames(content, folder / "transforms.json")


def test_a_size_for_all_keypoints_contradicts_images_of_several(folder, edit):
    edit(folder / "keypoints.json", lambda content: content.update(width=480, height=270))
    with pytest.raises(KroncError, match="the camera says 2 sizes"):
        load_scene(folder)
