"""`kronc view`: a solved folder in 3D, in the browser."""

import contextlib
import errno
import io
import socket
import threading
from pathlib import Path
from typing import TYPE_CHECKING

from kronc_ns.errors import KroncError
from kronc_ns.files.record import read_solution
from kronc_ns.geometry.poses import posed
from kronc_ns.show.viewer.panel import Viewer

if TYPE_CHECKING:
    import viser

_HOST = "127.0.0.1"
"""Images of a capture are nobody else's business."""


def view(folder: Path, port: int) -> None:
    """Show a solved ``folder`` at http://localhost:``port`` until Ctrl-C. Raises `KroncError` as `open_viewer` does."""
    viewer = open_viewer(folder, port)
    with contextlib.closing(viewer), contextlib.suppress(KeyboardInterrupt):
        print(f"http://localhost:{port} shows {folder} (Ctrl-C ends)", flush=True)
        threading.Event().wait()


def open_viewer(folder: Path, port: int) -> Viewer:
    """Serve a solved ``folder`` from threads of its own; `Viewer.close` ends it.

    Raises `KroncError` where the folder is not solved or has no pose, the port is taken or viser is not installed.
    """
    scene, solution = read_solution(folder)
    if not posed(solution.c2w).any():
        raise KroncError(f"{folder}: no view has a pose, so there is nothing to see: `kronc report` says why")
    _check_port(port)
    return Viewer(_serve(port), scene, solution, folder)


def _serve(port: int) -> "viser.ViserServer":
    try:
        import psutil
        import viser
    except ImportError:
        raise KroncError("kronc view needs viser: pip install 'kronc-ns[viewer]'") from None
    while True:
        with contextlib.redirect_stdout(io.StringIO()):  # its banner
            try:
                return viser.ViserServer(host=_HOST, port=port, label="KRONC", verbose=False)
            except psutil.NoSuchProcess:  # viser 0.2 looks at all processes, and stumbles over one that just ended
                continue


def _check_port(port: int) -> None:
    """Raise for a port that cannot be listened on; viser would silently take another one."""
    if not 0 < port < 65536:
        raise KroncError(f"--port is {port}: expected a number from 1 to 65535")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((_HOST, port))
        except OSError as error:
            why = "is taken" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
            raise KroncError(f"port {port} {why}: give another one with --port") from None
