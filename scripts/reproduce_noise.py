#!/usr/bin/env python
"""The paper's ablation of initial noise."""

import tyro

from kronc_ns.benchmark.tables.settings import by_noise
from kronc_ns.benchmark.tables.table import TableOptions, make_table
from kronc_ns.commands.console import exit_on_error

if __name__ == "__main__":
    with exit_on_error():
        make_table("noise", "By the noise of the initial poses", tyro.cli(TableOptions, description=__doc__), by_noise)
