"""How work on many files says how far it is."""

from collections.abc import Callable

Count = Callable[[int, int, None], None]
"""Called with (done, all, None)."""
