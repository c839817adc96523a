"""Cars in glTF files: the procedural car comes back as it was written; what is wrong with a file is said."""

import json
import sys

import numpy as np
import pytest
import trimesh

from kronc_ns.commands import main as cli
from kronc_ns.errors import KroncError
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.synthetic.car import CarModel, build_car
from kronc_ns.synthetic.car_parts import CarShape
from kronc_ns.synthetic.mesh import KEYPOINTS_FILE, MeshCar, load_mesh_car, write_mesh_car
from kronc_ns.synthetic.render import albedo, interpolated_normal, keypoint_visibility


@pytest.fixture(scope="module")
def car() -> CarModel:
    return build_car(CarShape())


@pytest.fixture(scope="module")
def written(car, tmp_path_factory) -> MeshCar:
    return write_mesh_car(car, tmp_path_factory.mktemp("car") / "car.glb")


@pytest.mark.slow
def test_the_procedural_car_keeps_its_shape_and_points(car, written):
    np.testing.assert_allclose(written.mesh.bounds, car.mesh.bounds, atol=1e-5)
    assert written.mesh.area == pytest.approx(car.mesh.area, rel=1e-5)
    np.testing.assert_array_equal(written.keypoints, car.keypoints)
    centres = np.array([[4.0, 3, 1.5], [-4, 3, 1.5], [-4, -3, 1.5]])
    seen = [keypoint_visibility(c.mesh, car.keypoints, centres) for c in (car, written)]
    assert (seen[0] == seen[1]).mean() > 0.99


@pytest.mark.slow
def test_the_procedural_car_keeps_its_paint(car, written):
    """The baked texture at points of the file's triangles is the paint at these points."""
    (mesh,) = trimesh.load_scene(written.file).geometry.values()
    image = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"), dtype=float) / 255
    rng = np.random.default_rng(0)
    faces = rng.choice(len(mesh.faces), 3000)
    weights = rng.dirichlet(np.ones(3), len(faces))
    uv = np.einsum("nk,nki->ni", weights, mesh.visual.uv[mesh.faces[faces]])
    column, row = (uv * (1, -1) + (0, 1)).T * len(image)
    found = image[np.floor(row).astype(int), np.floor(column).astype(int)]
    points = np.einsum("nk,nki->ni", weights, mesh.triangles[faces]) @ np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    source = trimesh.proximity.closest_point(car.mesh, points)[2]
    normal = interpolated_normal(car.mesh, source, points)
    expected, _ = albedo(car, points, normal, source, np.full(len(points), 0.0075))
    error = np.abs(found - expected).max(1)
    assert np.median(error) < 0.01
    assert (error < 0.1).mean() > 0.9


@pytest.fixture
def folder(tmp_path):
    """A box for a car, with its points on it."""
    box = trimesh.creation.box((4.0, 1.5, 1.8))
    box.apply_translation((0, 0.75, 0))
    box.export(tmp_path / "car.glb")
    points = np.random.default_rng(0).uniform((-2, -0.9, 0), (2, 0.9, 1.5), (66, 3))
    (tmp_path / KEYPOINTS_FILE).write_text(json.dumps({"schema": "apollocar3d-66", "keypoints": points.tolist()}))
    return tmp_path


def test_gltf_is_turned_into_the_cars_world(folder):
    np.testing.assert_allclose(load_mesh_car(folder / "car.glb").mesh.bounds, [[-2, -0.9, 0], [2, 0.9, 1.5]], atol=1e-6)


def test_what_is_wrong_with_a_mesh_is_said(folder, edit):
    points = json.loads((folder / KEYPOINTS_FILE).read_text())["keypoints"]

    def refused(match: str, file: str = "car.glb") -> None:
        with pytest.raises(KroncError, match=match):
            load_mesh_car(folder / file)

    refused("expected a .glb or .gltf", "other.glb")
    refused("expected a .glb or .gltf", KEYPOINTS_FILE)
    edit(folder / KEYPOINTS_FILE, lambda c: c.update(keypoints=points[:65]))
    refused(r"expected 66 keypoints of three finite numbers, got \(65, 3\)")
    edit(folder / KEYPOINTS_FILE, lambda c: c.update(keypoints=[*points[:65], [0.0, None, 1.0]]))
    refused("expected 66 keypoints of three finite")
    edit(folder / KEYPOINTS_FILE, lambda c: c.update(keypoints=(1000 * np.array(points)).tolist()))
    refused("outside the mesh: expected metres")
    edit(folder / KEYPOINTS_FILE, lambda c: c.update(keypoints=points, schema="body-17"))
    refused("'body-17' is unknown")
    (folder / KEYPOINTS_FILE).unlink()
    refused(f"{KEYPOINTS_FILE} does not exist")


def test_a_file_that_is_no_gltf_is_refused(folder):
    (folder / "car.glb").write_bytes(b"no glTF at all")
    with pytest.raises(KroncError, match="cannot be read as glTF"):
        load_mesh_car(folder / "car.glb")


def test_kronc_synth_takes_a_mesh(folder, tmp_path, monkeypatch, capsys):
    def synth(*options: str) -> tuple[int, str]:
        arguments = ["--mesh", str(folder / "car.glb"), "--output-dir", str(tmp_path / "out"), "--views", "3", *options]
        monkeypatch.setattr(sys, "argv", ["kronc", "synth", *arguments])
        with pytest.raises(SystemExit) as caught:
            cli.main()
        return int(caught.value.code or 0), capsys.readouterr().err

    status, message = synth("--render")
    assert (status, "expected --renderer blender" in message) == (2, True)
    status, message = synth("--renderer", "blender")
    assert (status, "without --render: add --render" in message) == (2, True)
    assert not (tmp_path / "out").exists()
    assert synth() == (0, "")
    assert len(load_scene(tmp_path / "out")) == 3
