"""The import hook: adds one subcommand to ns-process-data, and stays out of the way of everything else."""

import importlib.util
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

HOOK = Path(__file__).parents[2] / "kronc_ns" / "plugin" / "hook"
SCRIPT = "nerfstudio.scripts.process_data"


@pytest.fixture
def hook(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The hook's module, with this interpreter's finders put back afterwards and none of the hook's in place."""
    finders = [finder for finder in sys.meta_path if type(finder).__name__ != "ProcessDataFinder"]
    monkeypatch.setattr(sys, "meta_path", finders)
    monkeypatch.delenv("KRONC_NS_NO_HOOK", raising=False)
    spec = importlib.util.spec_from_file_location("kronc_ns_hook", HOOK / "kronc_ns_hook.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def fake_nerfstudio(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A stand-in for nerfstudio's script, first on the path."""
    scripts = tmp_path / "nerfstudio" / "scripts"
    scripts.mkdir(parents=True)
    (tmp_path / "nerfstudio" / "__init__.py").touch()
    (scripts / "__init__.py").touch()
    (scripts / "process_data.py").write_text("from typing import Union\nCommands = Union[int, str]\n")
    for name in [name for name in sys.modules if name.split(".")[0] == "nerfstudio"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield scripts / "process_data.py"
    for name in [name for name in sys.modules if name.split(".")[0] == "nerfstudio"]:
        del sys.modules[name]


def _finders() -> list[str]:
    return [type(finder).__name__ for finder in sys.meta_path]


def test_the_pth_is_one_line_that_python_executes():
    text = (HOOK / "kronc_ns_hook.pth").read_text()
    assert text.count("\n") == 1
    assert text.startswith("import ")


def test_installing_is_done_once_and_can_be_switched_off(hook: ModuleType, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("KRONC_NS_NO_HOOK", "1")
    hook.install()
    assert "ProcessDataFinder" not in _finders()
    monkeypatch.setenv("KRONC_NS_NO_HOOK", "0")
    hook.install()
    hook.install()
    assert _finders().count("ProcessDataFinder") == 1
    assert _finders()[0] == "ProcessDataFinder"


def test_starting_python_imports_nothing_more():
    code = "print(*sorted(set(sys.modules) - before))"
    line = (HOOK / "kronc_ns_hook.pth").read_text()
    start = f"import sys, os, site; sys.path.insert(0, {str(HOOK)!r}); before = set(sys.modules); exec({line!r})\n"
    done = subprocess.run([sys.executable, "-S", "-c", start + code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["kronc_ns_hook"]


def test_a_missing_module_does_not_disturb_python():
    line = (HOOK / "kronc_ns_hook.pth").read_text()
    done = subprocess.run([sys.executable, "-I", "-S", "-c", line], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")


def test_other_modules_are_left_to_other_finders(hook: ModuleType):
    assert hook.ProcessDataFinder().find_spec("json") is None
    assert hook.ProcessDataFinder().find_spec("nerfstudio.scripts.train") is None


def test_the_command_is_added(hook: ModuleType, fake_nerfstudio: Path):
    from typing import get_args

    from kronc_ns.plugin.process_data import KroncToNerfstudio

    hook.install()
    script = importlib.import_module(SCRIPT)
    assert script.__file__ == str(fake_nerfstudio)
    added = get_args(script.Commands)[-1]
    assert get_args(added)[0] is KroncToNerfstudio
    assert get_args(added)[1].name == "kronc"
    script = importlib.reload(script)
    assert len(get_args(script.Commands)) == 3


@pytest.mark.parametrize("broken", ["raise RuntimeError('one\\ntwo')", "", "import nowhere"])
def test_a_broken_plugin_is_one_warning(
    hook: ModuleType,
    fake_nerfstudio: Path,
    broken: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    class Broken:
        def find_spec(self, name, path=None, target=None):
            if name != "kronc_ns.plugin.process_data":
                return None
            file = fake_nerfstudio.with_name("broken.py")
            file.write_text(broken)
            return importlib.util.spec_from_file_location(name, file)

    monkeypatch.delitem(sys.modules, "kronc_ns.plugin.process_data", raising=False)
    hook.install()
    sys.meta_path.insert(0, Broken())
    script = importlib.import_module(SCRIPT)
    monkeypatch.delitem(sys.modules, "kronc_ns.plugin.process_data", raising=False)
    assert str(script.Commands) == "typing.Union[int, str]"
    err = capsys.readouterr().err
    assert err.startswith("warning: ns-process-data has no kronc command (")
    assert err.count("\n") == 1


def test_errors_of_nerfstudio_itself_are_passed_on(hook: ModuleType, fake_nerfstudio: Path):
    fake_nerfstudio.write_text("raise ImportError('theirs')")
    hook.install()
    with pytest.raises(ImportError, match="theirs"):
        importlib.import_module(SCRIPT)


@pytest.mark.nerfstudio
def test_ns_process_data_lists_kronc(
    hook: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.delitem(sys.modules, SCRIPT, raising=False)
    hook.install()
    script = importlib.import_module(SCRIPT)
    for arguments, expected in ((["--help"], "polycam"), (["--help"], "kronc"), (["kronc", "--help"], "--keypoints")):
        monkeypatch.setattr(sys, "argv", ["ns-process-data", *arguments])
        with pytest.raises(SystemExit):
            script.entrypoint()
        assert expected in capsys.readouterr().out
