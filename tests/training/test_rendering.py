import numpy as np
import pytest

from kronc_ns.training.appearance import draw_look
from kronc_ns.training.cameras import SIZE, draw_shot
from kronc_ns.training.lighting import draw_surroundings
from kronc_ns.training.procedural import draw_procedural
from kronc_ns.training.rendering import keypoints_seen, render
from kronc_ns.training.stage import Stage

LEFT, RIGHT = [7, 20, 10, 13], [50, 37, 47, 44]


@pytest.fixture(scope="module")
def stage():
    return Stage(draw_procedural(np.random.default_rng(4)), np.random.default_rng(0))


def _shots(stage, count, seed=0):
    rng = np.random.default_rng(seed)
    return [draw_shot(rng, stage.bounds) for _ in range(count)]


def test_cameras_see_the_car(stage):
    for shot in _shots(stage, 60):
        np.testing.assert_allclose(shot.c2w[:, :3].T @ shot.c2w[:, :3], np.eye(3), atol=1e-9)
        assert np.linalg.det(shot.c2w[:, :3]) == pytest.approx(1)
        uv, depth = shot.project(stage.bounds.mean(0)[None])
        assert depth[0] > 1
        assert ((uv > -0.3 * np.array(SIZE)) & (uv < 1.3 * np.array(SIZE))).all()


def test_rays_and_projection_are_inverse(stage):
    shot = _shots(stage, 1)[0]
    pixels = np.random.default_rng(1).uniform(0, SIZE, (50, 2))
    points = shot.c2w[:, 3] + 7.0 * shot.rays(pixels)
    np.testing.assert_allclose(shot.project(points)[0], pixels, atol=1e-6)


def test_points_of_one_side_are_seen_from_that_side(stage):
    for shot in _shots(stage, 60, seed=2):
        eye, seen = shot.c2w[:, 3], keypoints_seen(stage, shot)[:, 2] == 1
        if eye[1] > 2.0:
            assert not seen[RIGHT].any()
        if eye[1] < -2.0:
            assert not seen[LEFT].any()


def test_visible_points_lie_on_the_mask(stage):
    rng = np.random.default_rng(3)
    shown = 0
    for shot in _shots(stage, 4, seed=4):
        picture = render(stage, draw_look(rng, stage.body.mesh), draw_surroundings(rng, []), shot)
        assert picture.rgb.shape == (SIZE[1], SIZE[0], 3)
        visible = picture.keypoints[picture.keypoints[:, 2] == 1, :2]
        near = [
            picture.mask[max(0, int(v) - 2) : int(v) + 3, max(0, int(u) - 2) : int(u) + 3].any() for u, v in visible
        ]
        assert all(near)
        shown += len(visible)
        assert picture.rgb.std() > 2, "something is to be seen"
    assert shown > 30


def test_the_same_seed_renders_the_same_picture(stage):
    def once():
        rng = np.random.default_rng(8)
        shot, around = draw_shot(rng, stage.bounds), draw_surroundings(rng, [])
        return render(stage, draw_look(rng, stage.body.mesh), around, shot)

    np.testing.assert_array_equal(once().rgb, once().rgb)


def test_wheel_centres_are_seen_from_beside(stage):
    beside = [shot for shot in _shots(stage, 80, seed=5) if shot.c2w[1, 3] > 2 * abs(shot.c2w[0, 3])]
    assert beside
    for shot in beside:
        points = keypoints_seen(stage, shot)[[7, 20]]
        inside = ((points[:, :2] > 0) & (points[:, :2] < SIZE)).all(1)
        assert (points[inside, 2] == 1).all()


def test_cut_out_cars_stand_on_their_backdrop(stage):
    rng = np.random.default_rng(6)
    around = next(a for a in iter(lambda: draw_surroundings(rng, []), None) if a.backdrop is not None and a.shadow > 0)
    shot = _shots(stage, 1, seed=7)[0]
    picture = render(stage, draw_look(rng, stage.body.mesh), around, shot)
    beside = picture.rgb[picture.mask == 0].astype(int)
    colour = np.round(255 * around.backdrop)
    # but for the pixels at the edge of the car, the backdrop, or a shadow on it
    assert (np.abs(beside - colour).max(1) <= 1).mean() > 0.4
    assert (beside <= colour + 1).all(1).mean() > 0.95
