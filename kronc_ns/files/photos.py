"""The photos of a scene folder, as refinement by image features sees them."""

from pathlib import Path

import cv2
import numpy as np

from kronc_ns.errors import KroncError
from kronc_ns.files.images import read_grey
from kronc_ns.refine.pictures import Picture, Pictures
from kronc_ns.scene import Scene


def photos(folder: Path, scene: Scene) -> Pictures:
    """Those of a scene that was read from ``folder``; transparent ones on white, their alpha the mask if it has none.

    Reading one raises `KroncError` where it is missing, broken, or not of its camera's size.
    """

    def read(view: int) -> Picture:
        file = folder / scene.names[view]
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if image is None or image.dtype != np.uint8:
            raise KroncError(f"{file} is no 8-bit image that can be read: restore it, or use --refine-images off")
        camera = scene.camera_of(view)
        if image.shape[1::-1] != (camera.width, camera.height):
            raise KroncError(
                f"{file} is {image.shape[1]}x{image.shape[0]}, its camera {camera.width}x{camera.height}: "
                "expected the image that was solved"
            )
        image = image.reshape(*image.shape[:2], -1)
        channels = image.shape[2]
        vehicle = image[..., -1] if channels in (2, 4) else None
        bgr = np.repeat(image[..., :1], 3, axis=2) if channels < 3 else image[..., :3]
        if vehicle is not None:
            share = vehicle[..., None] / np.float32(255)
            bgr = np.round(bgr * share + 255 * (1 - share)).astype(np.uint8)
        if scene.masks is not None:
            mask = folder / scene.masks[view]
            vehicle = read_grey(mask)
            if vehicle.shape != image.shape[:2]:
                raise KroncError(
                    f"{mask} is {vehicle.shape[::-1]}, its image {image.shape[1::-1]}: expected equal sizes"
                )
        return Picture(np.ascontiguousarray(bgr[..., ::-1]), None if vehicle is None else np.ascontiguousarray(vehicle))

    return read
