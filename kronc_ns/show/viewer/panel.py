"""The viewer: what is shown, and the panel beside it that changes it."""

import contextlib
import io
import string
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from jaxtyping import UInt8

from kronc_ns.fit.verdict import inliers
from kronc_ns.scene import Scene
from kronc_ns.show.motion import aligned_path, on_path
from kronc_ns.show.report.overlays import load_image, overlay, overlay_svg
from kronc_ns.show.viewer import colours
from kronc_ns.show.viewer.cameras import Cameras
from kronc_ns.show.viewer.car import Car
from kronc_ns.solution import Solution, ViewReport, ViewStatus

if TYPE_CHECKING:
    import viser

_THUMBNAIL_PX = 120
_PLAY_S, _FRAMES = 3.0, 60
_BLANK = np.full((9, 16, 3), 160, np.uint8)
"""In place of an image that is not found: without a surface a camera can hardly be clicked."""
_GRID = (150, 150, 150)
_FROM = np.array([0.8, -0.9, 0.7])
"""Where the reader looks from at first: from the car's front right and above, in widths of the walk."""


class Viewer:
    """A solution in a viser server, which all its clients see alike."""

    def __init__(self, server: "viser.ViserServer", scene: Scene, solution: Solution, folder: Path) -> None:
        self.server = server
        self._scene, self._solution, self._folder = scene, solution, folder
        self._path = aligned_path(solution)
        _, self._inlier = inliers(scene, solution)
        self._closed, self._lock = threading.Event(), threading.RLock()
        self._share, self.selected = 1.0, -1
        server.scene.set_up_direction("+z")
        self._build_panel()
        own = [solution.camera_of(i) for i in range(len(solution.views))]
        self.cameras = Cameras(server, own, solution.c2w, self._colours(), self.select)
        self.car = Car(server, scene, solution, self._inlier)
        self._draw_ground()
        server.on_client_connect(self._look_at_all)
        self.select(self._worst())
        self._loader = threading.Thread(target=self._load_thumbnails, daemon=True)
        self._loader.start()

    def close(self) -> None:
        """End the server and what runs beside it."""
        self._closed.set()
        self._loader.join()  # a thread inside of a library when Python ends aborts the process
        with contextlib.redirect_stdout(io.StringIO()):  # what later viser says then
            self.server.stop()

    def select(self, i: int) -> None:
        """Mark view ``i`` (from 0), draw its rays, and show its image and figures in the panel."""
        with self._lock:
            if i == self.selected:
                return
            self.selected = i
            if self._number.value != i + 1:
                self._number.value = i + 1  # comes back here through its callback, and goes no further
            self.cameras.select(i)
            self._draw_rays()
            view = self._solution.views[i]
            shown = overlay(view.status.value, i, self._scene, self._solution, self._inlier, self._folder)
            self._picture.content = _image(overlay_svg(shown))
            self._figures.content = view_text(view, bool(shown.image))

    def show(self, share: float) -> None:
        """Put the cameras a ``share`` of the way from their start (0) to where they were solved (1)."""
        with self._lock:
            if share == self._share:
                return
            self._share = share
            self.cameras.move(on_path(self._path, share))
            if self.selected in self.cameras.views:
                self.car.move_rays(*self.cameras.pose(self.selected))

    def _build_panel(self) -> None:
        gui, solution = self.server.gui, self._solution
        gui.configure_theme(control_layout="collapsible", control_width="large", show_share_button=False)
        gui.add_markdown(summary_text(solution, self._folder.resolve().name))
        with gui.add_folder("Optimisation"):
            self._slider = gui.add_slider("before – after", min=0.0, max=1.0, step=0.01, initial_value=1.0)
            self._slider.on_update(lambda _: self.show(self._slider.value))
            gui.add_button("Play").on_click(lambda _: self._play())
            gui.add_markdown(_way_text(solution, len(self._path) - 2))
        with gui.add_folder("Show"):
            self._by = gui.add_dropdown("camera colour", ("status", "residual"), initial_value="status")
            self._legend = self._add_picture()
            self._sides = self._add_picture()
            thumbnails = gui.add_checkbox("images", initial_value=True)
            names = gui.add_checkbox("names", initial_value=False)
            self._with_rays = gui.add_checkbox("rays", initial_value=True)
            self._dark = gui.add_checkbox("dark", initial_value=False)
            self._by.on_update(lambda _: self._repaint())
            thumbnails.on_update(lambda _: self.cameras.show_thumbnails(thumbnails.value))
            names.on_update(lambda _: self.car.show_names(names.value))
            self._with_rays.on_update(lambda _: self._draw_rays())
            self._dark.on_update(lambda _: self._change_theme())
        with gui.add_folder("View"):
            self._number = gui.add_slider("number", min=1, max=len(solution.views), step=1, initial_value=1)
            self._number.on_update(lambda _: self.select(self._number.value - 1))
            steps = gui.add_button_group("go to", ("previous", "next", "worst"))
            steps.on_click(lambda _: self._go(steps.value))
            gui.add_button("Look through it").on_click(lambda event: self._look_through(event.client))
            self._picture = self._add_picture()
            self._figures = gui.add_markdown("")
        self._draw_legends()

    def _add_picture(self) -> Any:
        """Room for `_image`. viser 0.2 takes HTML as markdown only, and later ones make images in markdown small."""
        gui = self.server.gui
        return getattr(gui, "add_html", gui.add_markdown)("")

    def _colours(self) -> UInt8[np.ndarray, "n 3"]:
        paint = colours.by_status if self._by.value == "status" else colours.by_residual
        return paint(self._solution.views, self._dark.value)

    def _repaint(self) -> None:
        with self._lock:
            self.cameras.paint(self._colours())
            self._draw_legends()

    def _draw_legends(self) -> None:
        legend = colours.status_legend if self._by.value == "status" else colours.residual_legend
        self._legend.content = _image(legend(self._solution.views, self._dark.value))
        self._sides.content = _image(colours.side_legend(self._scene.schema, self._dark.value))

    def _change_theme(self) -> None:
        self.server.gui.configure_theme(
            control_layout="collapsible", control_width="large", show_share_button=False, dark_mode=self._dark.value
        )
        self._repaint()

    def _draw_rays(self) -> None:
        with self._lock:
            i = self.selected
            if i in self.cameras.views and self._with_rays.value:
                self.car.show_rays(i, *self.cameras.pose(i))
            else:
                self.car.hide_rays()

    def _draw_ground(self) -> None:
        points = self._solution.points
        low = points[np.isfinite(points).all(-1)][:, 2]
        self.server.scene.add_grid(
            "/ground", width=20.0, height=20.0, plane="xy", cell_size=1.0, section_size=5.0, cell_color=_GRID,
            section_color=_GRID, position=(0.0, 0.0, float(low.min()) if len(low) else 0.0),
        )  # fmt: skip

    def _play(self) -> None:
        for frame in range(_FRAMES + 1):
            self._slider.value = frame / _FRAMES  # moves the cameras through its callback
            if self._closed.wait(_PLAY_S / _FRAMES):
                return

    def _worst(self) -> int:
        views = self._solution.views
        return max(self.cameras.views, key=lambda i: (views[i].rmse_px or 0.0, -i))

    def _go(self, where: str) -> None:
        with self._lock:
            if where == "worst":
                self.select(self._worst())
            else:
                self.select((self.selected + (1 if where == "next" else -1)) % len(self._solution.views))

    def _look_at_all(self, client: "viser.ClientHandle") -> None:
        """Set a new reader where all cameras are in sight."""
        centres = self._solution.c2w[self.cameras.views, :, 3]
        middle = self.car.centre
        reach = float(np.linalg.norm(centres - middle, axis=1).max())
        client.camera.position = middle + reach * 1.15 * _FROM
        client.camera.look_at = middle

    def _look_through(self, client: "viser.ClientHandle | None") -> None:
        if client is None or self.selected not in self.cameras.views:
            return
        wxyz, position = self.cameras.pose(self.selected)
        camera = self._solution.camera_of(self.selected)
        with client.atomic():
            client.camera.wxyz, client.camera.position = wxyz, position
            client.camera.fov = 2 * float(np.arctan2(camera.height / 2, camera.fy))

    def _load_thumbnails(self) -> None:
        for i in self.cameras.views:
            image = load_image(self._folder / self._scene.names[i], _THUMBNAIL_PX)
            self.cameras.set_thumbnail(i, _BLANK if image is None else np.asarray(image))
            if self._closed.wait(0.001):  # lets callbacks have their turn
                return


def summary_text(solution: Solution, title: str) -> str:
    """Markdown that says what is shown."""
    views = solution.views
    solved = sum(view.status is ViewStatus.SOLVED for view in views)
    lines = [f"**{plain(title)}**: {solution.status.value}", f"{solved} of {len(views)} views solved"]
    failed = sum(view.status is ViewStatus.FAILED for view in views)
    if failed:
        lines.append(f"{failed} without a pose, which are not drawn")
    return "  \n".join(lines)


def _way_text(solution: Solution, recorded: int) -> str:
    """Markdown that says what the slider goes through."""
    steps = solution.iterations
    over = f"over {'all' if recorded == steps else f'{recorded} of'} {steps} steps" if recorded else "on straight lines"
    return f"From {plain(solution.init)} poses, {over}."


def view_text(view: ViewReport, has_image: bool) -> str:
    """Markdown with the figures of a view."""
    lines = [f"**{plain(view.name)}**: {view.status.value}"]
    if view.rmse_px is not None:
        lines.append(f"RMSE {view.rmse_px:.2f} px, {view.inliers} of {view.visible} keypoints explained")
    if view.sigma_rot_deg is not None and view.sigma_trans_m is not None:
        lines.append(f"standard deviation {view.sigma_rot_deg:.2f}°, {100 * view.sigma_trans_m:.1f} cm")
    lines += [plain(view.reason)] if view.reason else []
    lines += ["left and right were confused, and put right"] if view.swapped else []
    lines += [] if has_image else ["its image was not found"]
    return "  \n".join(lines)


def plain(text: str) -> str:
    """Text that markdown, and the JavaScript that viser 0.2 reads in it, leave alone."""
    return "".join(f"\\{c}" if c in string.punctuation else c for c in " ".join(text.split()))


def _image(svg: str) -> str:
    return f'<img src="data:image/svg+xml,{quote(svg)}" width="100%" />'
