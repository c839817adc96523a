"""A fleet on a Ray cluster of two nodes, where workers, drivers and disks fail."""

import os
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest

from kronc_ns.capture.detection.choice import DetectorOptions
from kronc_ns.errors import KroncError
from kronc_ns.fleet import FleetOptions, run_fleet
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import make_capture
from tests.fleet.conftest import NAMES, fleet_command

pytestmark = pytest.mark.slow
QUICK = FleetOptions(reports="none")
MANY = 40


@pytest.fixture(scope="module")
def many(tmp_path_factory) -> Path:
    """Captures enough for several tasks."""
    folder = tmp_path_factory.mktemp("many") / "captures"
    for i in range(MANY):
        if i < 5:
            write_capture(folder / f"c{i:03d}", make_capture("walk", views=24, seed=i, noise_px=1.0))
        else:
            shutil.copytree(folder / f"c{i % 5:03d}", folder / f"c{i:03d}")
    return folder


@pytest.fixture(scope="module")
def undisturbed(many, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    assert run_fleet(str(many), str(out), QUICK, ray="none").is_solved
    return out


@pytest.fixture
def same(undisturbed, same_poses, rows):
    """An output has every capture once, solved as without a disturbance."""

    def check(out: Path) -> dict[str, dict]:
        table = rows(out)
        assert sorted(table) == [f"c{i:03d}" for i in range(MANY)]
        for name, row in table.items():
            assert row["status"] == "converged", row
            assert same_poses(out / name, undisturbed / name)
        return table

    return check


def test_the_nodes_share_the_work(cluster, many, same, tmp_path):
    scratch = tmp_path / "scratch"
    summary = run_fleet(str(many), str(tmp_path / "out"), replace(QUICK, scratch=scratch), ray=cluster)
    assert summary.counts == {"converged": MANY}
    table = same(tmp_path / "out")
    assert len({row["node"] for row in table.values()}) == 2
    assert {row["attempts"] for row in table.values()} == {1}
    assert os.listdir(scratch) == []


def test_killed_workers_lose_nothing(cluster, many, same, tmp_path):
    scratch = tmp_path / "scratch"
    with _killing("ray::kronc_fleet", times=3, every_s=1.0) as killed:
        summary = run_fleet(str(many), str(tmp_path / "out"), replace(QUICK, scratch=scratch, retries=3), ray=cluster)
    assert killed, "nobody was killed"
    assert summary.counts == {"converged": MANY}
    same(tmp_path / "out")
    assert os.listdir(scratch) == [], "also of those that were killed"


def test_one_that_never_ends_is_ended_and_the_others_are_done(cluster, captures, tmp_path, rows):
    """Its detector hangs."""
    shutil.rmtree(captures / "b")
    (captures / "b").mkdir()
    for i in range(4):
        cv2.imwrite(str(captures / f"b/{i}.png"), np.full((90, 160, 3), 40 * i, np.uint8))
    hangs = tmp_path / "python"
    hangs.write_text("#!/bin/sh\nexec sleep 60\n")
    hangs.chmod(0o755)
    detection = DetectorOptions("openpifpaf", detector_python=hangs)
    options = replace(QUICK, time_limit_min=0.15, retries=1, keep_duplicates=True, detection=detection)
    summary = run_fleet(str(captures), str(tmp_path / "out"), options, ray=cluster)
    table = rows(tmp_path / "out")
    assert [table[name]["status"] for name in NAMES] == ["converged", "error", "converged", "converged"]
    assert "--time-limit-min 0.15 (tried 2 times)" in table["b"]["reason"]
    assert not summary.is_solved


def test_a_killed_driver_is_followed_by_resume(cluster, many, same, tmp_path, kronc_fleet):
    out = tmp_path / "out"
    arguments = ("--captures", many, "--output", out, "--ray", cluster, "--reports", "none")
    driver = subprocess.Popen(fleet_command(*arguments), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _until(lambda: len([*out.glob("c*/fleet.json")]) > MANY // 4)
    driver.kill()
    driver.wait()
    done = kronc_fleet(*arguments, "--resume")
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    same(out)
    assert (out / "fleet.html").exists()


def test_ctrl_c_keeps_what_is_done(cluster, many, same, tmp_path, rows, kronc_fleet):
    out, scratch = tmp_path / "out", tmp_path / "scratch"
    arguments = ("--captures", many, "--output", out, "--ray", cluster, "--reports", "none", "--scratch", scratch)
    driver = subprocess.Popen(fleet_command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    _until(lambda: len([*out.glob("c*/fleet.json")]) > MANY // 4)
    driver.send_signal(signal.SIGINT)
    _, said = driver.communicate(timeout=60)
    assert (driver.returncode, said.count("\n")) == (130, 1), said
    assert 0 < len(rows(out)) < MANY
    assert (out / "fleet.html").exists()
    assert os.listdir(scratch) == []
    done = kronc_fleet(*arguments, "--resume")
    assert done.returncode == 0, done.stderr
    same(out)


def test_a_full_scratch_disk_is_said_and_left_empty(cluster, captures, tmp_path, rows):
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=16k", "tmpfs", disk], check=False).returncode:
        pytest.skip("a small disk cannot be mounted here")
    try:
        options = replace(QUICK, scratch=disk, retries=1)
        assert run_fleet(str(captures), str(tmp_path / "out"), options, ray=cluster).counts == {"error": 4}
        assert all(f"{disk} is full" in row["reason"] for row in rows(tmp_path / "out").values())
        assert {row["attempts"] for row in rows(tmp_path / "out").values()} == {2}
        assert os.listdir(disk) == []
    finally:
        subprocess.run(["umount", disk], check=True)


def test_from_bucket_to_bucket(cluster, made_captures, tmp_path, rows):
    import s3fs

    s3 = s3fs.S3FileSystem(use_listings_cache=False)
    s3.mkdir("nodes")
    s3.put(f"{made_captures}/", "nodes/captures", recursive=True)
    try:
        assert run_fleet("s3://nodes/captures", "s3://nodes/out", QUICK, ray=cluster).is_solved
        s3.get("nodes/out/", f"{tmp_path}/out", recursive=True)
        assert sorted(rows(tmp_path / "out")) == list(NAMES)
    finally:
        s3.rm("nodes", recursive=True)


def test_another_cluster_or_version_is_told_first(cluster, captures, tmp_path, monkeypatch):
    with pytest.raises(KroncError, match="ray job submit"):
        run_fleet(str(captures), str(tmp_path / "out"), ray="ray://127.0.0.1:1")
    with pytest.raises(KroncError, match="no node of the cluster has more than 0"):
        run_fleet(str(captures), str(tmp_path / "out"), replace(QUICK, gpus=1.0), ray=cluster)
    monkeypatch.setattr("kronc_ns.__version__", "9.9")
    with pytest.raises(KroncError, match=r"has kronc_ns 0.*, this process 9.9"):
        run_fleet(str(captures), str(tmp_path / "out"), ray=cluster)
    assert not (tmp_path / "out").exists()


def test_a_ray_of_its_own_starts_and_ends_with_the_command(captures, tmp_path, rows, kronc_fleet):
    (captures / "b/keypoints.json").write_text("{")
    arguments = ("--captures", captures, "--output", tmp_path / "out", "--local-cpus", 2, "--reports", "none")
    with tempfile.TemporaryDirectory(prefix="k", dir="/tmp") as short:  # Ray's sockets are in it
        done = kronc_fleet(*arguments, TMPDIR=short)
        assert os.listdir(short) == []
        processes = [" ".join(one.info["cmdline"] or []) for one in psutil.process_iter(["cmdline"])]
        assert not [process for process in processes if short in process]
    assert done.returncode == 3, done.stderr
    assert done.stderr.startswith("error: b: b/keypoints.json is not valid JSON")
    assert done.stderr.count("\n") == 1
    assert done.stdout.splitlines()[-1] == f"{tmp_path / 'out'}/fleet.parquet"
    table = rows(tmp_path / "out")
    assert [table[name]["status"] for name in NAMES] == ["converged", "error", "converged", "converged"]


@contextmanager
def _killing(title: str, times: int, every_s: float):
    """Kill a process of that title now and then; which."""
    killed: list[int] = []
    over = threading.Event()

    def kill() -> None:
        while len(killed) < times and not over.wait(every_s):
            for process in psutil.process_iter(["cmdline"]):
                if title in " ".join(process.info["cmdline"] or []):
                    killed.append(process.pid)
                    process.kill()
                    break

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        yield killed
    finally:
        over.set()
        killer.join()


def _until(happened, patience_s: float = 90.0) -> None:
    until = time.monotonic() + patience_s
    while not happened():
        assert time.monotonic() < until, "it did not come to that"
        time.sleep(0.05)
