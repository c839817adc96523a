"""Presets: `KroncConfig` values in YAML, read by name from ``configs/`` or from a path, and checked."""

from dataclasses import fields, is_dataclass, replace
from importlib import resources
from pathlib import Path
from types import UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from kronc_ns.errors import KroncError
from kronc_ns.fit.options import KroncConfig


def preset_folder() -> Path:
    """Where the presets lie: inside an installed package, beside it in a checkout."""
    installed = Path(str(resources.files("kronc_ns"))) / "configs"
    return installed if installed.is_dir() else installed.parent.parent / "configs"


def preset_names() -> list[str]:
    """Names of the presets that come with the package."""
    return sorted(path.stem for path in preset_folder().glob("*.yaml"))


def load_config(name_or_path: str | None = None, **overrides: Any) -> KroncConfig:
    """The preset of that name or file (None: the defaults) with those ``overrides`` that are not None.

    Raises `KroncError` for an unknown name, an unknown key or a value of the wrong kind.
    """
    config = KroncConfig()
    if name_or_path is not None:
        path = Path(name_or_path)
        if path.suffix not in (".yaml", ".yml"):
            path = preset_folder() / f"{name_or_path}.yaml"
        if not path.is_file():
            raise KroncError(
                f"there is no preset {name_or_path!r}: "
                f"expected one of {', '.join(preset_names())} or a path to a .yaml file"
            )
        import yaml  # few calls read a preset

        try:
            content = yaml.safe_load(path.read_text(encoding="utf-8"))
        except (yaml.YAMLError, ValueError, RecursionError, OSError) as error:
            raise KroncError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from None
        config = _update(config, {} if content is None else content, str(path))
    return replace(config, **{key: value for key, value in overrides.items() if value is not None})


def _update(target: Any, content: Any, where: str) -> Any:
    """``target`` (a dataclass) with the values of a mapping; every key and kind is checked."""
    if not isinstance(content, dict):
        raise KroncError(f"{where}: expected a mapping of option names to values, got {type(content).__name__}")
    hints = get_type_hints(type(target))
    names = [f.name for f in fields(target)]
    changes = {}
    for key, value in content.items():
        if key not in names:
            raise KroncError(f"{where}: unknown option {key!r}: expected one of {', '.join(names)}")
        current = getattr(target, key)
        changes[key] = (
            _update(current, value, f"{where}, {key}")
            if is_dataclass(current)
            else _check(value, hints[key], f"{where}, {key}")
        )
    try:
        return replace(target, **changes)
    except KroncError as error:  # a value of the right kind that cannot be
        raise KroncError(f"{where}: {error}") from None


def _check(value: Any, kind: Any, where: str) -> Any:
    if get_origin(kind) is UnionType:  # only ever "this or None"
        if value is None:
            return None
        kind = get_args(kind)[0]
    if get_origin(kind) is Literal:
        if value not in get_args(kind):
            raise KroncError(
                f"{where}: {value!r} is not allowed: expected one of {', '.join(map(str, get_args(kind)))}"
            )
        return value
    if kind is float and not isinstance(value, bool):
        try:
            return float(value)  # also of text: YAML takes 1e-3 for a string
        except (TypeError, ValueError, OverflowError):
            pass
    if not isinstance(value, kind) or (kind is not bool and isinstance(value, bool)):
        raise KroncError(f"{where}: {value!r} is not of the right kind: expected {kind.__name__}")
    return value
