"""Ray for a fleet: one that starts and ends with it, or a cluster that is there."""

import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from kronc_ns.errors import KroncError
from kronc_ns.fleet.scratch import scratch_folder, scratch_root, sweep
from kronc_ns.fleet.storage import EXTRA

_QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_DEDUP_LOGS": "0",
    "RAY_worker_niceness": "0",
}
"""Nothing is reported to anybody, Ray leaves the environment as it is, and work is as urgent as the command itself."""
_SHADOWS = Path(__file__).parent / "shadows"
_STORE_BYTES = 128 << 20  # for what tasks tell: captures and results never go through Ray


@contextmanager
def local_ray(cpus: int | None) -> Iterator[None]:
    """A Ray on this machine that nobody else sees, until the end; then its files go, too.

    They lie in the system's temporary folder: sockets are among them, whose paths may have 107 bytes.
    """
    ray, root = import_ray(), scratch_root(None)
    sweep(root)
    with scratch_folder(root) as folder:
        try:
            _start(ray, cpus, folder)
            yield
        finally:
            ray.shutdown()


def _start(ray: Any, cpus: int | None, folder: Path) -> None:
    try:
        with light_imports():
            ray.init(
                num_cpus=cpus,
                include_dashboard=False,
                object_store_memory=_STORE_BYTES,
                _node_ip_address="127.0.0.1",
                _temp_dir=str(folder),
                log_to_driver=False,
                logging_level=logging.ERROR,
            )
    except Exception as error:  # Ray has no class for it
        told = " ".join(str(error).split())[:300]
        raise KroncError(f"Ray does not start on this machine ({told}): free some of it, or give --ray") from error


@contextmanager
def joined_ray(address: str) -> Iterator[None]:
    """A cluster that is there; raises `KroncError` where it is not, or of another Python or Ray."""
    ray = import_ray()
    if "://" in address:
        raise KroncError(
            f"--ray {address}: expected auto or HOST:PORT of a cluster that this machine is part of; to a remote one "
            "send the command itself: ray job submit -- kronc fleet ..."
        )
    if ray.is_initialized():  # by a program that this is a part of
        yield
        return
    try:
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
        told = " ".join(str(error).split())[:300]
        hint = "install one version on all machines" if "ersion" in told else "start one with: ray start --head"
        raise KroncError(f"--ray {address}: the cluster cannot be joined ({told}): {hint}") from None
    try:
        yield
    finally:
        ray.shutdown()


def import_ray() -> Any:
    """Ray, told to be quiet; raises `KroncError` where it is missing."""
    for name, value in _QUIET.items():
        os.environ.setdefault(name, value)
    try:
        with light_imports():
            import ray
    except ImportError:
        raise KroncError(f"kronc fleet needs ray, which is not installed: {EXTRA}") from None
    return ray


@contextmanager
def light_imports() -> Iterator[None]:
    """Let neither this process nor those it starts import rfc3987_syntax.

    Ray imports jsonschema in each of its processes, and that, for a check that nobody asks for, this package where
    Jupyter (and so nerfstudio) has brought it: it builds a grammar for 4 s, seven times until Ray has started.
    """
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(_SHADOWS), *([before] if before else [])])
    sys.path.insert(0, str(_SHADOWS))
    try:
        yield
    finally:
        sys.path.remove(str(_SHADOWS))
        if before is None:
            del os.environ["PYTHONPATH"]
        else:
            os.environ["PYTHONPATH"] = before
