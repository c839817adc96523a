"""`kronc refine`, what it writes, and who reads it."""

import numpy as np
import pytest

from kronc_ns.commands.export import Export
from kronc_ns.commands.refine import Refine
from kronc_ns.commands.report import Report
from kronc_ns.errors import KroncError
from kronc_ns.files.cloud import read_cloud
from kronc_ns.files.output import claim_output
from kronc_ns.files.photos import photos
from kronc_ns.files.record import read_record, read_solution, write_solution


@pytest.fixture(scope="module")
def out(walk, solved, tmp_path_factory):
    """A refined folder."""
    base = tmp_path_factory.mktemp("commands")
    scene, solution = solved
    claim_output(base / "solved")
    write_solution(base / "solved", scene, solution, walk[0], "")
    assert Refine(data=base / "solved", output_dir=base / "refined").run() == 0
    return base / "refined"


def test_the_folder_holds_the_evidence_and_the_cloud(out):
    scene, solution = read_solution(out)
    assert solution.images.accepted
    assert solution.cloud is not None
    assert read_record(out)["images"]["accepted"] is True
    assert all((out / name).exists() for name in scene.names)
    vertices = int((out / "keypoints.ply").read_bytes().split(b"element vertex ")[1].split(b"\n")[0])
    assert vertices == len(solution.cloud.points) + int(np.isfinite(solution.points).all(-1).sum())


def test_colmap_gets_the_tracks(out, tmp_path):
    import zlib  # noqa: F401 - pycolmap after zlib

    import pycolmap

    assert Export(data=out, format="colmap", output=tmp_path / "model").run() == 0
    model = pycolmap.Reconstruction(tmp_path / "model")
    cloud = read_solution(out)[1].cloud
    assert sum(len(point.track.elements) for point in model.points3D.values()) == len(cloud.view)
    assert model.compute_mean_reprojection_error() < 0.5


def test_the_report_tells_it(out):
    assert Report(data=out).run() == 0
    page = (out / "report.html").read_text()
    assert "The poses are those of image features" in page
    assert "tracks held out" in page


def test_its_own_folder_is_refused(out):
    with pytest.raises(KroncError, match="itself"):
        Refine(data=out, output_dir=out).run()


def test_a_broken_cloud_is_told(out, tmp_path):
    views = len(read_record(out)["views"])
    broken = tmp_path / "features.npz"
    broken.write_bytes((out / "features.npz").read_bytes()[:200])
    with pytest.raises(KroncError, match=r"features\.npz"):
        read_cloud(tmp_path, views)
    broken.write_bytes((out / "features.npz").read_bytes())
    with pytest.raises(KroncError, match="does not fit"):
        read_cloud(tmp_path, views=2)


def test_a_photo_of_another_size_is_told(walk, solved):
    from dataclasses import replace

    scene = solved[0]
    wider = replace(scene, camera=replace(scene.camera, width=scene.camera.width + 1))
    with pytest.raises(KroncError, match="expected the image that was solved"):
        photos(walk[0], wider)(0)
    gone = replace(scene, names=("images/none.png", *scene.names[1:]))
    with pytest.raises(KroncError, match="refine-images off"):
        photos(walk[0], gone)(0)
