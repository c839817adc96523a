#!/usr/bin/env python
"""The paper's table by number of poses."""

import tyro

from kronc_ns.benchmark.tables.settings import by_views
from kronc_ns.benchmark.tables.table import TableOptions, make_table
from kronc_ns.commands.console import exit_on_error

if __name__ == "__main__":
    with exit_on_error():
        make_table("views", "By the number of views", tyro.cli(TableOptions, description=__doc__), by_views)
