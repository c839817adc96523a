"""A small picture of a result, for the page of the fleet."""

from pathlib import Path

import numpy as np

from kronc_ns.files.output import read_json
from kronc_ns.files.record import solved_points
from kronc_ns.files.transforms import read_poses

_WIDTH, _HEIGHT = 128, 96
_POINT, _CAMERA = "#009e73", "#0072b2"


def write_thumbnail(folder: Path) -> None:
    """Write thumbnail.jpg, one of the images of a result, or thumbnail.svg: cameras and car from above."""
    frames = read_json(folder / "transforms.json")["frames"]
    images = [folder / str(frame["file_path"]) for frame in frames]
    shown = images[len(images) // 8] if images else folder
    if shown.is_file() and shown.is_relative_to(folder) and folder / "images" in shown.parents:
        _write_image(shown, folder / "thumbnail.jpg")
    elif images:
        _write_plan(folder, folder / "thumbnail.svg")


def _write_image(image: Path, target: Path) -> None:
    from PIL import Image

    with Image.open(image) as picture:
        picture.thumbnail((_WIDTH, _HEIGHT))
        picture.convert("RGB").save(target, quality=70)


def _write_plan(folder: Path, target: Path) -> None:
    cameras = np.stack([*read_poses(folder / "transforms.json").values()])[:, :2, 3]
    points = solved_points(folder).reshape(-1, 3)[:, :2]
    every = np.concatenate([cameras, points])
    low, high = every.min(0), every.max(0)
    scale = 0.9 * min(_WIDTH, _HEIGHT) / max(float((high - low).max()), 1e-9)
    middle = (low + high) / 2

    def dots(places: np.ndarray, radius: float, colour: str) -> str:
        at = (places - middle) * (scale, -scale) + (_WIDTH / 2, _HEIGHT / 2)
        path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in at)
        return f'<path d="{path}" stroke="{colour}" stroke-width="{2 * radius}" stroke-linecap="round"/>'

    target.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}">'
        f"{dots(points, 1.0, _POINT)}{dots(cameras, 1.8, _CAMERA)}</svg>\n"
    )
