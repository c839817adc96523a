#!/usr/bin/env python
"""The paper's main table: pose errors from noisy poses, and those of other solvers on the same keypoints."""

import tyro

from kronc_ns.benchmark.settings import main
from kronc_ns.benchmark.tables import TableOptions, make_table

if __name__ == "__main__":
    make_table(
        "main", "From the paper's noise, and without any start", tyro.cli(TableOptions, description=__doc__), main
    )
