"""Installing the package puts `kronc` into `ns-process-data --help`, uninstalling takes it out again."""

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.nerfstudio]

ROOT = Path(__file__).resolve().parents[2]
WITHOUT_BUILD_ENVIRONMENT = ["--no-deps", "--no-build-isolation"]


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of what the build needs, so that nothing is left in the checkout."""
    if importlib.util.find_spec("hatchling") is None:
        pytest.skip("hatchling is not installed: it builds the wheel without the network")
    copy = tmp_path_factory.mktemp("project")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    for name in ("kronc_ns", "configs"):
        shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
    return copy


@pytest.fixture
def python(tmp_path: Path) -> Path:
    """The interpreter of a fresh environment that sees the packages of this one, but none of its start-up hooks."""
    environment = tmp_path / "environment"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(environment)], check=True)
    (site_packages,) = environment.glob("lib/python*/site-packages")
    seen = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    (site_packages / "packages_of_the_tests.pth").write_text("\n".join(seen) + "\n")
    return environment / "bin" / "python"


def _run(*command: str | Path, **environment: str) -> str:
    clean = {
        key: value for key, value in os.environ.items() if not key.startswith(("KRONC_NS", "PYTHON", "VIRTUAL_ENV"))
    }
    done = subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, env=clean | environment, cwd="/", check=False
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout + done.stderr


def _help(python: Path, **environment: str) -> str:
    """What the console script of nerfstudio prints in that environment."""
    code = (
        "from nerfstudio.scripts.process_data import entrypoint; import sys; sys.argv = ['ns-process-data', '--help']"
    )
    text = _run(python, "-c", f"{code}; entrypoint()", **environment)
    assert "polycam" in text
    return text


def _hook_files(python: Path) -> list[str]:
    (site_packages,) = python.parents[1].glob("lib/python*/site-packages")
    return sorted(file.name for file in site_packages.glob("kronc_ns_hook*"))


def _uv() -> list[str]:
    if shutil.which("uv"):
        return ["uv"]
    if importlib.util.find_spec("uv"):
        return [sys.executable, "-m", "uv"]
    pytest.skip("uv is neither on PATH nor importable")


def _installer(tool: str, python: Path) -> tuple[list[str | Path], list[str | Path]]:
    """Commands that install into and uninstall from the environment of ``python``."""
    if tool == "pip":
        pip = [python, "-m", "pip", "--disable-pip-version-check"]
        return [*pip, "install", *WITHOUT_BUILD_ENVIRONMENT], [*pip, "uninstall", "--yes"]
    uv = [*_uv(), "--offline", "pip"]
    return [*uv, "install", "--python", python, *WITHOUT_BUILD_ENVIRONMENT], [*uv, "uninstall", "--python", python]


@pytest.mark.parametrize("editable", [False, True], ids=["plain", "editable"])
@pytest.mark.parametrize("tool", ["pip", "uv"])
def test_the_hook_comes_and_goes_with_the_package(tool: str, editable: bool, python: Path, project: Path):
    install, uninstall = _installer(tool, python)
    _run(*install, *(["-e"] if editable else []), project)
    assert _hook_files(python) == ["kronc_ns_hook.pth", "kronc_ns_hook.py"]
    package = _run(python, "-c", "import kronc_ns; print(kronc_ns.__file__)").strip()
    assert Path(package).is_relative_to(project if editable else python.parents[1])
    assert "kronc" in _help(python)

    _run(*uninstall, "kronc-ns")
    assert _hook_files(python) == []
    assert not python.with_name("kronc-process-data").exists()


def test_nerfstudio_is_as_before_without_the_hook(python: Path, project: Path):
    install, _ = _installer("pip", python)
    before = _help(python)
    assert "kronc" not in before
    _run(*install, project)
    assert _help(python, KRONC_NS_NO_HOOK="1") == before
    assert "--keypoints" in _run(python.with_name("kronc-process-data"), "--help")


def test_the_wheel_holds_the_presets_and_one_copy_of_the_hook(project: Path, tmp_path: Path):
    build = [sys.executable, "-m", "pip", "wheel", *WITHOUT_BUILD_ENVIRONMENT, "--wheel-dir", tmp_path, project]
    _run(*build)
    (wheel,) = tmp_path.glob("kronc_ns-*.whl")
    names = _run(sys.executable, "-m", "zipfile", "--list", wheel)
    assert "kronc_ns/configs/paper_real.yaml" in names
    assert names.count("kronc_ns_hook.py") == 1
    assert names.count("kronc_ns_hook.pth") == 1
