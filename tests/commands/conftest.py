"""The `kronc` command run in this process, and scenes for it."""

import shutil
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from kronc_ns.commands import main as cli


class Result(NamedTuple):
    status: int
    out: str
    err: str

    def refused(self, *parts: str) -> bool:
        """Exit status 2 and one line on stderr that holds all parts, nothing else."""
        assert self.status == 2, self.err
        assert self.err.startswith("error: ")
        assert self.err.count("\n") == 1
        assert self.err.endswith("\n")
        assert "Traceback" not in self.out
        for part in parts:
            assert part in self.err
        return True


@pytest.fixture
def kronc(monkeypatch, capsys, compiled_solver):
    """Run `kronc ARGUMENTS` in this process."""

    def run(*arguments) -> Result:
        monkeypatch.setattr(sys, "argv", ["kronc", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as caught:
            cli.main()
        return Result(int(caught.value.code or 0), *capsys.readouterr())

    return run


@pytest.fixture
def short(tmp_path) -> Path:
    """Enough steps from poses that are nearly right."""
    (tmp_path / "short.yaml").write_text("init: given\nadam:\n  steps: 500\n  learning_rate: 0.05\n")
    return tmp_path / "short.yaml"


@pytest.fixture
def hasty(tmp_path) -> Path:
    """Too few steps for anything."""
    (tmp_path / "hasty.yaml").write_text("solver: adam\nadam:\n  steps: 3\n")
    return tmp_path / "hasty.yaml"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """What `kronc synth` writes, with noisy poses to start from."""
    folder = tmp_path_factory.mktemp("cli") / "scene"
    options = {"--views": 12, "--noise-px": 0.5, "--pose-noise-deg": 4.0, "--pose-noise-m": 0.3, "--seed": 5}
    with pytest.MonkeyPatch.context() as patch:
        flat = [str(part) for pair in options.items() for part in pair]
        patch.setattr(sys, "argv", ["kronc", "synth", "--output-dir", str(folder), *flat])
        with pytest.raises(SystemExit) as caught:
            cli.main()
    assert not caught.value.code
    return folder


@pytest.fixture
def scene(made, tmp_path) -> Path:
    """A copy that a test may change."""
    return Path(shutil.copytree(made, tmp_path / "scene"))


@pytest.fixture
def solved(scene, short, kronc, tmp_path) -> Path:
    result = kronc("solve", "--data", scene, "--output-dir", tmp_path / "out", "--config", short)
    assert result.status == 0, result.err
    return tmp_path / "out"


def contents(folder: Path) -> dict[str, bytes]:
    """Every file by its path in the folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
