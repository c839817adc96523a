"""Stands before a package of this name where Ray's processes look for it: see `kronc_ns.fleet.cluster`."""

raise ImportError("left out: jsonschema does without")
