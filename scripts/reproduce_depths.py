#!/usr/bin/env python
"""The paper's ablation of initial depths; the prior is the truth with noise in place of a network's depths."""

import tyro

from kronc_ns.benchmark.tables.settings import by_depths
from kronc_ns.benchmark.tables.table import TableOptions, make_table
from kronc_ns.commands.console import exit_on_error

if __name__ == "__main__":
    with exit_on_error():
        make_table("depths", "By where the depths begin", tyro.cli(TableOptions, description=__doc__), by_depths)
