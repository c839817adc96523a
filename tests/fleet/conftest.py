"""Captures for fleets, and the services that they run on: Ray of several nodes, an S3 server."""

import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from kronc_ns.files.transforms import read_poses
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import make_capture

pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'kronc-ns[fleet]'")
NAMES = ("a", "b", "c", "d")


@pytest.fixture(scope="session")
def made_captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four walks with keypoints and no images."""
    folder = tmp_path_factory.mktemp("fleet") / "captures"
    for seed, name in enumerate(NAMES):
        write_capture(folder / name, make_capture("walk", views=8 + seed, seed=seed, noise_px=0.5))
    return folder


@pytest.fixture
def captures(made_captures: Path, tmp_path: Path) -> Path:
    """A copy that a test may change."""
    return Path(shutil.copytree(made_captures, tmp_path / "captures"))


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture with images and keypoints, small enough to be processed at once."""
    folder = tmp_path_factory.mktemp("photos") / "walk"
    capture = make_capture("walk", views=6, seed=3, noise_px=0.5)
    write_capture(folder, capture, render=True)
    return folder


@pytest.fixture
def rows():
    """The table of an output, by capture; each is there once."""

    def read(output: Path) -> dict[str, dict]:
        import pyarrow.parquet as pq

        found = pq.read_table(output / "fleet.parquet").to_pylist()
        assert len(found) == len({row["capture"] for row in found})
        return {row["capture"]: row for row in found}

    return read


@pytest.fixture
def same_poses():
    """Whether two results have the same poses, to what threads of other numbers may differ in."""

    def compare(one: Path, other: Path) -> bool:
        ours, theirs = (read_poses(folder / "transforms.json") for folder in (one, other))
        assert [Path(name).name for name in ours] == [Path(name).name for name in theirs]
        return np.allclose([*ours.values()], [*theirs.values()], atol=1e-6)

    return compare


@pytest.fixture(scope="session")
def s3_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """moto's server, whose address the environment tells to whoever speaks S3."""
    pytest.importorskip("moto", reason="moto is not installed: pip install 'moto[server]'")
    pytest.importorskip("s3fs", reason="s3fs is not installed: pip install s3fs")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    with (tmp_path_factory.mktemp("moto") / "log").open("w") as log:
        server = subprocess.Popen(command, stdout=log, stderr=log)
    try:
        _until_it_listens(port, server)
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
            patch.setenv("AWS_ACCESS_KEY_ID", "test")
            patch.setenv("AWS_SECRET_ACCESS_KEY", "test")
            patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
            yield f"http://127.0.0.1:{port}"
    finally:
        server.kill()
        server.wait()


def _until_it_listens(port: int, server: subprocess.Popen) -> None:
    until = time.monotonic() + 60
    while time.monotonic() < until and server.poll() is None:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.1)
    pytest.skip("moto's server does not start here")


@pytest.fixture(scope="session")
def cluster(s3_server: str) -> Iterator[str]:
    """A Ray cluster of two nodes of one CPU in processes of this machine; its address."""
    pytest.importorskip("ray", reason="ray is not installed: pip install 'kronc-ns[fleet]'")
    from kronc_ns.fleet.cluster import import_ray, light_imports

    import_ray()
    from ray.cluster_utils import Cluster

    node = {"num_cpus": 1, "object_store_memory": 80 << 20, "include_dashboard": False}
    with light_imports():
        running = Cluster(initialize_head=True, head_node_args={**node, "no_monitor": True})
        running.add_node(**node)
    try:
        yield running.address
    finally:
        running.shutdown()


@pytest.fixture
def kronc_fleet():
    """Run `kronc fleet ARGUMENTS` as a process of its own."""

    def run(*arguments: object, timeout: int = 240, **environment: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            fleet_command(*arguments), capture_output=True, text=True, timeout=timeout, check=False,
            env={**os.environ, **environment},
        )  # fmt: skip

    return run


def fleet_command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "kronc_ns.commands.main", "fleet", *map(str, arguments)]
