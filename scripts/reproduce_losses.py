#!/usr/bin/env python
"""The paper's ablation of its 2D and 3D losses."""

import tyro

from kronc_ns.benchmark.tables.settings import by_loss
from kronc_ns.benchmark.tables.table import TableOptions, make_table
from kronc_ns.commands.console import exit_on_error

if __name__ == "__main__":
    with exit_on_error():
        make_table("losses", "By the losses that Adam minimises", tyro.cli(TableOptions, description=__doc__), by_loss)
