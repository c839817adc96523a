"""Parameters of the solvers."""

from dataclasses import dataclass
from typing import Literal

Loss = Literal["cauchy", "huber", "none"]


@dataclass(frozen=True)
class AdamConfig:
    """Parameters of Algorithm 1."""

    steps: int = 10_000
    """Number of gradient steps S."""
    learning_rate: float = 0.01
    """Initial learning rate eta: 0.01 for the paper's synthetic scenes, 0.001 for its real ones."""
    decay: float = 0.001
    """Cosine annealing ends at this fraction of the learning rate."""
    weight_2d: float = 1.0
    """The paper's lambda: weight of a pixel in the image against a metre in the world (0: 3D loss only)."""
    weight_3d: float = 1.0
    """Weight of the 3D distances (0: 2D loss only, as in the paper's ablation)."""
    optimise_depths: bool = True
    """Whether depths are optimised with the poses; the paper's ablation also keeps given ones fixed."""
    patience: int = 0
    """Stop when the loss has not fallen by 0.1 % over this many steps; 0 (the paper) runs all steps."""


@dataclass(frozen=True)
class LmConfig:
    """Parameters of the second-order solver."""

    iterations: int = 200
    """Most iterations, rejected steps included."""
    tolerance: float = 1e-6
    """Converged when the next step is expected to lower the cost by less than this share."""
    loss: Loss = "cauchy"
    """cauchy: outliers lose influence and are left out at last; huber: they count linearly; none: in squares."""
