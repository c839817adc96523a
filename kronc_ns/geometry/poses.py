"""Rigid poses [3, 4], and the only place where OpenCV and OpenGL camera axes meet.

A pose is ``[R | t]``; ``c2w`` maps camera to world. The core's camera axes are OpenCV's (x right, y down,
z forward); nerfstudio's are OpenGL's (x right, y up, z backward).
"""

import numpy as np
from jaxtyping import Bool, Float


def make_pose(
    rotation: Float[np.ndarray, "*b 3 3"], translation: Float[np.ndarray, "*b 3"]
) -> Float[np.ndarray, "*b 3 4"]:
    """Pose [R | t]."""
    return np.concatenate([rotation, translation[..., None]], axis=-1)


def invert(pose: Float[np.ndarray, "*b 3 4"]) -> Float[np.ndarray, "*b 3 4"]:
    """Inverse of a rigid pose: [R^T | -R^T t]."""
    inverse = pose[..., :3].swapaxes(-1, -2)
    return np.concatenate([inverse, -inverse @ pose[..., 3:]], axis=-1)


def compose(
    a_from_b: Float[np.ndarray, "*b 3 4"], b_from_c: Float[np.ndarray, "*b 3 4"]
) -> Float[np.ndarray, "*b 3 4"]:
    """Pose a_from_c = a_from_b . b_from_c."""
    rotation = a_from_b[..., :3] @ b_from_c[..., :3]
    translation = a_from_b[..., :3] @ b_from_c[..., 3:] + a_from_b[..., 3:]
    return np.concatenate([rotation, translation], axis=-1)


def transform(pose: Float[np.ndarray, "*b 3 4"], points: Float[np.ndarray, "*b n 3"]) -> Float[np.ndarray, "*b n 3"]:
    """Points [n, 3] carried through a pose: R x + t."""
    return points @ pose[..., :3].swapaxes(-1, -2) + pose[..., None, :, 3]


def posed(c2w: Float[np.ndarray, "*n 3 4"]) -> Bool[np.ndarray, "*n"]:
    """Which views have a pose (the others hold NaN)."""
    return np.asarray(np.isfinite(c2w).all((-2, -1)))


def camera_z(c2w: Float[np.ndarray, "n 3 4"], points: Float[np.ndarray, "j 3"]) -> Float[np.ndarray, "n j"]:
    """z-depth of every point before every camera."""
    forward = c2w[..., 2]
    return forward @ points.T - (forward * c2w[..., 3]).sum(-1)[:, None]


def unit(vector: Float[np.ndarray, "*b k"]) -> Float[np.ndarray, "*b k"]:
    """Vectors at length 1; zero stays zero."""
    square = np.einsum("...i,...i->...", vector, vector)  # several times faster than a norm over three entries
    return vector / np.maximum(np.sqrt(square), 1e-12)[..., None]


def look_at(
    centres: Float[np.ndarray, "*b 3"], targets: Float[np.ndarray, "*b 3"], up: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "*b 3 4"]:
    """OpenCV c2w of cameras at ``centres`` facing ``targets``, with image-down as far from ``up`` as possible."""
    forward = unit(targets - centres)
    right = unit(np.cross(forward, up))
    down = np.cross(forward, right)
    return make_pose(np.stack([right, down, forward], axis=-1), centres)


def flip_camera_axes(c2w: Float[np.ndarray, "*b 3 4"]) -> Float[np.ndarray, "*b 3 4"]:
    """OpenCV c2w to OpenGL c2w, or back: negates the camera's y and z axes (its own inverse)."""
    return c2w * np.array([1.0, -1.0, -1.0, 1.0])
