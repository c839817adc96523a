"""Images that say something about a view's pixels: masks (0 = ignore) and depth maps."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from kronc_ns.errors import KroncError
from kronc_ns.geometry.camera import Camera

_DEPTH_UNIT_M = 1e-3  # nerfstudio's depth maps are 16-bit millimetres


def read_grey(file: Path) -> UInt8[np.ndarray, "h w"]:
    """A mask as its file has it: 0 where to ignore."""
    import cv2

    mask = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    if mask is None:
        raise KroncError(f"{file} is no image that can be read: expected a mask, 0 outside the car and 255 on it")
    return mask


def read_mask(file: Path, size: tuple[int, int]) -> UInt8[np.ndarray, "h w"]:
    """255 where the file is above 127, else 0; ``size`` is the (width, height) it must have."""
    mask = read_grey(file)
    if mask.shape[::-1] != size:
        raise KroncError(
            f"{file} is {mask.shape[1]}x{mask.shape[0]}, its image {size[0]}x{size[1]}: "
            "expected masks in the pixels of the images"
        )
    if 0 < mask.max() <= 127:
        raise KroncError(f"{file} has no value above {mask.max()}: expected 0 outside the car and 255 on it")
    return np.where(mask > 127, 255, 0).astype(np.uint8)


def depth_under(
    row: Float[np.ndarray, "j 3"], depth_map: Float[np.ndarray, "h w"], camera: Camera
) -> Float[np.ndarray, "j"]:
    """Depth in the pixel of each keypoint (u, v, confidence) of one view; NaN where not seen or not above 0.

    The map covers the whole image of ``camera`` at any resolution.
    """
    scale = np.array([depth_map.shape[1] / camera.width, depth_map.shape[0] / camera.height])
    column, line = np.floor(row[:, :2] * scale).astype(int).T
    inside = (column >= 0) & (line >= 0) & (column < depth_map.shape[1]) & (line < depth_map.shape[0])
    seen = inside & (row[:, 2] > 0)
    depth = np.zeros(len(row))
    depth[seen] = depth_map[line[seen], column[seen]]
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)


def read_depth(path: Path) -> Float[np.ndarray, "h w"]:
    """Depth map in metres from a .npy of metres or a 16-bit image of millimetres; 0 where unknown."""
    import cv2

    try:
        if path.suffix == ".npy":
            depth = np.load(path).astype(np.float64)
        else:
            image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            depth = None if image is None else image.astype(np.float64) * _DEPTH_UNIT_M
    except (OSError, EOFError, ValueError, TypeError, AttributeError):  # the last of an archive of arrays
        depth = None
    if depth is None or depth.ndim != 2:
        raise KroncError(
            f"{path} is no depth map: expected a 16-bit single-channel image in millimetres or .npy in metres"
        )
    return depth
