"""The cameras in the scene: frusta with thumbnails that can be clicked."""

import math
import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8

from kronc_ns.geometry.camera import Camera
from kronc_ns.geometry.poses import posed
from kronc_ns.geometry.rotations import quaternion_from_rotation
from kronc_ns.show.motion import frustum_depth
from kronc_ns.show.viewer.colours import SELECTED, Colour

if TYPE_CHECKING:
    import viser


class Cameras:
    """One frustum for each view that has a pose."""

    def __init__(
        self,
        server: "viser.ViserServer",
        cameras: Sequence[Camera],
        c2w: Float[np.ndarray, "n 3 4"],
        colours: UInt8[np.ndarray, "n 3"],
        on_click: Callable[[int], None],
    ) -> None:
        self._server, self._on_click = server, on_click
        self._fov = [2 * math.atan2(camera.height / 2, camera.fy) for camera in cameras]
        self._aspect = [camera.width / camera.height for camera in cameras]
        # viser gives every frustum the same volume, whatever its field of view
        slope = [math.tan(fov / 2) for fov in self._fov]
        depth = frustum_depth(c2w)
        self._scale = [depth * (s * s * a / 3) ** (1 / 3) for s, a in zip(slope, self._aspect, strict=True)]
        self._c2w, self._colours = c2w, colours
        self._thumbnails: dict[int, np.ndarray] = {}
        self._with_images, self._selected = True, -1
        self._handles: dict[int, viser.CameraFrustumHandle] = {}
        self._lock = threading.RLock()
        self._draw_all()

    @property
    def views(self) -> list[int]:
        """Indices of the views that have a pose."""
        return np.flatnonzero(posed(self._c2w)).tolist()

    def pose(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Quaternion (w, x, y, z) and centre of view ``i`` as it is shown."""
        return quaternion_from_rotation(self._c2w[i, :, :3]), self._c2w[i, :, 3]

    def move(self, c2w: Float[np.ndarray, "n 3 4"]) -> None:
        """Show other poses."""
        with self._lock:
            self._c2w = c2w
            turns, centres = quaternion_from_rotation(c2w[..., :3]), c2w[..., 3]
            for i, handle in self._handles.items():
                handle.wxyz, handle.position = turns[i], centres[i]

    def paint(self, colours: UInt8[np.ndarray, "n 3"]) -> None:
        """Show other colours."""
        with self._lock:
            self._colours = colours
            for i in self._handles:
                self._colour(i)

    def set_thumbnail(self, i: int, image: UInt8[np.ndarray, "h w 3"]) -> None:
        """Put an image into a frustum."""
        with self._lock:
            self._thumbnails[i] = image
            if self._with_images:
                self._draw(i)

    def show_thumbnails(self, shown: bool) -> None:
        """With or without images."""
        with self._lock:
            self._with_images = shown
            self._draw_all()

    def select(self, i: int) -> None:
        """Mark one view."""
        with self._lock:
            before, self._selected = self._selected, i
            for j in {before, i} & set(self._handles):
                self._colour(j)

    def _draw_all(self) -> None:
        for i in self.views:
            self._draw(i)

    def _colour_of(self, i: int) -> Colour:
        red, green, blue = self._colours[i].tolist()
        return SELECTED if i == self._selected else (red, green, blue)

    def _colour(self, i: int) -> None:
        """Give the frustum its colour; viser 0.2 can only draw it anew, with its image."""
        if hasattr(self._handles[i], "color"):
            setattr(self._handles[i], "color", self._colour_of(i))  # noqa: B010 (pyright knows 0.2 only)
        else:
            self._draw(i)

    def _draw(self, i: int) -> None:
        """Add the frustum, in place of the one that is there."""
        turn, centre = self.pose(i)
        handle = self._server.scene.add_camera_frustum(
            f"/cameras/{i + 1:04d}",
            fov=self._fov[i],
            aspect=self._aspect[i],
            scale=self._scale[i],
            color=self._colour_of(i),
            image=self._thumbnails.get(i) if self._with_images else None,
            wxyz=turn,
            position=centre,
        )
        handle.on_click(lambda _: self._on_click(i))
        self._handles[i] = handle
