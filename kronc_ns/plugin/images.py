"""Images as a method gets them: at the resolution asked for, and cut out of their background."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from kronc_ns.errors import KroncError
from kronc_ns.files.cache import cache_folder
from kronc_ns.files.output import atomic_path
from kronc_ns.scene import Scene

_MAX_AUTO_SIDE = 1600  # nerfstudio's own limit for choosing a downscaled folder


@dataclass(frozen=True)
class Downscaled:
    """Where the images of a scene folder lie at 1/``factor`` of their size."""

    data: Path
    factor: int

    def path(self, name: str) -> Path:
        """Path of an image or mask at this size (images_2/..., masks_2/...)."""
        original = self.data / name
        if self.factor == 1:
            return original
        return original.parent.parent / f"{original.parent.name}_{self.factor}" / original.name


def downscaled(data: Path, scene: Scene, factor: int | None) -> Downscaled:
    """The folder for a wanted ``factor``, or (None) the largest images whose longer side is below 1600 px."""
    if factor is not None:
        if factor < 1:
            raise KroncError(f"downscale_factor is {factor}: expected 1, 2, 4 or 8")
        return Downscaled(data, factor)
    factor = 1
    while max(scene.camera.width, scene.camera.height) / factor > _MAX_AUTO_SIDE:
        if not Downscaled(data, 2 * factor).path(scene.names[0]).exists():
            break
        factor *= 2
    return Downscaled(data, factor)


def cut_out(images: list[Path], masks: list[Path]) -> list[Path]:
    """RGBA copies of images whose alpha is the mask (times their own alpha), kept in the cache.

    A copy is named by the content of its sources and made once.
    """
    return [_cut_out(image, mask) for image, mask in zip(images, masks, strict=True)]


def _cut_out(image: Path, mask: Path) -> Path:
    content = hashlib.sha256(image.read_bytes() + mask.read_bytes()).hexdigest()[:32]
    copy = cache_folder() / "cut_out" / content[:2] / f"{content}.png"
    if not copy.exists():
        alpha = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)
        if alpha is None:
            raise KroncError(f"{mask} is no image: expected a mask with 0 outside the car")
        try:
            rgba = np.array(Image.open(image).convert("RGBA"))
        except OSError:
            raise KroncError(f"{image} is no image that can be read") from None
        if rgba.shape[:2] != alpha.shape:
            raise KroncError(f"{mask} is {alpha.shape[::-1]}, its image {rgba.shape[1::-1]}: expected equal sizes")
        rgba[..., 3] = np.where(alpha > 0, rgba[..., 3], 0)
        with atomic_path(copy) as temporary:
            Image.fromarray(rgba).save(temporary, format="PNG", compress_level=1)
    return copy
