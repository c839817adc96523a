"""Synthetic captures as scene folders: keypoints and intrinsics, reference poses, rendered images on demand."""

from collections.abc import Callable, Generator
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float
from typing_extensions import assert_never

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import write_keypoints
from kronc_ns.files.output import atomic_path, claim_output, release_output, write_json
from kronc_ns.files.transforms import transforms_dict
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from kronc_ns.synthetic.blender import blender_views
from kronc_ns.synthetic.mesh import MeshCar, write_mesh_car
from kronc_ns.synthetic.render import Rendering, render_view, trace_mask_and_depth
from kronc_ns.synthetic.scenes import Capture

Renderer = Literal["builtin", "blender"]


def write_capture(
    folder: Path,
    capture: Capture,
    start: Float[np.ndarray, "n 3 4"] | None = None,
    render: bool = False,
    ground: bool = True,
    progress: Callable[[int], None] | None = None,
    renderer: Renderer = "builtin",
) -> None:
    """Write a capture as a scene folder that `load_scene` reads; the truth goes to ``reference.json`` only.

    ``start`` are poses for transforms.json (noisy ones, for ``init="given"``), ``render`` draws images, masks and
    depth maps: the whole surroundings with ``ground``, otherwise RGBA of the car alone. ``progress(view)`` is
    called after each image.
    """
    if render:
        _check_renderer(capture, renderer)
    claim_output(folder, "capture")
    names = [f"images/frame_{i + 1:05d}.png" for i in range(len(capture.c2w))]
    masks = [name.replace("images", "masks") for name in names] if render else None
    depths = [name.replace("images", "depths") for name in names] if render else None
    if render:
        with closing(_renderings(capture, ground, renderer)) as renderings:
            for i, (name, view) in enumerate(zip(names, renderings, strict=True)):
                rgb = view.rgba[..., :3] if ground else view.rgba
                _write_png(folder / name, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR if ground else cv2.COLOR_RGBA2BGRA))
                _write_png(folder / name.replace("images", "masks"), view.mask)
                millimetres = np.clip(view.depth * 1000, 0, 65535).round().astype(np.uint16)
                _write_png(folder / name.replace("images", "depths"), millimetres)
                if progress is not None:
                    progress(i + 1)
    size = (capture.camera.width, capture.camera.height)
    rows = dict(zip(names, capture.keypoints, strict=True))
    write_keypoints(folder / "keypoints.json", APOLLOCAR3D_66, size, rows)
    write_json(folder / "reference.json", transforms_dict(capture.camera, names, capture.c2w, masks, depths))
    write_json(folder / "transforms.json", transforms_dict(capture.camera, names, start, masks, depths))
    release_output(folder)


def _check_renderer(capture: Capture, renderer: Renderer) -> None:
    if capture.car is None:
        raise KroncError("the capture knows keypoints but no car: it can be written only without images")
    if isinstance(capture.car, MeshCar) and renderer != "blender":
        raise KroncError(f"{capture.car.file} cannot be drawn by --renderer {renderer}: expected --renderer blender")


def _renderings(capture: Capture, ground: bool, renderer: Renderer) -> Generator[Rendering, None, None]:
    """Every view, drawn by the builtin ray caster or by Blender; masks and depth maps are ray-cast with both."""
    camera, car = capture.camera, capture.car
    assert car is not None
    match renderer:
        case "builtin":
            assert not isinstance(car, MeshCar)
            for c2w in capture.c2w:
                yield render_view(car, c2w, camera, ground=ground)
        case "blender":
            with TemporaryDirectory(prefix="kronc-car-") as place:
                mesh_car = car if isinstance(car, MeshCar) else write_mesh_car(car, Path(place) / "car.glb")
                with closing(blender_views(mesh_car, capture.c2w, camera, ground)) as pictures:
                    for rgba, c2w in zip(pictures, capture.c2w, strict=True):
                        yield Rendering(rgba, *trace_mask_and_depth(mesh_car.mesh, c2w, camera, ground=ground))
        case _:
            assert_never(renderer)


def _write_png(path: Path, image: np.ndarray) -> None:
    with atomic_path(path) as temporary:
        if not cv2.imwrite(str(temporary), image):
            raise KroncError(f"{path} cannot be written: is the disk full?")
