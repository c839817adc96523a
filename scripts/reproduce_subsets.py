#!/usr/bin/env python
"""The paper's figure of subsampled images: registered views and errors beside COLMAP's."""

import tyro

from kronc_ns.benchmark.settings import by_subset
from kronc_ns.benchmark.tables import TableOptions, make_table

if __name__ == "__main__":
    make_table("subsets", "By the share of the images", tyro.cli(TableOptions, description=__doc__), by_subset)
