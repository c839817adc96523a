"""What a bar shows of refinement."""

from collections.abc import Callable

Progress = Callable[[int, int, float | None], None]
"""Called with (done, of how many, None)."""


class Counter:
    """Counts the steps of all stages for one bar, whose end moves away where more is to be done."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress, self._total, self._done = progress, 0, 0

    def expect(self, more: int) -> None:
        """So many steps are still to come besides."""
        self._total += more

    def advance(self) -> None:
        """One more is done."""
        self._done += 1
        if self._progress is not None:
            self._progress(self._done, self._total, None)
