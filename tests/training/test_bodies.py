from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from kronc_ns.errors import KroncError
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.training.bodies import KEPT_OUT, WITH_KEYPOINTS, draw_body, load_garage
from kronc_ns.training.body import Body
from kronc_ns.training.decals import painted
from kronc_ns.training.deformation import Proportions, deform, refined
from kronc_ns.training.meshes import Surface, TexturedMesh
from kronc_ns.training.procedural import draw_procedural
from tests.conftest import SHARED_DATA

MIRROR = list(APOLLOCAR3D_66.flip)
FRONT, REAR, RIGHT = 7, 20, 50  # hubs: two of the left side, the front one of the right side
STRONG = Proportions(
    front_overhang=1.2, wheelbase=1.08, rear_overhang=0.85, body_height=1.12, cabin_height=0.9, width=1.05, wheels=1.1,
    ride_m=0.05, nose_m=0.04, tail_m=-0.05, cabin_m=0.08, rake=0.1, lean=0.05,
)  # fmt: skip


@pytest.fixture(scope="module")
def car() -> Body:
    return draw_procedural(np.random.default_rng(4))


def distances(body: Body) -> np.ndarray:
    """Metres from the keypoints that there are to the surface."""
    return trimesh.proximity.closest_point(body.mesh.geometry(), body.keypoints[body.present])[1]


def rim_radii(body: Body) -> np.ndarray:
    """Of the left front tyre's vertices, seen along the axle: the largest one in each of 16 directions."""
    mesh, hub = body.mesh, body.keypoints[FRONT]
    tyre = [index for index, surface in enumerate(mesh.surfaces) if surface.name == "tyre"]
    p = mesh.vertices[np.unique(mesh.faces[np.isin(mesh.surface, tyre)])] - hub
    p = p[(np.abs(p[:, 0]) < 0.8) & (p[:, 1] > -0.5)]
    sector = (np.arctan2(p[:, 2], p[:, 0]) / (2 * np.pi) * 16 + 16.5).astype(int) % 16
    return np.array([np.hypot(p[sector == s, 0], p[sector == s, 2]).max() for s in range(16)])


@pytest.mark.parametrize("seed", range(3))
def test_procedural_keypoints_lie_on_the_surface_and_mirror_each_other(seed):
    body = draw_procedural(np.random.default_rng(seed))
    assert distances(body).max() < 2e-3
    np.testing.assert_allclose(body.keypoints[MIRROR], body.keypoints * (1, -1, 1), atol=1e-9)
    assert body.present.sum() >= 46


def test_what_shines_or_is_looked_through_is_a_surface_of_its_own(car):
    names = {surface.name for surface in car.mesh.surfaces}
    assert {"paint", "glass", "tyre", "rim", "light_front", "light_rear"} <= names


def test_a_seed_makes_one_car():
    one, two = (draw_procedural(np.random.default_rng(9)) for _ in range(2))
    assert one.name == two.name
    np.testing.assert_array_equal(one.mesh.vertices, two.mesh.vertices)
    np.testing.assert_array_equal(one.keypoints, two.keypoints)
    for a, b in zip(one.decals, two.decals, strict=True):
        np.testing.assert_array_equal(a.rgba, b.rgba)


def test_proportions_of_one_change_nothing(car):
    same = deform(car, Proportions())
    shift = same.mesh.vertices[0] - car.mesh.vertices[0]
    np.testing.assert_allclose(same.mesh.vertices, car.mesh.vertices + shift, atol=1e-9)
    np.testing.assert_allclose(same.keypoints, car.keypoints + shift, atol=1e-9)
    np.testing.assert_allclose(same.mesh.normals, car.mesh.normals, atol=1e-6)


def test_deformed_keypoints_stay_on_the_surface(car):
    assert distances(deform(car, STRONG)).max() < 4e-3


def test_deformation_keeps_mirror_symmetry(car):
    body = deform(car, STRONG)
    np.testing.assert_allclose(body.keypoints[MIRROR], body.keypoints * (1, -1, 1), atol=1e-9)
    mirrored = body.mesh.vertices * (1, -1, 1)
    away, _ = KDTree(body.mesh.vertices).query(mirrored)
    assert away.max() < 1e-6


def test_wheels_stay_round_and_on_the_ground(car):
    body = deform(car, STRONG)
    before, after = rim_radii(car), rim_radii(body)
    np.testing.assert_allclose(after, before * STRONG.wheels, rtol=1e-6)
    assert body.mesh.vertices[:, 2].min() == pytest.approx(0, abs=1e-9)
    assert body.keypoints[FRONT, 2] == pytest.approx(before.max() * STRONG.wheels, abs=0.01)


def test_the_wheelbase_and_the_width_are_those_asked_for(car):
    body = deform(car, Proportions(wheelbase=1.08, width=1.05))
    (base, _, _), (_, wide, _) = car.keypoints[FRONT] - car.keypoints[[REAR, RIGHT]]
    (new_base, _, _), (_, new_wide, _) = body.keypoints[FRONT] - body.keypoints[[REAR, RIGHT]]
    assert new_base == pytest.approx(1.08 * base, rel=0.01)
    assert new_wide == pytest.approx(1.05 * wide, rel=0.01)


def test_surfaces_named_like_wheels_are_not_taken_for_them(car):
    surfaces = tuple(replace(s, name="trim" if s.name == "paint" else s.name) for s in car.mesh.surfaces)
    body = deform(replace(car, mesh=replace(car.mesh, surfaces=surfaces)), Proportions(cabin_height=1.3))
    high = car.mesh.vertices[:, 2] > 1.2
    assert (body.mesh.vertices[high, 2] > car.mesh.vertices[high, 2] + 0.01).all()


def test_refined_meshes_have_short_edges_and_the_same_surface():
    box = trimesh.creation.box((4.0, 1.8, 1.4))
    mesh = TexturedMesh(
        np.asarray(box.vertices), np.asarray(box.vertex_normals), np.zeros((8, 2)), np.asarray(box.faces),
        np.arange(12), tuple(Surface(str(k), np.ones(3)) for k in range(12)),
    )  # fmt: skip
    fine = refined(mesh, 0.3)
    corners = fine.vertices[fine.faces]
    assert np.linalg.norm(np.roll(corners, 1, axis=1) - corners, axis=2).max() <= 0.3
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    old = box.area_faces
    np.testing.assert_allclose(np.bincount(fine.surface, area, minlength=12), old, rtol=1e-9)


def test_decals_cover_the_car_and_no_more(car):
    low, high = car.mesh.vertices.min(0) - 0.1, car.mesh.vertices.max(0) + 0.1
    axes = {"left": (0, 2), "right": (0, 2), "front": (1, 2), "rear": (1, 2), "top": (0, 1)}
    for decal in car.decals:
        a, b = axes[decal.view]
        wide, tall = np.array(decal.rgba.shape[1::-1]) * decal.metres_per_texel
        assert low[a] <= decal.corner[0] <= high[a] - wide
        assert low[b] + tall <= decal.corner[1] <= high[b]


def test_cars_without_plates_have_no_corners_of_plates(car):
    bare = Body("bare", car.mesh, np.where(np.isfinite(car.keypoints), car.keypoints, 0.3))
    seen = []
    for seed in range(12):
        body = painted(bare, ("front_plate", "rear_plate"), np.random.default_rng(seed))
        for corners in ([58, 59, 60, 61], [62, 63, 64, 65]):
            present = body.present[corners]
            assert present.all() or not present.any()
            seen.append(present.all())
        assert sum(decal.surfaces is None for decal in body.decals) == body.present[[58, 62]].sum()
    assert 0 < np.mean(seen) < 1


def test_a_garage_without_cars_says_so(tmp_path):
    with pytest.raises(KroncError, match="holds none of the labelled cars"):
        load_garage(tmp_path, None)


@pytest.mark.skipif(
    not (SHARED_DATA / "cars_train").is_dir(), reason="the meshes to train on are not beside the project"
)
def test_bodies_from_the_garage_keep_their_points():
    garage = load_garage(SHARED_DATA / "cars_train", SHARED_DATA / "cars")
    names = {model.body.name for model in garage}
    assert set(WITH_KEYPOINTS) - set(KEPT_OUT) <= names
    assert not names & set(KEPT_OUT)
    kept_out = load_garage(SHARED_DATA / "cars_train", SHARED_DATA / "cars", kept_out=True)
    assert {model.body.name for model in kept_out} == set(KEPT_OUT)
    assert not names & {"porsche_911", "md_dino246"}
    rng = np.random.default_rng(1)
    for _ in range(4):
        body = draw_body(rng, garage)
        assert body.mesh.vertices[:, 2].min() == pytest.approx(0, abs=0.02)
        assert np.median(distances(body)) < 5e-3
