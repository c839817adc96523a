"""Synthetic captures as scene folders: keypoints and intrinsics, reference poses, rendered images on demand."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from torch import Tensor

from kronc_ns.errors import KroncError
from kronc_ns.export import claim_output, release_output, transforms_dict
from kronc_ns.files import atomic_path, write_json
from kronc_ns.keypoints.io import write_keypoints
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.synthetic.render import render_view
from kronc_ns.synthetic.scenes import Capture


def write_capture(
    folder: Path,
    capture: Capture,
    start: Float[Tensor, "n 3 4"] | None = None,
    render: bool = False,
    ground: bool = True,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Write a capture as a scene folder that `load_scene` reads; the truth goes to ``reference.json`` only.

    ``start`` are poses for transforms.json (noisy ones, for ``init="given"``), ``render`` draws images, masks and
    depth maps: the whole surroundings with ``ground``, otherwise RGBA of the car alone. ``progress(view)`` is
    called after each image.
    """
    if render and capture.car is None:
        raise KroncError("the capture knows keypoints but no car: it can be written only without images")
    claim_output(folder)
    names = [f"images/frame_{i + 1:05d}.png" for i in range(len(capture.c2w))]
    masks = [name.replace("images", "masks") for name in names] if render else None
    depths = [name.replace("images", "depths") for name in names] if render else None
    if render and capture.car is not None:
        for i, name in enumerate(names):
            camera = capture.camera
            view = render_view(
                capture.car,
                capture.c2w[i].numpy(),
                camera.fx,
                camera.fy,
                camera.cx,
                camera.cy,
                camera.width,
                camera.height,
                ground=ground,
            )
            rgb = view.rgba[..., :3] if ground else view.rgba
            _write_png(folder / name, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR if ground else cv2.COLOR_RGBA2BGRA))
            _write_png(folder / name.replace("images", "masks"), view.mask)
            millimetres = np.clip(view.depth * 1000, 0, 65535).round().astype(np.uint16)
            _write_png(folder / name.replace("images", "depths"), millimetres)
            if progress is not None:
                progress(i + 1)
    size = (capture.camera.width, capture.camera.height)
    rows = dict(zip(names, capture.keypoints.numpy(), strict=True))
    write_keypoints(folder / "keypoints.json", APOLLOCAR3D_66, size, rows)
    write_json(folder / "reference.json", transforms_dict(capture.camera, names, capture.c2w, masks, depths))
    write_json(folder / "transforms.json", transforms_dict(capture.camera, names, start, masks, depths))
    release_output(folder)


def _write_png(path: Path, image: np.ndarray) -> None:
    with atomic_path(path) as temporary:
        if not cv2.imwrite(str(temporary), image):
            raise KroncError(f"{path} cannot be written: is the disk full?")
