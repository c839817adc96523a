"""Masks in nerfstudio's layout: masks/frame_00001.png, 255 where to look and 0 where not, with downscaled copies."""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from kronc_ns.capture.frames import Frames
from kronc_ns.capture.images import level_path
from kronc_ns.capture.source import IMAGE_SUFFIXES
from kronc_ns.errors import KroncError
from kronc_ns.files.images import read_mask


def find_masks(masks: Path | tuple[Path, ...], frames: Frames) -> tuple[Path, ...]:
    """The mask file of each frame: as listed, or in a folder under the stem of the photo or of the new name."""
    if isinstance(masks, tuple):
        return masks
    if not masks.is_dir():
        raise KroncError(f"{masks} is no folder: expected one mask image per photo, of the same stem")
    files = {file.stem: file for file in sorted(masks.iterdir()) if file.suffix.lower() in IMAGE_SUFFIXES}
    wanted = [[_stem(name) for name in names] for names in (frames.source_names, frames.names)]
    wanted = [stems for stems in wanted if len({*stems}) == len(stems)]  # a mask is for one image
    for stems in wanted:
        if all(stem in files for stem in stems):
            return tuple(files[stem] for stem in stems)
    stems = max(wanted, key=lambda stems: sum(stem in files for stem in stems))
    missing = [stem for stem in stems if stem not in files]
    raise KroncError(
        f"{masks} lacks a mask for {missing[0]} ({len(missing)} of {len(stems)} are missing): "
        f"expected one for every image, like {stems[0]}.png"
    )


def write_masks(files: Sequence[Path], frames: Frames, out: Path) -> tuple[str, ...]:
    """Write ``files`` as masks of ``frames`` with all downscaled copies; their new paths."""
    names = tuple(f"masks/{_stem(name)}.png" for name in frames.names)
    for file, name in zip(files, names, strict=True):
        mask = read_mask(file, frames.size)
        for factor in (1, *frames.factors):
            path = level_path(out / name, factor)
            path.parent.mkdir(exist_ok=True)
            Image.fromarray(downscale_mask(mask, factor)).save(path)
    return names


def downscale_mask(mask: UInt8[np.ndarray, "h w"], factor: int) -> UInt8[np.ndarray, "h2 w2"]:
    """The pixel nearest to the middle of each ``factor`` x ``factor`` block; left-over rows and columns are cut off."""
    height, width = (side // factor * factor for side in mask.shape)
    return mask[factor // 2 : height : factor, factor // 2 : width : factor]


def _stem(name: str) -> str:
    return PurePosixPath(name).stem
