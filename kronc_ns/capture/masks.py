"""Masks in nerfstudio's layout: masks/frame_00001.png, 255 where to look and 0 where not, with downscaled copies."""

import re
from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from kronc_ns.capture.frames import Frames
from kronc_ns.capture.images import level_path
from kronc_ns.capture.photos import list_below
from kronc_ns.capture.source import MIN_FRAMES
from kronc_ns.errors import KroncError
from kronc_ns.files.images import read_mask

_NEW_STEM = re.compile(r"frame_\d{5,}")


def check_masks(masks: Path | tuple[Path, ...], frames: Frames | None, size: tuple[int, int]) -> None:
    """Raise `KroncError` where a mask is missing or is none for frames of (width, height) ``size``.

    ``frames`` is None where they are not chosen yet: of a video, whose masks are called as its frames will be.
    """
    if isinstance(masks, tuple):
        files = masks
    else:
        files = _masks_of_video(masks) if frames is None else find_masks(masks, frames)
    sizes = [size] * len(files) if frames is None else frames.sizes
    for file, own in dict.fromkeys(zip(files, sizes, strict=True)):
        read_mask(file, own)


def find_masks(masks: Path | tuple[Path, ...], frames: Frames) -> tuple[Path, ...]:
    """The mask file of each frame: as listed, one image for all, or those of a folder.

    There they have the path of the photo, from whichever of its folders on, or the stem of the photo or of the new
    name, with any suffix; a folder with nothing but mask.png (as nerfstudio writes it) has one for all.
    """
    if isinstance(masks, tuple):
        return masks
    if (one := _one_for_all(masks)) is not None:
        return (one,) * len(frames.names)
    files = _by_name(masks)
    wanted = [names for names in _possible_names(frames) if len({*names}) == len(names)]  # a mask is for one image
    for names in wanted:
        if all(name in files for name in names):
            return tuple(files[name] for name in names)
    names = max(wanted, key=lambda names: sum(name in files for name in names))
    missing = [name for name in names if name not in files]
    raise KroncError(
        f"{masks} lacks a mask for {missing[0]} ({len(missing)} of {len(names)} are missing): "
        f"expected one for every image, like {names[0]}.png, or as --masks one image for all"
    )


def _masks_of_video(masks: Path) -> tuple[Path, ...]:
    if (one := _one_for_all(masks)) is not None:
        return (one,)
    files = tuple(file for name, file in _by_name(masks).items() if _NEW_STEM.fullmatch(name))
    if len(files) < MIN_FRAMES:
        raise KroncError(
            f"{masks} holds {len(files)} masks called as the frames of a video will be: expected frame_00001.png and "
            "so on, or as --masks one image for all; --detector none writes the frames alone, to make masks of"
        )
    return files


def _one_for_all(masks: Path) -> Path | None:
    if masks.is_file():
        return masks
    if not masks.is_dir():
        raise KroncError(
            f"{masks} is no folder and no image: expected a mask for each photo, of the same stem, or one for all"
        )
    files = _by_name(masks)
    return files["mask"] if [*files] == ["mask"] else None


def _by_name(folder: Path) -> dict[str, Path]:
    """Images of a folder and its subfolders, by path without suffix."""
    return {file.relative_to(folder).with_suffix("").as_posix(): file for file in list_below(folder)}


def _possible_names(frames: Frames) -> list[list[str]]:
    """Ways of naming the masks of all frames, without suffix."""
    paths = [PurePosixPath(name).with_suffix("") for name in frames.source_names]
    levels = zip(*(path.parent.parts for path in paths), strict=False)
    shared = sum(1 for _ in takewhile(lambda folders: len({*folders}) == 1, levels))
    by_path = [["/".join(path.parts[cut:]) for path in paths] for cut in range(shared + 1)]
    return [*by_path, *([_stem(name) for name in names] for names in (frames.source_names, frames.names))]


def write_masks(files: Sequence[Path], frames: Frames, out: Path) -> tuple[str, ...]:
    """Write ``files`` as masks of ``frames`` with all downscaled copies; their new paths."""
    names = tuple(f"masks/{_stem(name)}.png" for name in frames.names)
    for file, name, size in zip(files, names, frames.sizes, strict=True):
        mask = read_mask(file, size)
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
