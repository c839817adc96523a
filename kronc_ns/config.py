"""Presets: `KroncConfig` values in YAML, read by name from ``configs/`` or from a path, and checked."""

from dataclasses import dataclass, fields, is_dataclass, replace
from importlib import resources
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import tyro
import yaml

from kronc_ns.errors import KroncError
from kronc_ns.options import InitChoice, KroncConfig, MinStatus, Solver


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
        try:
            content = yaml.safe_load(path.read_text(encoding="utf-8"))
        except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
            raise KroncError(f"{path} is not valid YAML: {' '.join(str(error).split())}") from None
        config = _update(config, content or {}, str(path))
    return replace(config, **{key: value for key, value in overrides.items() if value is not None})


Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]
"""Given or not; there is no --no-... form."""


@dataclass(kw_only=True)
class SolverOptions:
    """The options every command that solves has in common; those left out come from the preset, then the defaults."""

    config: str | None = None
    """Preset (paper_synthetic, paper_real, phone_walk, turntable) or path to a YAML file of options."""
    solver: Solver | None = None
    """lm (default): robust second-order solver; adam: Algorithm 1 of the paper."""
    init: InitChoice | None = None
    """Initial poses: a car template found in each view, the paper's circle, those in transforms.json, or (auto)
    whichever leads to the best fit."""
    direction: Literal["ccw", "cw"] | None = None
    """Sense in which the circle was walked, seen from above (--init auto finds out)."""
    laps: float | None = None
    """How much of the circle was walked: 0.5 is half a lap (--init auto finds out)."""
    refine_focal: Flag = False
    """Treat the focal length as unknown, too."""
    refine_k1: Flag = False
    """Treat the first radial distortion coefficient as unknown, too."""
    car_length_m: float | None = None
    """True length of the car, bumper to bumper, for exact scale; otherwise its proportions tell it."""
    min_status: MinStatus | None = None
    """completed (default): views without usable keypoints are placed between their neighbours; solved: left out."""
    depth_init: Literal["random", "prior", "prior-fixed"] | None = None
    """Initial depths of adam: random as in the paper, or a prior (then optimised, or kept as it is): the depth maps of
    transforms.json, else what DINOv2 estimates from the images, scaled to the initial poses."""
    device: Literal["auto", "cpu", "cuda"] | None = None
    """Where to solve; auto takes a GPU for adam when there is one (lm is faster on the CPU)."""
    seed: int | None = None
    """Seed of the random depths."""

    def solver_config(self) -> KroncConfig:
        """The preset with these options on top."""
        given = {f.name: getattr(self, f.name) for f in fields(SolverOptions) if f.name != "config"}
        return load_config(self.config, **{name: None if value is False else value for name, value in given.items()})

    def any_solver_option(self) -> bool:
        """Whether any option was given, so that an existing solution may not be what is wanted."""
        given = (getattr(self, f.name) for f in fields(SolverOptions))
        return any(value is not None and value is not False for value in given)


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
        except (TypeError, ValueError):
            pass
    if not isinstance(value, kind) or (kind is not bool and isinstance(value, bool)):
        raise KroncError(f"{where}: {value!r} is not of the right kind: expected {kind.__name__}")
    return value
