"""Blender's images agree with our own rays: silhouettes, sides, any pinhole."""

import json
import sys
from importlib.util import find_spec

import cv2
import numpy as np
import pytest
import trimesh

from kronc_ns.errors import KroncError
from kronc_ns.geometry.camera import Camera
from kronc_ns.geometry.poses import look_at
from kronc_ns.synthetic import blender
from kronc_ns.synthetic.blender import blender_views
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.mesh import KEYPOINTS_FILE, MeshCar, load_mesh_car
from kronc_ns.synthetic.render import trace_mask_and_depth
from kronc_ns.synthetic.scenes import default_camera, make_capture

needs_blender = pytest.mark.skipif(find_spec("bpy") is None, reason="Blender's module (bpy) is not installed")
CAMERA = Camera(150.0, 120.0, 70.0, 40.0, 128, 96)


@pytest.fixture(scope="module")
def car(tmp_path_factory) -> MeshCar:
    """A grey block with a cabin towards its rear; red on its left, blue on its right."""
    folder = tmp_path_factory.mktemp("block")
    scene = trimesh.Scene()
    parts = {  # in glTF's axes: x forward, y up, z right
        "body": ((4.0, 0.8, 1.6), (0, 0.4, 0), (0.5, 0.5, 0.5)),
        "cabin": ((1.6, 0.6, 1.2), (-0.8, 1.1, 0), (0.5, 0.5, 0.5)),
        "left": ((3.0, 0.5, 0.1), (0, 0.45, -0.85), (0.9, 0.05, 0.05)),
        "right": ((3.0, 0.5, 0.1), (0, 0.45, 0.85), (0.05, 0.05, 0.9)),
    }
    for name, (size, centre, colour) in parts.items():
        box = trimesh.creation.box(size, trimesh.transformations.translation_matrix(centre))
        material = trimesh.visual.material.PBRMaterial(baseColorFactor=[*colour, 1.0], metallicFactor=0.0)
        box.visual = trimesh.visual.TextureVisuals(material=material)
        scene.add_geometry(box, geom_name=name)
    scene.export(folder / "car.glb")
    points = np.random.default_rng(0).uniform((-2, -0.8, 0), (2, 0.8, 0.8), (66, 3)).tolist()
    (folder / KEYPOINTS_FILE).write_text(json.dumps({"schema": "apollocar3d-66", "keypoints": points}))
    return load_mesh_car(folder / "car.glb")


def poses(*centres: tuple[float, float, float]) -> np.ndarray:
    at = np.array(centres, dtype=float)
    return look_at(at, np.broadcast_to([0.3, 0.2, 0.6], at.shape), np.array([0.0, 0.0, 1.0]))


@needs_blender
def test_silhouettes_are_those_of_our_rays(car):
    """Also with oblong pixels and the principal point aside."""
    c2w = poses((4, 3, 2), (-5, 2, 1), (1, -5, 3))
    for rgba, pose in zip(blender_views(car, c2w, CAMERA, ground=False), c2w, strict=True):
        mask, _ = trace_mask_and_depth(car.mesh, pose, CAMERA, ground=False)
        inside, covered = mask > 0, rgba[..., 3] > 127
        assert 0.05 < inside.mean() < 0.7
        assert (inside & covered).sum() / (inside | covered).sum() > 0.98
        far = ~cv2.dilate(mask, np.ones((5, 5))).astype(bool)
        assert (rgba[far, 3] == 0).all()


@needs_blender
def test_left_is_left_and_the_car_park_is_around_it(car):
    left, right = blender_views(car, poses((0.3, 5, 1.2), (0.3, -5, 1.2)), CAMERA, ground=True)
    for picture, strong, weak in ((left, 0, 2), (right, 2, 0)):
        middle = picture[40:44, 60:70].reshape(-1, 4).astype(float).mean(0)
        assert middle[strong] > middle[weak] + 60
        assert (picture[..., 3] == 255).all()
        floor = picture[-12:, :, :3].astype(float)
        assert floor.std((0, 1)).min() > 4


@pytest.mark.slow
@needs_blender
def test_images_repeat(car):
    first, again = (next(iter(blender_views(car, poses((4, 3, 2)), CAMERA, ground=True))) for _ in range(2))
    np.testing.assert_array_equal(first, again)


@needs_blender
def test_a_capture_of_a_mesh_is_a_scene_folder(car, tmp_path):
    capture = make_capture("carpatch", views=2, seed=1, camera=default_camera("carpatch", 64), car=car)
    done: list[int] = []
    write_capture(tmp_path / "scene", capture, render=True, ground=False, progress=done.append, renderer="blender")
    assert done == [1, 2]
    for i in (1, 2):
        image, mask, depth = (
            cv2.imread(str(tmp_path / "scene" / kind / f"frame_{i:05d}.png"), cv2.IMREAD_UNCHANGED)
            for kind in ("images", "masks", "depths")
        )
        assert image.shape == (64, 64, 4)
        np.testing.assert_array_equal(mask > 0, depth > 0)
        assert ((image[..., 3] > 127) == (mask > 0)).mean() > 0.97
        assert 4000 < np.median(depth[depth > 0]) < 8000


@needs_blender
def test_blender_that_stops_is_reported_in_one_line(car, tmp_path):
    broken = MeshCar(tmp_path / "gone.glb", car.mesh, car.keypoints)
    with pytest.raises(KroncError, match=r"Blender stopped .*gone\.glb: .+"):
        list(blender_views(broken, poses((4, 3, 2)), CAMERA, ground=False))


@needs_blender
def test_blender_ends_when_nobody_waits_for_it(car, monkeypatch):
    started = []
    popen = blender.subprocess.Popen
    monkeypatch.setattr(blender.subprocess, "Popen", lambda *a, **k: started.append(popen(*a, **k)) or started[-1])
    views = blender_views(car, poses(*[(4, 3, 2)] * 50), CAMERA, ground=False)
    next(views)
    assert started[0].poll() is None
    views.close()
    assert started[0].poll() is not None


def test_without_blender_the_remedy_is_named(car, monkeypatch):
    monkeypatch.setitem(sys.modules, "bpy", None)
    monkeypatch.setattr(blender, "find_spec", lambda name: None)
    with pytest.raises(KroncError, match=r"kronc-ns\[blender\]"):
        next(blender_views(car, poses((4, 3, 2)), CAMERA, ground=False))


def test_lenses_that_blender_has_not_are_refused(car, monkeypatch):
    monkeypatch.setattr(blender, "find_spec", lambda name: object())
    bent = Camera(150.0, 150.0, 64.0, 48.0, 128, 96, k1=0.1)
    with pytest.raises(KroncError, match="pinhole"):
        next(blender_views(car, poses((4, 3, 2)), bent, ground=False))


def test_a_mesh_is_drawn_by_blender_only(car, tmp_path):
    capture = make_capture("walk", views=2, car=car)
    with pytest.raises(KroncError, match="expected --renderer blender"):
        write_capture(tmp_path / "scene", capture, render=True)
    assert not (tmp_path / "scene").exists()
