#!/usr/bin/env python
"""The paper's figure of subsampled images: registered views and errors beside COLMAP's."""

import tyro

from kronc_ns.benchmark.tables.settings import by_subset
from kronc_ns.benchmark.tables.table import TableOptions, make_table
from kronc_ns.commands.console import exit_on_error

if __name__ == "__main__":
    with exit_on_error():
        make_table("subsets", "By the share of the images", tyro.cli(TableOptions, description=__doc__), by_subset)
