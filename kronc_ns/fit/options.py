"""How a scene is solved."""

import math
from dataclasses import dataclass, field
from typing import Literal

from kronc_ns.errors import KroncError
from kronc_ns.solve.options import AdamConfig, LmConfig

Direction = Literal["ccw", "cw"]
"""Sense in which a circle is walked, seen from above."""
Solver = Literal["lm", "adam", "none"]
InitChoice = Literal["auto", "template", "circular", "given"]
MinStatus = Literal["completed", "solved"]


@dataclass(frozen=True)
class KroncConfig:
    """How a scene is solved; the presets in ``configs/`` are values of this."""

    solver: Solver = "lm"
    """lm: robust second-order solver; adam: Algorithm 1 of the paper; none: given poses are handed on as they are."""
    init: InitChoice = "auto"
    """Initial poses: a car template found in each view, the paper's circle, those given in transforms.json, or
    (auto) whichever of these leads to the best fit."""
    radius_m: float = 4.0
    """Radius of the circle."""
    direction: Direction = "ccw"
    """Sense of the circle, seen from above."""
    laps: float = 1.0
    """How much of the circle was walked: 0.5 is half a lap."""
    depth_init: Literal["random", "prior", "prior-fixed"] = "random"
    """Initial depths of adam: random in [omega/2, omega], or from depth maps (then optimised, or kept as they are)."""
    refine_focal: bool = False
    """Whether the focal length is unknown too (lm only)."""
    refine_k1: bool = False
    """Whether the first radial distortion coefficient is unknown too (lm only)."""
    car_length_m: float | None = None
    """True length of the car, bumper to bumper, for exact scale; otherwise the template's proportions tell it."""
    min_status: MinStatus = "completed"
    """completed: views without usable keypoints are placed between their neighbours; solved: they are left out."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; auto takes a GPU for adam when there is one (lm is faster on the CPU)."""
    seed: int = 0
    """Seed of the random depths."""
    adam: AdamConfig = field(default_factory=AdamConfig)
    """Parameters of Algorithm 1."""
    lm: LmConfig = field(default_factory=LmConfig)
    """Parameters of the second-order solver."""

    def __post_init__(self) -> None:
        positive = {
            "radius_m": self.radius_m,
            "laps": self.laps,
            "adam.steps": self.adam.steps,
            "adam.learning_rate": self.adam.learning_rate,
            "lm.iterations": self.lm.iterations,
            "lm.tolerance": self.lm.tolerance,
        }
        for name, value in positive.items():
            if not 0 < value < math.inf:
                raise KroncError(f"{name} is {value}: expected a finite number above 0")
        if self.car_length_m is not None and not 0.01 <= self.car_length_m <= 100:
            raise KroncError(f"car_length_m is {self.car_length_m:g}: expected metres, from 0.01 to 100")
        weights = self.adam.weight_2d, self.adam.weight_3d
        if not all(0 <= weight < math.inf for weight in weights) or sum(weights) <= 0:
            raise KroncError(
                f"adam.weight_2d and adam.weight_3d are {weights[0]:g} and {weights[1]:g}: "
                "expected finite numbers from 0 on, and not both 0"
            )
        if self.solver != "lm" and (self.refine_focal or self.refine_k1):
            raise KroncError(
                f'refine_focal and refine_k1 need solver "lm": {self.solver} takes the intrinsics as given'
            )
        if self.solver != "adam" and self.depth_init != "random":
            raise KroncError(
                f'depth_init {self.depth_init!r} needs solver "adam": {self.solver} has no depths to start from'
            )
        if self.solver == "none" and self.init not in ("auto", "given"):
            raise KroncError(f'init {self.init!r} needs a solver: "none" hands given poses on as they are')
