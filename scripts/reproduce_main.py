#!/usr/bin/env python
"""The paper's main table: pose errors from noisy poses, and those of other solvers on the same keypoints."""

import tyro

from kronc_ns.benchmark.tables.settings import main
from kronc_ns.benchmark.tables.table import TableOptions, make_table
from kronc_ns.commands.console import exit_on_error

if __name__ == "__main__":
    with exit_on_error():
        make_table(
            "main", "From the paper's noise, and without any start", tyro.cli(TableOptions, description=__doc__), main
        )
