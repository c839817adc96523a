"""Vehicles cut out of their background."""

import hashlib
import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from kronc_ns.capture.images import load_image
from kronc_ns.errors import KroncError
from kronc_ns.files.cache import cache_folder
from kronc_ns.files.images import read_grey
from kronc_ns.files.output import atomic_path


def cut_out(images: Sequence[Path], masks: Sequence[Path]) -> list[Path]:
    """RGBA copies of images whose alpha is the mask (times their own alpha), kept in the cache.

    A copy is made once, and named by the content of its sources. What is returned are links to the copies, in one
    folder and under the images' names, by which nerfstudio calls renderings and exported cameras.
    """
    copies = [_cut_out(image, mask) for image, mask in zip(images, masks, strict=True)]
    alike = Counter(image.stem for image in images)
    names = [f"{image.stem if alike[image.stem] == 1 else image.name}.png" for image in images]
    content = hashlib.sha256(repr([(name, copy.name) for name, copy in zip(names, copies, strict=True)]).encode())
    folder = cache_folder() / "cut_out" / "named" / content.hexdigest()[:32]
    return [_linked(folder / name, copy) for name, copy in zip(names, copies, strict=True)]


def _linked(link: Path, copy: Path) -> Path:
    if not link.exists():
        with atomic_path(link) as temporary:
            temporary.symlink_to(os.path.relpath(copy, link.parent))
    return link


def _cut_out(image: Path, mask: Path) -> Path:
    content = hashlib.sha256(image.read_bytes() + mask.read_bytes()).hexdigest()[:32]
    copy = cache_folder() / "cut_out" / content[:2] / f"{content}.png"
    if not copy.exists():
        alpha, rgba = read_grey(mask), np.array(load_image(image).convert("RGBA"))
        if rgba.shape[:2] != alpha.shape:
            raise KroncError(f"{mask} is {alpha.shape[::-1]}, its image {rgba.shape[1::-1]}: expected equal sizes")
        rgba[..., 3] = np.where(alpha > 0, rgba[..., 3], 0)
        with atomic_path(copy) as temporary:
            Image.fromarray(rgba).save(temporary, format="PNG", compress_level=1)
    return copy
