"""Photos that show the same as the one before (bursts, copies, two formats of one photo) are left out."""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import ImageOps

from kronc_ns.capture.images import load_small
from kronc_ns.capture.progress import Count
from kronc_ns.capture.selection import distinct
from kronc_ns.capture.source import MIN_FRAMES, Source
from kronc_ns.errors import KroncError

_LONG_SIDE = 960  # px of the copies on which photos are compared


def without_duplicates(source: Source, size: tuple[int, int], progress: Count | None = None) -> Source:
    """Photos of (width, height) ``size`` without those in which nothing has moved, of which the sharpest stays.

    Decodes them all, so that one that cannot be read is named before anything is written. What is no folder of photos
    stays as it is: a scene folder lists its images on purpose.
    """
    if source.kind != "photos":
        return source
    taken = distinct(_greys(source.images, size, progress))
    if len(taken) < MIN_FRAMES:
        raise KroncError(
            f"{source.path} holds {len(taken)} different photos ({len(source.images) - len(taken)} show nothing new): "
            f"expected at least {MIN_FRAMES} views of the car; --keep-duplicates takes them all"
        )
    left_out = sorted({*range(len(source.images))} - {*taken})
    if not left_out:
        return source
    names = tuple(source.names[i] for i in left_out)
    listed = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
    note = f"{len(left_out)} that show nothing new were left out ({listed}; --keep-duplicates takes them)"
    return replace(
        source,
        images=tuple(source.images[i] for i in taken),
        names=tuple(source.names[i] for i in taken),
        note="; ".join([note, source.note] if source.note else [note]),
        left_out=tuple(source.images[i] for i in left_out),
    )


def _greys(images: Sequence[Path], size: tuple[int, int], progress: Count | None) -> Iterator[UInt8[np.ndarray, "h w"]]:
    """Small upright copies of one size, read by a few threads."""
    factor = min(1.0, _LONG_SIDE / max(size))
    small = (max(1, round(size[0] * factor)), max(1, round(size[1] * factor)))
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        for done, grey in enumerate(pool.map(partial(_grey, small), images), start=1):
            if progress is not None:
                progress(done, len(images), None)
            yield grey


def _grey(size: tuple[int, int], image: Path) -> UInt8[np.ndarray, "h w"]:
    upright = ImageOps.exif_transpose(load_small(image, max(size)))
    return cv2.resize(np.asarray(upright.convert("L")), size, interpolation=cv2.INTER_AREA).astype(np.uint8)
