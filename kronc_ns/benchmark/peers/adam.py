"""The paper's solver, Algorithm 1, as a peer: 10,000 steps of Adam."""

from dataclasses import replace

from kronc_ns.fit.options import KroncConfig
from kronc_ns.solve.options import AdamConfig

PAPERS = KroncConfig(solver="adam", adam=AdamConfig(learning_rate=0.01))
"""From given poses, else the circle.

The rate is the paper's for synthetic scenes; with that for real ones (0.001) cameras do not get off the circle far
enough.
"""
FROM_POSES = replace(PAPERS, init="given")
FROM_CIRCLE = replace(PAPERS, init="circular")


def one_step(config: KroncConfig) -> KroncConfig:
    """To load what torch loads for the first optimiser of a process, seconds of it, before time is taken."""
    return replace(config, adam=replace(config.adam, steps=1))
