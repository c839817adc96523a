#!/usr/bin/env python
"""The paper's table of real scenes: fields trained on reference, solved and circular poses, full frame and vehicle."""

import tyro

from kronc_ns.benchmark.tables.fields import FieldOptions, make_field_table
from kronc_ns.commands.console import exit_on_error

if __name__ == "__main__":
    with exit_on_error():
        make_field_table(tyro.cli(FieldOptions, description=__doc__))
