"""Masks as nerfstudio takes them: one a frame, one for all, in subfolders, or as transforms.json lists them."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from kronc_ns.capture.frames import Frames, plan_frames, prepare_frames
from kronc_ns.capture.masks import check_masks, find_masks, write_masks
from kronc_ns.capture.source import find_source
from kronc_ns.errors import KroncError

SIZE = (240, 202)
CAMERA = {"fl_x": 200.0, "cx": 120.0, "cy": 101.0, "w": SIZE[0], "h": SIZE[1]}


def mask(path: Path, left: int, size: tuple[int, int] = SIZE) -> Path:
    """The car from column ``left`` on."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.zeros(size[::-1], np.uint8)
    pixels[:, left:] = 255
    Image.fromarray(pixels).save(path)
    return path


def photo(path: Path, seed: int) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.random.default_rng(seed).integers(0, 255, (*SIZE[::-1], 3), dtype=np.uint8)).save(path)
    return path


def scene(folder: Path, names: list[str], **of_frames: list[str]) -> Path:
    for i, name in enumerate(names):
        photo(folder / name, i)
    frames = [{"file_path": name} for name in names]
    for key, values in of_frames.items():
        for frame, value in zip(frames, values, strict=False):
            frame[key] = value
    (folder / "transforms.json").write_text(json.dumps({**CAMERA, "frames": frames}))
    return folder


def prepared(data: Path, out: Path) -> Frames:
    out.mkdir(exist_ok=True)
    return prepare_frames(find_source(data), out)


def lefts(out: Path, names: tuple[str, ...]) -> list[int]:
    """Where the car begins in each mask; half of that in the half-size copies."""
    found = []
    for name in names:
        with Image.open(out / name) as whole, Image.open(out / name.replace("masks", "masks_2")) as half:
            assert whole.size == SIZE
            assert half.size == (SIZE[0] // 2, SIZE[1] // 2)
            found.append(int((np.array(whole)[0] == 0).sum()))
            assert abs(2 * (np.array(half)[0] == 0).sum() - found[-1]) <= 1
    return found


def test_one_image_serves_all_frames(tmp_path: Path):
    for i in range(4):
        photo(tmp_path / "photos" / f"IMG_{i}.png", i)
    frames = prepared(tmp_path / "photos", tmp_path / "out")
    one = mask(tmp_path / "car.png", 80)
    check_masks(one, frames, SIZE)
    assert lefts(tmp_path / "out", write_masks(find_masks(one, frames), frames, tmp_path / "out")) == [80] * 4


def test_a_folder_with_nerfstudios_one_mask_serves_all_frames(tmp_path: Path):
    for i in range(3):
        photo(tmp_path / "photos" / "images" / f"IMG_{i}.png", i)
    one = mask(tmp_path / "photos" / "masks" / "mask.png", 80)
    frames = prepared(tmp_path / "photos", tmp_path / "out")
    masks = find_source(tmp_path / "photos").masks
    assert masks == one.parent
    assert find_masks(masks, frames) == (one,) * 3
    one.rename(one.with_name("IMG_0.png"))  # one of three, more likely
    with pytest.raises(KroncError, match=r"lacks a mask for IMG_1 \(2 of 3 are missing\).*or as --masks one image"):
        find_masks(masks, frames)


@pytest.mark.parametrize("depth", ["", "images/", "data/images/"])
def test_masks_of_subfolders_go_by_relative_path(tmp_path: Path, depth: str):
    """Equal names in two folders, told apart by them, from whichever folder on."""
    names = [f"{depth}{round_}/{i}.png" for round_ in ("low", "high") for i in range(3)]
    scene(tmp_path / "scene", names)
    frames = prepared(tmp_path / "scene", tmp_path / "out")
    parts = names[0].split("/")
    for cut in range(len(parts) - 1):
        folder = tmp_path / f"masks_from_{cut}"
        for i, name in enumerate(names):
            mask(folder / "/".join(name.split("/")[cut:]), 10 * i)
        check_masks(folder, frames, SIZE)
        names_out = write_masks(find_masks(folder, frames), frames, tmp_path / "out")
        assert lefts(tmp_path / "out", names_out) == [0, 10, 20, 30, 40, 50]
    (folder / "high/2.png").unlink()
    with pytest.raises(KroncError, match=r"lacks a mask for high/2 \(1 of 6 are missing\): .* like low/0\.png"):
        check_masks(folder, frames, SIZE)


def test_masks_of_photos_in_subfolders(tmp_path: Path):
    for i in range(4):
        photo(tmp_path / "photos" / ("low", "high")[i % 2] / f"IMG_{i // 2}.jpg", i)
        mask(tmp_path / "masks" / ("low", "high")[i % 2] / f"IMG_{i // 2}.png", 10 * i)
    frames = prepared(tmp_path / "photos", tmp_path / "out")
    assert frames.source_names == ("high/IMG_0.jpg", "high/IMG_1.jpg", "low/IMG_0.jpg", "low/IMG_1.jpg")
    names = write_masks(find_masks(tmp_path / "masks", frames), frames, tmp_path / "out")
    assert lefts(tmp_path / "out", names) == [10, 30, 0, 20]


def test_masks_of_transforms_json_are_used(tmp_path: Path):
    """Whatever they are called, also one for all as nerfstudio writes it, rather than a folder beside the images."""
    names = [f"images/{i}.png" for i in range(3)]
    for i in range(3):
        mask(tmp_path / "scene" / "cut" / f"{'cab'[i]}.png", 20 * i)
        mask(tmp_path / "scene" / "masks" / f"{i}.png", 99)
    data = scene(tmp_path / "scene", names, mask_path=["cut/c.png", "cut/a.png", "cut/b.png"])
    frames = prepared(data, tmp_path / "out")
    masks = find_source(data).masks
    check_masks(masks, frames, SIZE)
    names_out = write_masks(find_masks(masks, frames), frames, tmp_path / "out")
    assert lefts(tmp_path / "out", names_out) == [0, 20, 40]
    scene(tmp_path / "scene", names, mask_path=["cut/b.png"] * 3)
    again = write_masks(find_masks(find_source(data).masks, frames), frames, tmp_path / "out")
    assert lefts(tmp_path / "out", again) == [40] * 3


@pytest.mark.parametrize("key", ["mask_path", "depth_file_path"])
def test_lists_with_holes_are_named(tmp_path: Path, key: str):
    names = [f"images/{i}.png" for i in range(4)]
    mask(tmp_path / "masks" / "0.png", 0)
    scene(tmp_path, names, **{key: ["masks/0.png"] * 2})
    with pytest.raises(KroncError, match=rf"frame images/2\.png lacks a {key} that others have \(2 of 4 lack it\)"):
        find_source(tmp_path)


def test_masks_that_do_not_fit_are_named_from_the_plan(tmp_path: Path):
    """Before a frame is written."""
    for i in range(3):
        photo(tmp_path / "photos" / f"IMG_{i}.png", i)
        mask(tmp_path / "masks" / f"IMG_{i}.png", 10, SIZE if i < 2 else SIZE[::-1])
    source = find_source(tmp_path / "photos")
    planned = plan_frames(source)
    assert planned is not None
    with pytest.raises(KroncError, match=r"IMG_2\.png is 202x240, its image 240x202: expected masks in the pixels"):
        check_masks(tmp_path / "masks", planned, planned.size)
    (tmp_path / "masks" / "IMG_2.png").write_bytes(b"none")
    with pytest.raises(KroncError, match=r"IMG_2\.png is no image that can be read: expected a mask"):
        check_masks(tmp_path / "masks", planned, planned.size)
    Image.new("L", SIZE, 1).save(tmp_path / "masks" / "IMG_2.png")
    with pytest.raises(KroncError, match=r"IMG_2\.png has no value above 1"):
        check_masks(tmp_path / "masks", planned, planned.size)
    with pytest.raises(KroncError, match=r"nothing is no folder and no image"):
        check_masks(tmp_path / "nothing", planned, planned.size)


def test_masks_of_a_video_are_checked_before_its_frames_are_chosen(tmp_path: Path):
    masks = tmp_path / "masks"
    check_masks(mask(tmp_path / "one.png", 10), None, SIZE)
    with pytest.raises(KroncError, match=r"one\.png is 240x202, its image 202x240"):
        check_masks(tmp_path / "one.png", None, SIZE[::-1])
    for i in range(1, 4):
        mask(masks / f"IMG_{i}.png", 10)
    with pytest.raises(KroncError, match=r"holds 0 masks called as the frames of a video will be.*frame_00001\.png"):
        check_masks(masks, None, SIZE)
    for i in range(1, 4):
        mask(masks / f"frame_{i:05d}.png", 10)
    check_masks(masks, None, SIZE)
    mask(masks / "frame_00002.png", 10, (100, 100))
    with pytest.raises(KroncError, match=r"frame_00002\.png is 100x100, its image 240x202"):
        check_masks(masks, None, SIZE)
