"""A rendered walk with photos, its keypoints and its truth."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from kronc_ns.files.photos import photos
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.refine.pictures import Picture
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import make_capture

VIEWS = 16


@pytest.fixture(scope="session")
def walk(tmp_path_factory):
    """(folder, capture) of a walk with photos and keypoints of 1 px."""
    folder = tmp_path_factory.mktemp("refine") / "walk"
    capture = make_capture("walk", VIEWS, 3, noise_px=1.0)
    write_capture(folder, capture, None, True, True, lambda _: None)
    return folder, capture


@pytest.fixture(scope="session")
def solved(walk):
    """(scene, solution) from the keypoints."""
    scene = load_scene(walk[0])
    return scene, solve_scene(scene, KroncConfig())


def altered(folder: Path, scene, change):
    """The photos after ``change(view, picture)``."""
    read = photos(folder, scene)
    return lambda view: change(view, read(view))


def without_masks(_, picture):
    return replace(picture, vehicle=None)


def still_background(folder: Path, scene, masked: bool):
    """The first photo's surroundings behind the car in all of them."""
    read = photos(folder, scene)
    first = read(0)
    behind = cv2.inpaint(first.rgb, cv2.dilate(first.vehicle, np.ones((9, 9), np.uint8)), 3, cv2.INPAINT_TELEA)

    def picture(view: int) -> Picture:
        own = read(view)
        rgb = np.where(own.vehicle[..., None] > 0, own.rgb, behind)
        return Picture(rgb, own.vehicle if masked else None)

    return picture
