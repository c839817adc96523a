"""Each format's reader and writer in one module."""
