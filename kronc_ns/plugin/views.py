"""The views of a solved scene as training takes them, aligned: image, mask, pose, and whether it tests."""

from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Bool, Float

from kronc_ns.capture.images import level_path
from kronc_ns.errors import KroncError
from kronc_ns.geometry.camera import Camera
from kronc_ns.geometry.poses import posed
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution

_MAX_AUTO_SIDE = 1600  # nerfstudio's own limit for choosing a downscaled folder


@dataclass(frozen=True)
class SolvedViews:
    """N views in capture order."""

    images: tuple[Path, ...]
    masks: tuple[Path, ...] | None
    cameras: tuple[Camera, ...]
    c2w: Float[np.ndarray, "n 3 4"]
    """Poses in the solved world (OpenCV axes); NaN where there is none."""
    test: Bool[np.ndarray, "n"]
    """Which views training must not see."""

    @property
    def posed(self) -> Bool[np.ndarray, "n"]:
        """Which views have a pose."""
        return posed(self.c2w)

    def of_split(self, split: str) -> "SolvedViews":
        """The views with a pose of nerfstudio's split train, val, test or all; `KroncError` where there are none."""
        parts = {"train": ~self.test, "val": self.test, "test": self.test, "all": np.ones_like(self.test)}
        if split not in parts:
            raise KroncError(f"unknown split {split!r}: expected train, val, test or all")
        chosen = np.flatnonzero(parts[split] & self.posed)
        if not len(chosen):
            total = len(self.images)
            raise KroncError(f"no view is left for the {split} split: {self.posed.sum()} of {total} views have a pose")
        masks = None if self.masks is None else tuple(self.masks[i] for i in chosen)
        images, cameras = (tuple(of[i] for i in chosen) for of in (self.images, self.cameras))
        return SolvedViews(images, masks, cameras, self.c2w[chosen], self.test[chosen])

    def at_level(self, factor: int) -> "SolvedViews":
        """With the images and masks at 1/``factor`` of their size; raises `KroncError` where one does not exist."""
        images = tuple(level_path(path, factor) for path in self.images)
        masks = None if self.masks is None else tuple(level_path(path, factor) for path in self.masks)
        missing = [path for path in [*images, *(masks or ())] if not path.exists()]
        if missing:
            remedy = "" if factor == 1 else "; `ns-process-data kronc` writes those of 1/2, 1/4 and 1/8"
            raise KroncError(
                f"{missing[0]} does not exist: training needs the images ({len(missing)} are missing){remedy}"
            )
        return replace(self, images=images, masks=masks)


def solved_views(data: Path, scene: Scene, solution: Solution, test: Bool[np.ndarray, "m"]) -> SolvedViews:
    """The views of ``scene``, which was read from the folder ``data``, with their poses in ``solution``.

    ``test`` is of the solution's M views, which may be more than the scene's: those that failed, too. The solution may
    have been found for a copy of the folder, so views are known by their file names.
    """
    place = {PurePosixPath(name).name: i for i, name in enumerate(solution.names)}
    unknown = [name for name in scene.names if PurePosixPath(name).name not in place]
    if unknown:
        raise KroncError(f"{data / unknown[0]} is not among the views of {data / 'kronc.json'}: solve again")
    rows = np.array([place[PurePosixPath(name).name] for name in scene.names])
    masks = None if scene.masks is None else tuple(data / mask for mask in scene.masks)
    images = tuple(data / name for name in scene.names)
    cameras = tuple(solution.camera_of(row) for row in rows.tolist())
    return SolvedViews(images, masks, cameras, solution.c2w[rows], test[rows])


def test_views(views: int, interval: int, fraction: float | None) -> Bool[np.ndarray, "n"]:
    """Which views are test views: every ``interval``-th from the first on, or an evenly spread ``fraction``."""
    test = np.zeros(views, dtype=bool)
    if fraction is None:
        if interval < 2:
            raise KroncError(f"eval_interval is {interval}: expected 2 or more, or nothing is left to train on")
        test[::interval] = True
    else:
        if not 0 < fraction < 1:
            raise KroncError(f"eval_fraction is {fraction}: expected a share above 0 and below 1")
        count = min(max(1, round(views * fraction)), views - 1)
        test[np.linspace(0, views, count, endpoint=False).astype(int)] = True
    return test


def image_level(image: Path, size: tuple[int, int], wanted: int | None) -> int:
    """The factor that is ``wanted``, or (None) that of the largest images whose longer side is below 1600 px.

    ``image`` is one of the images, ``size`` their width and height.
    """
    if wanted is not None:
        if wanted < 1:
            raise KroncError(f"downscale_factor is {wanted}: expected 1, 2, 4 or 8")
        return wanted
    factor = 1
    while max(size) / factor > _MAX_AUTO_SIDE and level_path(image, 2 * factor).exists():
        factor *= 2
    return factor
