"""What a solution looks like: the report, the viewer."""
