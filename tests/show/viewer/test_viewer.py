"""What the viewer draws and says, without a browser."""

import os
import signal
import socket
import subprocess
import sys
import urllib.request
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from kronc_ns.errors import KroncError
from kronc_ns.files.record import read_solution
from kronc_ns.keypoints.schema import APOLLOCAR3D_66, schema_of_count
from kronc_ns.show.viewer import colours, open_viewer
from kronc_ns.show.viewer.car import tubes
from kronc_ns.show.viewer.panel import plain, summary_text, view_text
from kronc_ns.solution import ViewReport, ViewStatus

pytest.importorskip("viser", reason="viser is not installed: pip install 'kronc-ns[viewer]'")


def free_port() -> int:
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def report(rmse_px: float | None, status: ViewStatus = ViewStatus.SOLVED) -> ViewReport:
    return ViewReport("a.png", status, 20, 18, rmse_px)


def test_tubes_lie_around_their_lines():
    rng = np.random.default_rng(0)
    starts, ends = rng.normal(size=(2, 7, 3))
    starts[0], ends[0] = (0, 0, 0), (0, 0, 2)  # along an axis
    vertices, faces = tubes(starts, ends, 0.05)
    rings = vertices.reshape(7, 2, 3, 3)
    np.testing.assert_allclose(rings.mean(2), np.stack([starts, ends], 1), atol=1e-6)
    away = rings - np.stack([starts, ends], 1)[:, :, None]
    np.testing.assert_allclose(np.linalg.norm(away, axis=-1), 0.05, rtol=1e-4)
    np.testing.assert_allclose(np.einsum("nekc,nc->nek", away, ends - starts), 0, atol=1e-5)
    assert sorted(np.unique(faces)) == list(range(len(vertices)))
    assert (faces.reshape(7, -1) // 6 == np.arange(7)[:, None]).all()  # no triangle joins two tubes


def test_the_worst_view_has_the_top_colour_of_cividis():
    painted = colours.by_residual([report(1.0), report(3.0), report(None), report(2.0)], dark=True)
    top = cv2.applyColorMap(np.array([[255]], np.uint8), cv2.COLORMAP_CIVIDIS)[0, 0, ::-1]
    np.testing.assert_array_equal(painted[1], top)
    assert tuple(painted[2]) == colours.NEUTRAL
    lightness = painted.astype(int).sum(1)
    assert lightness[0] < lightness[3] < lightness[1]


@pytest.mark.parametrize("views", [[report(None)], [report(2.0), report(2.0)]])
def test_residuals_that_span_no_range_have_colours_and_a_legend(views):
    assert colours.by_residual(views, dark=False).shape == (len(views), 3)
    assert colours.residual_legend(views, dark=False).startswith("<svg")


def test_status_and_side_are_told_by_colour():
    painted = colours.by_status([report(1.0), report(None, ViewStatus.COMPLETED)], dark=False)
    assert len({tuple(colour) for colour in painted}) == 2
    sides = colours.by_side(APOLLOCAR3D_66)
    for left, right in APOLLOCAR3D_66.mirror_pairs:
        assert sides[left] != sides[right]
    assert len(set(colours.by_side(schema_of_count(5)))) == 1


def test_names_are_text_in_markdown():
    """Braces are JavaScript and tags are elements to viser 0.2, which runs what it reads."""
    assert plain("a_{alert(1)}<b>`x`") == r"a\_\{alert\(1\)\}\<b\>\`x\`"
    assert "\n" not in plain("a\n# b")


def test_the_panel_says_what_is_known_of_a_view(solved_lap_folder):
    _, solution = read_solution(solved_lap_folder)
    said = view_text(solution.views[0], has_image=True)
    assert f"RMSE {solution.views[0].rmse_px:.2f} px" in said
    assert f"{solution.views[0].inliers} of {solution.views[0].visible}" in said
    assert "not found" not in said
    assert "not found" in view_text(solution.views[1], has_image=False)
    lost = (replace(solution.views[0], status=ViewStatus.FAILED), *solution.views[1:])
    assert "1 without a pose" in summary_text(replace(solution, views=lost), "x")


@pytest.fixture
def viewer(solved_lap_folder):
    viewer = open_viewer(solved_lap_folder, free_port())
    yield viewer
    viewer.close()


def test_it_starts_at_the_worst_view_and_serves_a_page(viewer, solved_lap_folder):
    _, solution = read_solution(solved_lap_folder)
    worst = max(range(len(solution.views)), key=lambda i: solution.views[i].rmse_px or 0.0)
    assert viewer.selected == worst
    with urllib.request.urlopen(f"http://127.0.0.1:{viewer.server.get_port()}/") as page:
        assert b"<html" in page.read().lower()


def test_cameras_and_rays_go_back_to_the_start_and_return(viewer, solved_lap_folder):
    _, solution = read_solution(solved_lap_folder)

    def centres() -> np.ndarray:
        return np.stack([viewer.cameras.pose(i)[1] for i in viewer.cameras.views])

    viewer.show(0.0)
    moved = np.linalg.norm(centres() - solution.c2w[viewer.cameras.views, :, 3], axis=-1)
    assert moved.max() > 0.1
    viewer.show(1.0)
    np.testing.assert_allclose(centres(), solution.c2w[viewer.cameras.views, :, 3])


def test_a_taken_port_is_named(solved_lap_folder):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(KroncError, match=rf"port {port} is taken: give another one with --port"):
            open_viewer(solved_lap_folder, port)
    with pytest.raises(KroncError, match="--port is 70000: expected a number from 1 to 65535"):
        open_viewer(solved_lap_folder, 70000)


def test_folders_with_nothing_to_see_are_named(tmp_path, solved_lap_folder, edit):
    with pytest.raises(KroncError, match=r"kronc.json does not exist: expected a folder solved by"):
        open_viewer(tmp_path, free_port())
    for file in ("kronc.json", "keypoints.json", "transforms.json"):
        (tmp_path / file).write_bytes((solved_lap_folder / file).read_bytes())
    edit(tmp_path / "transforms.json", lambda content: content.update(frames=[]))
    with pytest.raises(KroncError, match="no view has a pose"):
        open_viewer(tmp_path, free_port())


def test_without_viser_the_extra_is_named(solved_lap_folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(KroncError, match=r"pip install 'kronc-ns\[viewer\]'"):
        open_viewer(solved_lap_folder, free_port())


def test_ctrl_c_ends_the_command_quietly(solved_lap_folder):
    port = free_port()
    command = [
        sys.executable,
        "-m",
        "kronc_ns.commands.main",
        "view",
        "--data",
        str(solved_lap_folder),
        "--port",
        str(port),
    ]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # which a shell's background jobs ignore
    ) as running:
        try:
            assert running.stdout is not None
            assert f"http://localhost:{port}" in running.stdout.readline()
            running.send_signal(signal.SIGINT)
            out, err = running.communicate(timeout=60)
        finally:
            running.kill()
    assert (running.returncode, out, err) == (0, "", "")
