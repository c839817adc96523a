#!/usr/bin/env python
"""The paper's table of real scenes: fields trained on reference, solved and circular poses, full frame and vehicle."""

import tyro

from kronc_ns.benchmark.fields import FieldOptions, make_field_table

if __name__ == "__main__":
    make_field_table(tyro.cli(FieldOptions, description=__doc__))
