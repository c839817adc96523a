"""OpenPifPaf in an environment of its own: it needs an older torch and NumPy than nerfstudio, and another licence."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from kronc_ns.errors import KroncError

VERSION = "0.13.11"
_CONSTRAINTS = Path(__file__).with_name("isolated") / "build_constraints.txt"
_POLL_S = 0.1


@dataclass(frozen=True)
class Environment:
    """How Python with OpenPifPaf is called."""

    command: tuple[str, ...]

    @contextmanager
    def run(self, arguments: Sequence[str], folder: Path) -> Iterator["Child"]:
        """Python with these arguments in ``folder``; killed, with all its children, when the block is left early."""
        log = folder / "openpifpaf.log"
        clean = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
        with log.open("wb") as output:
            try:
                process = subprocess.Popen(
                    [*self.command, *arguments],
                    cwd=folder,
                    env=clean,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,
                )
            except OSError as error:
                raise KroncError(f"{self.command[0]} cannot be run: {error.strerror}") from None
        try:
            yield Child(process, log)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@dataclass(frozen=True)
class Child:
    """A running OpenPifPaf."""

    process: subprocess.Popen
    log: Path

    def wait_for_json(self, file: Path) -> object:
        """Content of a JSON file as soon as the child has written all of it; its own error where it never does."""
        while True:
            ended = self.process.poll() is not None
            with contextlib.suppress(FileNotFoundError, json.JSONDecodeError, UnicodeDecodeError):
                return json.loads(file.read_text(encoding="utf-8"))
            if ended:
                raise KroncError(self.why())
            time.sleep(_POLL_S)

    def why(self) -> str:
        """What went wrong, in one line, from what the child printed."""
        text = self.log.read_text(encoding="utf-8", errors="replace")
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        last = lines[-1] if lines else f"exit status {self.process.returncode}"
        download = re.findall(r'Downloading: "(.+?)" to (.+)', text)
        if download and self.process.returncode:
            url, target = download[-1]
            return (
                f"OpenPifPaf's weights are missing and {url} cannot be had ({last}): fetch it elsewhere and put it at "
                f"{target.strip()}, or give its path instead of its name"
            )
        if re.search(r"^\s*(error|×|╰─▶|cause:)", text, re.MULTILINE) and "Traceback" not in text:
            causes = [line for line in lines if not line.startswith("hint:")]
            return (
                f"uvx cannot build OpenPifPaf's environment ({causes[-1]}): it needs Python 3.10 and, the first time, "
                "the internet; or give --detector-python, a Python that has openpifpaf"
            )
        if "No module named" in last and "openpifpaf" in last:
            return f"--detector-python has no openpifpaf ({last}): give a Python with openpifpaf {VERSION}"
        return f"OpenPifPaf stopped: {last}"


def find_environment(python: Path | None) -> Environment:
    """The given Python, else one that uvx makes on first use and keeps."""
    if python is not None:
        found = shutil.which(python)
        if found is None:
            raise KroncError(f"--detector-python {python} is no program: expected a Python that has openpifpaf")
        return Environment((os.path.abspath(found),))
    uvx = shutil.which("uvx") or shutil.which("uvx", path=str(Path(sys.executable).parent))
    if uvx is None:
        raise KroncError(
            "OpenPifPaf runs in an environment of its own, and uvx, which makes it, is not on PATH: "
            "pip install 'kronc-ns[openpifpaf]', or give --detector-python, a Python that has openpifpaf"
        )
    options = ["--python", "3.10", "--build-constraints", str(_CONSTRAINTS), "--with", "numpy<2"]
    return Environment((uvx, *options, "--from", f"openpifpaf=={VERSION}", "python"))
