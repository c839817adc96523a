"""What is to be done next: small captures in bundles, those with images one by one."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

from kronc_ns.fleet.items import Item

TASK_S = 2.0
"""What a task of small captures should last: much more than Ray needs for it, and little to be done again."""
_FIRST, _MOST = 4, 512
_LARGE_WAITING = 256  # captures with images that wait, from which on no others are looked for


@dataclass(frozen=True)
class Bundle:
    """Captures of one task."""

    items: tuple[Item, ...]
    large: bool = False
    """Whether it is one with images, rather than some to be looked at and done where they have none."""

    def halves(self) -> "list[Bundle]":
        """Its captures in two bundles; of a single one, that."""
        middle = (len(self.items) + 1) // 2
        return [Bundle(part, self.large) for part in (self.items[:middle], self.items[middle:]) if part]


class Queue:
    """All captures of a fleet that nobody works on."""

    def __init__(self, fresh: Iterator[Item], count: int) -> None:
        self._fresh, self._left = fresh, count
        self._large: deque[Item] = deque()
        self._again: deque[Bundle] = deque()
        self._seconds = 0.0
        """What a small capture takes, of late."""

    @property
    def is_empty(self) -> bool:
        """Whether nothing waits."""
        return not (self._left or self._large or self._again)

    def next_is_large(self) -> bool:
        """Whether what comes next has images; such captures come first, so that small ones never keep them waiting."""
        return bool(self._large) or (not self._left and bool(self._again) and self._again[0].large)

    def take(self, slots: int) -> Bundle:
        """The next bundle for one of so many workers."""
        if self._large:
            return Bundle((self._large.popleft(),), large=True)
        if self._left and len(self._again) < _LARGE_WAITING:
            items = tuple(islice(self._fresh, self._size(slots)))
            self._left -= len(items)
            return Bundle(items)
        return self._again.popleft()

    def put_large(self, item: Item) -> None:
        """It has images."""
        self._large.append(item)

    def put_again(self, bundles: Sequence[Bundle]) -> None:
        """They have not been done; after all others, they are."""
        self._again += bundles

    def learn(self, seconds: float, count: int) -> None:
        """So many small captures took so long, one after the other."""
        one = seconds / max(count, 1)
        self._seconds = one if self._seconds == 0 else 0.7 * self._seconds + 0.3 * one

    def _size(self, slots: int) -> int:
        wanted = _FIRST if self._seconds == 0 else round(TASK_S / max(self._seconds, 1e-6))
        share = -(-self._left // (2 * max(slots, 1)))  # the last ones are for all workers
        return max(min(wanted, share, _MOST), 1)
