"""COLMAP's own reader sees our cameras, poses and points."""

import zlib  # noqa: F401 - before pycolmap, which aborts the process otherwise

import numpy as np
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.files.colmap import write_colmap
from kronc_ns.geometry.camera import project
from kronc_ns.geometry.poses import invert, transform
from tests.files.conftest import KEPT


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
    assert sorted(images) == [solution.names[i].split("/")[-1] for i in KEPT]
    for i in KEPT:
        w2c = images[solution.names[i].split("/")[-1]].cam_from_world().matrix()
        np.testing.assert_allclose(w2c, invert(solution.c2w[i]), atol=1e-9)


def test_colmap_projects_as_we_do(model, solution):
    images = {image.name: image for image in model.images.values()}
    for i in KEPT[::4]:
        pixels = project(transform(invert(solution.c2w[i]), solution.points), solution.camera)
        for j in (0, 10, 40, 65):
            theirs = images[solution.names[i].split("/")[-1]].project_point(solution.points[j])
            np.testing.assert_allclose(theirs, pixels[j], atol=1e-6)


def test_colmap_holds_the_keypoints(model, solution):
    known = solution.points[np.isfinite(solution.points).all(-1)]
    theirs = np.array([model.points3D[k].xyz for k in sorted(model.points3D)])
    np.testing.assert_allclose(theirs, known, atol=1e-12)
