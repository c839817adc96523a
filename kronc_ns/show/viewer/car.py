"""The solved keypoints in the scene: balls that tell their name when clicked, lines between them, rays to them."""

import math
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, UInt32

from kronc_ns.geometry.camera import rays
from kronc_ns.scene import Scene
from kronc_ns.show.viewer.colours import NEUTRAL, ODD, SELECTED, Colour, by_side
from kronc_ns.solution import Solution

if TYPE_CHECKING:
    import viser

_BALL = 0.01
"""Radius of a keypoint as a share of the car's largest extent."""
_LINE, _RAY = 0.0025, 0.002


class Car:
    """Keypoints, skeleton and the rays of one view."""

    def __init__(
        self, server: "viser.ViserServer", scene: Scene, solution: Solution, inlier: Bool[np.ndarray, "n j"]
    ) -> None:
        self._server, self._scene, self._solution, self._inlier = server, scene, solution, inlier
        points = solution.points
        self._points = points
        self._known = np.flatnonzero(np.isfinite(points).all(-1)).tolist()
        self._size = float(np.ptp(points[self._known], axis=0).max()) if self._known else 1.0
        self._names: dict[int, viser.LabelHandle] = {}
        self._rays: list[viser.MeshHandle] = []
        self._draw()

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """Middle of the keypoints; the world's where there is none."""
        return self._points[self._known].mean(0) if self._known else np.zeros(3)

    def show_names(self, shown: bool) -> None:
        """Name all keypoints, or none."""
        for j in self._known:
            if (j in self._names) is not shown:
                self._toggle_name(j)

    def hide_rays(self) -> None:
        """No rays."""
        for handle in self._rays:
            handle.remove()
        self._rays = []

    def show_rays(self, i: int, wxyz: np.ndarray, position: np.ndarray) -> None:
        """Rays from a camera through its detections, as far as the solved points are."""
        self.hide_rays()
        ends = rays(self._scene.uv[i], self._scene.camera) * self._solution.depths[i][:, None]
        met = np.isfinite(ends).all(-1)
        for name, chosen, colour in (
            ("explained", met & self._inlier[i], SELECTED),
            ("not explained", met & ~self._inlier[i], ODD),
        ):
            if chosen.any():
                to = ends[chosen]
                self._rays.append(
                    self._tubes(f"/rays/{name}", np.zeros_like(to), to, _RAY, colour, wxyz=wxyz, position=position)
                )

    def move_rays(self, wxyz: np.ndarray, position: np.ndarray) -> None:
        """Rays are fixed to their camera: they go where it goes."""
        for handle in self._rays:
            handle.wxyz, handle.position = wxyz, position

    def _draw(self) -> None:
        colours = by_side(self._scene.schema)
        for j in self._known:
            ball = self._server.scene.add_icosphere(
                f"/keypoints/{j:03d}", radius=_BALL * self._size, color=colours[j], subdivisions=2,
                position=self._points[j],
            )  # fmt: skip
            ball.on_click(lambda _, j=j: self._toggle_name(j))
        edges = np.array([e for e in self._scene.schema.skeleton if set(e) <= set(self._known)], int).reshape(-1, 2)
        if len(edges):
            starts, ends = self._points[edges[:, 0]], self._points[edges[:, 1]]
            self._tubes("/skeleton", starts, ends, _LINE, NEUTRAL)

    def _toggle_name(self, j: int) -> None:
        if j in self._names:
            self._names.pop(j).remove()
            return
        text = self._scene.schema.keypoints[j].replace("_", "\N{NO-BREAK SPACE}")  # viser breaks lines early
        self._names[j] = self._server.scene.add_label(f"/names/{j:03d}", text, position=self._points[j])

    def _tubes(
        self,
        name: str,
        starts: np.ndarray,
        ends: np.ndarray,
        radius: float,
        colour: Colour,
        wxyz: np.ndarray | tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0),
        position: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0),
    ) -> "viser.MeshHandle":
        vertices, faces = tubes(starts, ends, radius * self._size)
        return self._server.scene.add_mesh_simple(
            name, vertices, faces, color=colour, side="double", wxyz=wxyz, position=position
        )


def tubes(
    starts: Float[np.ndarray, "m 3"], ends: Float[np.ndarray, "m 3"], radius: float
) -> tuple[Float[np.ndarray, "v 3"], UInt32[np.ndarray, "f 3"]]:
    """Vertices and triangles of three-sided tubes along m lines: viser 0.2 has no thick lines in a single node."""
    along = ends - starts
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    aside = np.cross(along, np.eye(3)[np.abs(along).argmin(1)])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    up = np.cross(along, aside)
    angle = 2 * math.pi / 3 * np.arange(3)
    ring = radius * (np.cos(angle)[:, None] * aside[:, None] + np.sin(angle)[:, None] * up[:, None])
    vertices = np.stack([starts[:, None] + ring, ends[:, None] + ring], 1).reshape(-1, 3)
    side = np.array(
        [[a, (a + 1) % 3, 3 + a] for a in range(3)] + [[(a + 1) % 3, 3 + (a + 1) % 3, 3 + a] for a in range(3)]
    )
    faces = (6 * np.arange(len(starts))[:, None, None] + side).reshape(-1, 3)
    return vertices.astype(np.float32), faces.astype(np.uint32)
