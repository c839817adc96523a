"""`kronc-dataparser`: solved once, poses as nerfstudio wants them, the user's folder untouched."""

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path, PurePosixPath

import numpy as np
import pytest
import torch
from PIL import Image

pytest.importorskip("nerfstudio")

from kronc_ns.errors import KroncError
from kronc_ns.files.presets import load_config
from kronc_ns.files.record import write_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.geometry.poses import flip_camera_axes
from kronc_ns.plugin.background import cut_out
from kronc_ns.plugin.dataparser import KroncDataParser, KroncDataParserConfig
from kronc_ns.solution import Solution, ViewStatus
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import default_camera, make_capture

pytestmark = pytest.mark.nerfstudio

VIEWS = 16
POOR = 5
"""Index of the view that `poor` leaves too few keypoints."""


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """Where this module's scene and cache lie."""
    return tmp_path_factory.mktemp("dataparser")


@pytest.fixture(scope="module")
def rendered(place) -> Path:
    """A small rendered walk without poses; tests only read it."""
    capture = make_capture("walk", views=VIEWS, seed=7, noise_px=0.1, camera=default_camera("walk", 96))
    write_capture(place / "walk", capture, render=True)
    return place / "walk"


@pytest.fixture(scope="module")
def config(place) -> str:
    (place / "quick.yaml").write_text("init: template\n")
    return str(place / "quick.yaml")


@pytest.fixture(scope="module")
def solution(rendered, config) -> Solution:
    return solve_scene(load_scene(rendered), load_config(config))


@pytest.fixture(autouse=True)
def cache(place, monkeypatch) -> Path:
    """One cache for all tests, so that they solve once."""
    monkeypatch.setenv("KRONC_NS_CACHE", str(place / "cache"))
    return place / "cache"


@pytest.fixture
def fresh_cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("KRONC_NS_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def no_solver(monkeypatch):
    """From here on nothing may be solved."""

    def fail(*_):
        raise AssertionError("solved again")

    return lambda: monkeypatch.setattr("kronc_ns.files.cache.solve_scene", fail)


@pytest.fixture
def changed(rendered, tmp_path) -> Path:
    """A copy that a test may change."""
    return Path(shutil.copytree(rendered, tmp_path / "walk"))


@pytest.fixture
def parser(rendered, config):
    def build(data: Path = rendered, **options) -> KroncDataParser:
        return KroncDataParserConfig(**{"data": data, "config": config, **options}).setup()

    return build


@pytest.fixture
def outputs(parser):
    def build(split: str = "train", **options):
        return parser(**options).get_dataparser_outputs(split=split)

    return build


def snapshot(folder: Path) -> dict[Path, tuple[int, bytes]]:
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in files}


def known_points(solution: Solution) -> torch.Tensor:
    """The keypoints that have a place."""
    return torch.from_numpy(solution.points[np.isfinite(solution.points).all(-1)]).float()


def view_numbers(output) -> list[int]:
    return [int(path.stem.removeprefix("frame_")) - 1 for path in output.image_filenames]


# ---- solving once


def test_solved_once_and_the_users_folder_stays_as_it_is(rendered, outputs, fresh_cache, no_solver):
    before = snapshot(rendered)
    first = outputs()
    no_solver()
    second = outputs()
    assert torch.equal(first.cameras.camera_to_worlds, second.cameras.camera_to_worlds)
    assert first.image_filenames == second.image_filenames
    assert snapshot(rendered) == before
    assert any(fresh_cache.rglob("kronc.json"))


def test_a_moved_capture_is_known_again_and_a_changed_one_is_not(changed, outputs, no_solver, edit):
    first = outputs(background="keep")
    no_solver()
    moved = outputs(data=changed, background="keep")
    assert torch.equal(first.cameras.camera_to_worlds, moved.cameras.camera_to_worlds)
    assert all(path.is_relative_to(changed) for path in moved.image_filenames)
    edit(changed / "keypoints.json", lambda c: c["frames"][2]["keypoints"].__setitem__(0, [1.0, 2.0, 1.0]))
    with pytest.raises(AssertionError, match="solved again"):
        outputs(data=changed)
    with pytest.raises(AssertionError, match="solved again"):
        outputs(seed=1)


@pytest.mark.parametrize("text", ["{", "{}"])
def test_a_broken_cache_entry_is_made_anew(outputs, fresh_cache, text):
    first = outputs()
    (report,) = fresh_cache.rglob("kronc.json")
    whole = report.read_text()
    report.write_text(text)
    second = outputs()
    assert torch.equal(first.cameras.camera_to_worlds, second.cameras.camera_to_worlds)
    assert json.loads(report.read_text())["points"] == json.loads(whole)["points"]


def test_a_processed_folder_is_taken_as_solved_unless_an_option_is_given(changed, solution, config, no_solver):
    write_solution(changed, load_scene(changed), solution, changed, "inputs")
    no_solver()
    output = KroncDataParserConfig(data=changed, background="keep").setup().get_dataparser_outputs(split="all")
    assert view_numbers(output) == list(range(VIEWS))
    with pytest.raises(AssertionError, match="solved again"):
        KroncDataParserConfig(data=changed, seed=99, config=config).setup().get_dataparser_outputs()


# ---- splits


def test_every_eighth_view_is_for_evaluation(parser):
    one = parser(background="keep")
    train, val, test, whole = (
        view_numbers(one.get_dataparser_outputs(split=s)) for s in ("train", "val", "test", "all")
    )
    assert val == test == [0, 8]
    assert train == [i for i in range(VIEWS) if i % 8]
    assert sorted(train + val) == whole == list(range(VIEWS))


def test_an_evenly_spread_share_is_for_evaluation(outputs):
    val = view_numbers(outputs("val", eval_fraction=0.25, background="keep"))
    train = view_numbers(outputs("train", eval_fraction=0.25, background="keep"))
    assert val == [0, 4, 8, 12]
    assert sorted(train + val) == list(range(VIEWS))


def test_a_view_with_three_keypoints_is_left_out_and_listed(changed, parser, edit, capsys):
    def thin(content):
        rows = content["frames"][POOR]["keypoints"]
        for j in [j for j, row in enumerate(rows) if row[2] > 0][3:]:
            rows[j] = [0, 0, 0]

    edit(changed / "keypoints.json", thin)
    one = parser(changed, background="keep", min_status="solved")
    train, val = (view_numbers(one.get_dataparser_outputs(split=s)) for s in ("train", "val"))
    assert sorted(train + val) == [i for i in range(VIEWS) if i != POOR]
    assert val == [0, 8], "the split does not shift"
    printed = " ".join(capsys.readouterr().out.split())
    assert "15 of 16" in printed
    assert f"images/frame_{POOR + 1:05d}.png" in printed
    assert "3 keypoints" in printed
    completed = parser(changed, background="keep").get_dataparser_outputs(split="all")
    assert view_numbers(completed) == list(range(VIEWS))
    assert "views completed │ 1" in " ".join(capsys.readouterr().out.split())


def test_a_processed_folder_may_have_left_views_out(changed, solution, no_solver):
    views = list(solution.views)
    views[POOR] = replace(views[POOR], status=ViewStatus.FAILED, reason="3 keypoints, at least 4 are needed")
    c2w = solution.c2w.copy()
    c2w[POOR] = np.nan
    write_solution(changed, load_scene(changed), replace(solution, views=views, c2w=c2w), changed, "inputs")
    no_solver()
    one = KroncDataParserConfig(data=changed, background="keep").setup()
    train, val = (view_numbers(one.get_dataparser_outputs(split=s)) for s in ("train", "val"))
    assert sorted(train + val) == [i for i in range(VIEWS) if i != POOR]
    assert val == [0, 8], "the split does not shift"


# ---- geometry


def test_poses_are_the_solutions_moved_and_scaled(outputs, solution):
    output = outputs("all", scale_factor=2.0)
    c2w, move, scale = output.cameras.camera_to_worlds, output.dataparser_transform, output.dataparser_scale
    expected = torch.from_numpy(flip_camera_axes(solution.c2w)).float()
    torch.testing.assert_close(c2w[..., :3], move[:, :3] @ expected[..., :3], atol=1e-5, rtol=0)
    centres = scale * (expected[..., 3] @ move[:, :3].T + move[:, 3])
    torch.testing.assert_close(c2w[..., 3], centres, atol=1e-5, rtol=0)
    middle = output.scene_box.aabb.mean(0)
    torch.testing.assert_close(middle, torch.zeros(3), atol=1e-5, rtol=0)
    assert float(c2w[..., 3].norm(dim=-1).max()) == pytest.approx(2.0, rel=1e-5)


def test_poses_are_right_handed_with_y_up_and_look_at_the_car(outputs):
    c2w = outputs("all").cameras.camera_to_worlds
    right, up, back = c2w[..., :3].unbind(-1)
    torch.testing.assert_close(torch.linalg.cross(right, up), back, atol=1e-5, rtol=0)
    assert (up[:, 2] > 0.9).all()
    towards = -torch.nn.functional.normalize(c2w[..., 3], dim=-1)
    assert ((-back * towards).sum(-1) > 0.9).all()


def test_splits_share_one_world(parser):
    one = parser()
    train, val = (one.get_dataparser_outputs(split=s) for s in ("train", "val"))
    assert train.dataparser_scale == val.dataparser_scale
    assert torch.equal(train.dataparser_transform, val.dataparser_transform)
    assert torch.equal(train.scene_box.aabb, val.scene_box.aabb)


def test_all_keypoints_lie_inside_the_box(outputs, solution):
    output = outputs()
    move, scale = output.dataparser_transform, output.dataparser_scale
    points = scale * (known_points(solution) @ move[:, :3].T + move[:, 3])
    low, high = output.scene_box.aabb
    assert ((points > low) & (points < high)).all()
    size = high - low
    assert size[0] > size[1] > size[2], "a car is longer than wide, and wider than high"
    twice = outputs(scene_scale=2.0)
    torch.testing.assert_close(twice.scene_box.aabb, 2 * output.scene_box.aabb, atol=1e-5, rtol=0)


def test_intrinsics_and_distortion_are_the_cameras(changed, outputs, edit):
    edit(changed / "transforms.json", lambda c: c.update(k1=-0.02, k2=0.003, p1=0.001, p2=-0.002))
    cameras = outputs(data=changed).cameras
    camera = asdict(load_scene(changed).camera)
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        assert (getattr(cameras, name) == camera[name]).all(), name
    expected = torch.tensor([-0.02, 0.003, 0.0, 0.0, 0.001, -0.002]).expand(len(cameras), -1)
    torch.testing.assert_close(cameras.distortion_params, expected)


# ---- images


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path))


def test_white_background_cuts_the_car_out(rendered, outputs):
    output = outputs("all")
    assert output.mask_filenames is None
    torch.testing.assert_close(output.alpha_color, torch.ones(3))
    for path, number in zip(output.image_filenames[::5], range(0, VIEWS, 5), strict=True):
        rgba = pixels(path)
        name = f"frame_{number + 1:05d}.png"
        mask = pixels(rendered / "masks" / name)
        np.testing.assert_array_equal(rgba[..., 3], np.where(mask > 0, 255, 0))
        np.testing.assert_array_equal(rgba[..., :3], pixels(rendered / "images" / name))
        assert 0 < (mask > 0).mean() < 1


def test_an_images_own_alpha_stays(tmp_path):
    rgba = np.full((4, 6, 4), 200, dtype=np.uint8)
    rgba[:, :2, 3] = 90
    mask = np.zeros((4, 6), dtype=np.uint8)
    mask[:2] = 255
    Image.fromarray(rgba).save(tmp_path / "image.png")
    Image.fromarray(mask).save(tmp_path / "mask.png")
    (copy,) = cut_out([tmp_path / "image.png"], [tmp_path / "mask.png"])
    expected = np.zeros((4, 6), dtype=np.uint8)
    expected[:2] = [90, 90, 200, 200, 200, 200]
    np.testing.assert_array_equal(pixels(copy)[..., 3], expected)


def test_copies_are_called_as_their_images_and_made_once(rendered, fresh_cache):
    images, masks = (sorted((rendered / kind).iterdir())[:3] for kind in ("images", "masks"))
    copies = cut_out(images, masks)
    assert [copy.name for copy in copies] == [image.name for image in images]
    assert len({copy.parent for copy in copies}) == 1
    made = {copy: copy.resolve().stat().st_mtime_ns for copy in copies}
    assert cut_out(images, masks) == copies
    others = cut_out(images[1:], masks[1:])
    assert [copy.resolve() for copy in others] == [copy.resolve() for copy in copies[1:]]
    assert made == {copy: copy.resolve().stat().st_mtime_ns for copy in copies}
    copies[0].resolve().unlink()
    assert pixels(cut_out(images, masks)[0]).shape[-1] == 4


def test_copies_of_images_that_only_suffixes_tell_apart_have_names_of_their_own(tmp_path):
    images = [tmp_path / name for name in ("a.png", "a.jpg", "b.jpg")]
    for number, image in enumerate(images):
        Image.new("RGB", (6, 4), (60 * number, 0, 0)).save(image)
    Image.new("L", (6, 4), 255).save(tmp_path / "mask.png")
    copies = cut_out(images, [tmp_path / "mask.png"] * 3)
    assert [copy.name for copy in copies] == ["a.png.png", "a.jpg.png", "b.png"]
    assert [int(pixels(copy)[0, 0, 0]) // 50 for copy in copies] == [0, 1, 2]


def test_cameras_have_room_for_what_nerfstudios_exporter_notes(outputs):
    camera = outputs("train").cameras[:1]
    camera.metadata["cam_idx"] = 0
    assert outputs("train").cameras.metadata == {}


@pytest.mark.parametrize("content", ["null", "[]", '{"frames": 3}', "{"])
@pytest.mark.parametrize("file", ["transforms.json", "kronc.json", "keypoints.json"])
def test_broken_files_of_a_solved_folder_are_named(solved_lap_folder, tmp_path, capsys, file, content):
    out = Path(shutil.copytree(solved_lap_folder, tmp_path / "out"))
    (out / file).write_text(content)
    with pytest.raises(SystemExit) as ended:
        KroncDataParserConfig(data=out).setup().get_dataparser_outputs("train")
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {out / file}")
    assert error.count("\n") == 1


def test_masks_that_do_not_fit_are_refused(tmp_path):
    Image.new("RGB", (6, 4)).save(tmp_path / "image.png")
    Image.new("L", (4, 6)).save(tmp_path / "mask.png")
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(KroncError, match="expected equal sizes"):
        cut_out([tmp_path / "image.png"], [tmp_path / "mask.png"])
    with pytest.raises(KroncError, match=r"text\.png is no image"):
        cut_out([tmp_path / "image.png"], [tmp_path / "text.png"])
    with pytest.raises(KroncError, match=r"text\.png is no image"):
        cut_out([tmp_path / "text.png"], [tmp_path / "mask.png"])


def test_masks_and_the_full_frame_go_to_the_method_as_they_are(rendered, outputs):
    masked = outputs("val", background="mask")
    kept = outputs("val", background="keep")
    names = ["frame_00001.png", "frame_00009.png"]
    assert masked.image_filenames == kept.image_filenames == [rendered / "images" / name for name in names]
    assert masked.mask_filenames == [rendered / "masks" / name for name in names]
    assert kept.mask_filenames is None
    assert kept.alpha_color is None


def test_downscaled_images_come_with_their_intrinsics(changed, outputs):
    for kind in ("images", "masks"):
        (changed / f"{kind}_2").mkdir()
        for path in (changed / kind).iterdir():
            Image.open(path).resize((48, 27), Image.Resampling.NEAREST).save(changed / f"{kind}_2" / path.name)
    half = outputs(data=changed, downscale_factor=2)
    full = outputs(data=changed)
    assert all(Image.open(path).size == (48, 27) for path in half.image_filenames)
    assert all(Image.open(path).size == (96, 54) for path in full.image_filenames)
    for name in ("fx", "fy", "cx", "cy", "width", "height"):
        torch.testing.assert_close(getattr(half.cameras, name) * 2, getattr(full.cameras, name))
    masks = outputs(data=changed, downscale_factor=2, background="mask").mask_filenames
    assert all(PurePosixPath(path).parent.name == "masks_2" for path in masks)


def test_random_seed_points_fill_the_box_and_hold_the_keypoints(outputs, solution):
    output, again = (outputs(num_seed_points=700, seeds="box") for _ in range(2))
    points, colours = output.metadata["points3D_xyz"], output.metadata["points3D_rgb"]
    known = known_points(solution)
    assert len(points) == len(colours) == 700 + len(known)
    assert colours.dtype == torch.uint8
    low, high = output.scene_box.aabb
    assert ((points >= low - 1e-6) & (points <= high + 1e-6)).all()
    assert ((points.amax(0) - points.amin(0)) > 0.95 * (high - low)).all()
    move, scale = output.dataparser_transform, output.dataparser_scale
    keypoints = scale * (known @ move[:, :3].T + move[:, 3])
    assert torch.cdist(keypoints, points).amin(1).max() < 1e-3
    assert torch.equal(points, again.metadata["points3D_xyz"])


def test_the_visual_hull_is_on_the_car_and_has_its_colours(outputs, solution):
    output = outputs(num_seed_points=3000)
    known = len(known_points(solution))
    points, colours = output.metadata["points3D_xyz"][known:], output.metadata["points3D_rgb"][known:]
    assert 300 < len(points) <= 3000
    keypoints = output.metadata["points3D_xyz"][:known]
    length = (keypoints.amax(0) - keypoints.amin(0)).max()
    off = torch.cdist(points, keypoints).amin(1)
    assert off.median() < 0.12 * length  # keypoints are on the surface
    blue = colours.float().mean(0)
    assert blue[2] > blue[0] + 15, "the procedural car is blue"


def test_without_masks_seeds_lie_on_the_ground_too(outputs):
    with_ground = outputs(num_seed_points=600, seeds="box", background="keep").metadata["points3D_xyz"]
    without = outputs(num_seed_points=600, seeds="box").metadata["points3D_xyz"]
    assert len(with_ground) == len(without) + 300
    ground = with_ground[-300:]
    assert (ground[:, 2] == ground[0, 2]).all()
    assert ground[:, :2].norm(dim=1).max() > 0.8


# ---- what a user can get wrong


@pytest.fixture
def refused(parser, capsys):
    """Exit status 2 and one line on stderr that holds all parts."""

    def check(*parts: str, status: int = 2, **options) -> None:
        capsys.readouterr()
        with pytest.raises(SystemExit) as caught:
            parser(**options).get_dataparser_outputs()
        err = capsys.readouterr().err
        assert caught.value.code == status
        assert err.count("\n") == 1
        for part in parts:
            assert part in err

    return check


def test_poses_nobody_can_trust_are_not_trained_on(refused, place):
    (place / "hasty.yaml").write_text("solver: adam\nadam:\n  steps: 3\n")
    for _ in range(2):  # solved, then from the cache
        refused("failed", "px", status=3, config=str(place / "hasty.yaml"))


def test_a_loss_that_is_not_finite_ends_as_clearly(refused, place):
    (place / "wild.yaml").write_text("solver: adam\nadam:\n  steps: 20\n  learning_rate: 1.0e+30\n")
    refused("failed", status=3, config=str(place / "wild.yaml"))


def test_a_solution_that_is_not_finite_is_an_error(refused, place):
    (place / "wilder.yaml").write_text("solver: adam\nadam:\n  steps: 20\n  learning_rate: 1.0e+38\n")
    refused("not finite", "learning_rate", config=str(place / "wilder.yaml"))


def test_options_that_cannot_be_are_named(refused, tmp_path):
    refused("eval_interval is 1", eval_interval=1)
    refused("eval_fraction is 1.5", eval_fraction=1.5)
    refused("downscale_factor is 0", downscale_factor=0)
    for value in (0.0, -1.0, float("nan"), float("inf")):
        refused(f"scale_factor is {value:g}", scale_factor=value)
        refused(f"scene_scale is {value:g}", scene_scale=value)
    refused("num_seed_points is -1", num_seed_points=-1)
    refused("images_4", "does not exist", downscale_factor=4)
    refused("nowhere", data=tmp_path / "nowhere")
    refused("'nothing'", "phone_walk", config="nothing")


def test_images_that_only_folders_tell_apart_are_refused(refused, changed, edit):
    shutil.copytree(changed / "images", changed / "others")
    for file in ("transforms.json", "keypoints.json"):
        edit(changed / file, lambda c: c["frames"][1].update(file_path="others/frame_00001.png"))
    refused("2 images in different folders are called frame_00001.png", data=changed)


def test_missing_images_are_named(refused, changed):
    shutil.rmtree(changed / "images")
    refused("images/frame_00002.png", "does not exist", data=changed)


def test_a_frame_that_was_not_solved_is_named(refused, changed, solution, edit):
    write_solution(changed, load_scene(changed), solution, changed, "inputs")
    shutil.copy(changed / "images/frame_00001.png", changed / "images/later.png")
    edit(changed / "transforms.json", lambda c: c["frames"].append({**c["frames"][0], "file_path": "images/later.png"}))
    refused("images/later.png", "not among the views", data=changed, config=None)


def test_a_cache_that_cannot_be_written_is_named(refused, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("KRONC_NS_CACHE", str(tmp_path / "file"))
    refused("file", "cannot be written")
