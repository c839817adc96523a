"""The options every command that solves has in common."""

from dataclasses import dataclass, fields
from typing import Annotated, Literal

import tyro

from kronc_ns.files.presets import load_config
from kronc_ns.fit.options import InitChoice, KroncConfig, MinStatus, Solver

Flag = Annotated[bool, tyro.conf.FlagCreatePairsOff]
"""Given or not; there is no --no-... form."""


@dataclass(kw_only=True)
class SolverOptions:
    """The options every command that solves has in common; those left out come from the preset, then the defaults."""

    config: str | None = None
    """Preset (paper_synthetic, paper_real, phone_walk, turntable) or path to a YAML file of options."""
    solver: Solver | None = None
    """lm (default): robust second-order solver; adam: Algorithm 1 of the paper; none: given poses as they are, for
    methods that find poses themselves (barf, l2g-nerf)."""
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
