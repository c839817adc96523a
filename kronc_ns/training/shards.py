"""Rendered pictures on disk: files of some dozens, written whole or not at all, held in memory while training."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from kronc_ns.errors import KroncError
from kronc_ns.files.output import atomic_path

_JPEG_QUALITY = 95


@dataclass(frozen=True, eq=False)
class Picture:
    """One car, rendered."""

    rgb: UInt8[np.ndarray, "h w 3"]
    mask: UInt8[np.ndarray, "h w"]
    """255 on the car."""
    keypoints: Float[np.ndarray, "66 3"]
    """u, v, state; pixels as everywhere (centre of the first one at 0.5). State 0: the car has no such point,
    1: visible, 2: hidden or outside the picture."""
    body: str = ""


class Pictures(Sequence[Picture]):
    """All pictures of a folder's shards; compressed in memory, decoded one at a time."""

    def __init__(self, files: Sequence[Path]) -> None:
        if not files:
            raise KroncError("no pictures to train on: render some first")
        self._shards = [dict(np.load(file)) for file in files]
        counts = [len(shard["keypoints"]) for shard in self._shards]
        self._starts = np.concatenate([[0], np.cumsum(counts)])

    def __len__(self) -> int:
        return int(self._starts[-1])

    def __getitem__(self, index: int) -> Picture:  # pyright: ignore[reportIncompatibleMethodOverride]
        if not 0 <= index < len(self):
            raise IndexError(index)
        number = int(np.searchsorted(self._starts, index, side="right")) - 1
        shard, row = self._shards[number], index - int(self._starts[number])
        rgb = cv2.imdecode(_piece(shard, "rgb", row), cv2.IMREAD_COLOR)[..., ::-1]
        mask = cv2.imdecode(_piece(shard, "mask", row), cv2.IMREAD_GRAYSCALE)
        keypoints = shard["keypoints"][row].astype(np.float64)
        return Picture(np.ascontiguousarray(rgb), mask, keypoints, str(shard["body"][row]))


def write_shard(file: Path, pictures: Sequence[Picture]) -> None:
    """Write pictures as JPEG and masks as PNG into one .npz file."""
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    rgb = [cv2.imencode(".jpg", picture.rgb[..., ::-1], quality)[1] for picture in pictures]
    mask = [cv2.imencode(".png", picture.mask)[1] for picture in pictures]
    with atomic_path(file) as temporary, temporary.open("wb") as out:
        np.savez(
            out,
            **_packed("rgb", rgb),
            **_packed("mask", mask),
            keypoints=np.array([picture.keypoints for picture in pictures], dtype=np.float32),
            body=np.array([picture.body for picture in pictures]),
        )


def _packed(name: str, pieces: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    ends = np.cumsum([0, *(piece.size for piece in pieces)])
    return {name: np.concatenate([piece.ravel() for piece in pieces]), f"{name}_at": ends}


def _piece(shard: dict[str, np.ndarray], name: str, row: int) -> np.ndarray:
    start, end = shard[f"{name}_at"][row : row + 2]
    return shard[name][start:end]
