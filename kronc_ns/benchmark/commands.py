"""Commands of this environment, run as a user would, also several at a time."""

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from threading import Lock

from kronc_ns.errors import KroncError

_LAST_LINES = 15  # of the output, in an error


class Commands:
    """Runs commands, from any thread; leaving the context ends those that still run and lets no more begin."""

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        self._environment = {**os.environ, **(environment or {})}
        self._lock = Lock()
        self._running: set[subprocess.Popen[str]] = set()
        self._closed = False

    def __enter__(self) -> "Commands":
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._closed = True
            for process in self._running:
                process.terminate()

    def run(self, command: str, *arguments: str) -> str:
        """What a command prints on stdout; `KroncError` with the end of its output where its status is not 0."""
        with self._lock:
            if self._closed:
                raise KroncError(f"{command} was not started: the run is over")
            process = subprocess.Popen(
                [str(Path(sys.executable).parent / command), *arguments],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env=self._environment,
            )
            self._running.add(process)
        try:
            output, errors = process.communicate()
        except BaseException:  # a signal's, for one: nobody is left to wait for it
            process.terminate()
            raise
        finally:
            with self._lock:
                self._running.discard(process)
        if process.returncode:
            last = "\n".join((output + errors).strip().splitlines()[-_LAST_LINES:])
            raise KroncError(f"{command} ended with status {process.returncode}: {last}")
        return output
