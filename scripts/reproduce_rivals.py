#!/usr/bin/env python
"""The paper's table of noise beside BARF and L2G-NeRF: who loses the way from which start, at what cost.

Small, at most 90 minutes on two quiet cores (40 photos of 100x100, three starts; rows that are done are kept):

    scripts/reproduce_rivals.py --output-dir rivals

In full, on a GPU (100 photos of 400x400, the paper's six starts, the papers' 200,000 steps of 0.4 TFLOP: by that some
two hours for each run of barf and l2g-nerf at 10 TFLOP/s, a day for all twelve; estimated, not measured):

    scripts/reproduce_rivals.py --output-dir rivals_full --gpu True --views 125 --width 400 \
        --noise 4 0.5 5 0.7 5 1.5 6 2 6 2.5 7 3
"""

import tyro

from kronc_ns.benchmark.tables.rivals import RivalOptions, make_rival_table
from kronc_ns.commands.console import exit_on_error

if __name__ == "__main__":
    with exit_on_error():
        make_rival_table(tyro.cli(RivalOptions, description=__doc__))
