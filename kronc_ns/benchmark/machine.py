"""The machine that figures were taken on."""

import os
import platform
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np


def hardware() -> dict[str, Any]:
    """The machine, how busy it is, and what computes on it; torch and its GPU only where it has been imported."""
    machine = {
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "load_1min": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "numpy": np.__version__,
    }
    torch = sys.modules.get("torch")
    if torch is not None:
        gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
        machine |= {"gpu": gpu, "torch": torch.__version__, "torch_threads": torch.get_num_threads()}
    return machine


def in_words(machine: Mapping[str, Any]) -> str:
    """What stands below a table."""
    gpu = machine.get("gpu")
    return f"{machine['cores']} cores ({machine['cpu']}), load {machine['load_1min'] or 0:.1f}" + (
        f", GPU {gpu}" if gpu else ""
    )


def _cpu() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as lines:
            for line in lines:
                if line.startswith("model name"):
                    return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
