"""The `kronc` subcommands."""
