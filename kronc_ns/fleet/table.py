"""fleet.parquet: a folder of parts, each written whole, so that it can be read at any time."""

import io
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, fields
from typing import Any

from kronc_ns.fleet.items import Row
from kronc_ns.fleet.storage import Place

_LEAST_ROWS, _ROWS_SHARE = 50, 20
_LEAST_S, _TIME_SHARE = 5.0, 50
_KINDS = {"str": "string", "int": "int64", "float": "float64", "float | None": "float64", "bool": "bool"}


class Table:
    """A row for each capture that is done; keeps no rows but those of the next part.

    A part is written when there are a twentieth as many new rows as there are rows, or a fiftieth of the time has
    passed: so parts are few (some hundreds for a million rows) and little is missing from them.
    """

    def __init__(self, place: Place) -> None:
        self._place = place
        self._waiting: list[Row] = []
        self._begin = self._last = time.monotonic()
        self._next = 1
        self._where: dict[str, tuple[int, str, str]] = {}
        """Part, listed and status of the captures of earlier runs."""
        self.counts: Counter[str] = Counter()
        """Captures by status."""

    def open(self) -> None:
        """Read what earlier runs have left."""
        for part, rows in self._parts(("capture", "listed", "status")):
            self._next = max(self._next, part + 1)
            for row in rows.to_pylist():
                self._where[row["capture"]] = (part, row["listed"], row["status"])
        self.counts = Counter(status for _, _, status in self._where.values())

    def holds(self, row: Row) -> bool:
        """Whether an earlier run has written this row."""
        return self._where.get(row.capture, (0, "", ""))[1:] == (row.listed, row.status)

    def add(self, row: Row) -> None:
        """Take a row, and write a part when it is time."""
        self._waiting.append(row)
        if row.capture in self._where:
            self.counts[self._where[row.capture][2]] -= 1
        self.counts[row.status] += 1
        now, rows = time.monotonic(), len(self._waiting)
        enough = max(_LEAST_ROWS, sum(self.counts.values()) / _ROWS_SHARE)
        if rows >= enough or now - self._last >= max(_LEAST_S, (now - self._begin) / _TIME_SHARE):
            self.flush()

    def flush(self) -> None:
        """Write what waits; rows of the same captures in earlier parts go."""
        self._last = time.monotonic()
        if not self._waiting:
            return
        again = {row.capture for row in self._waiting if row.capture in self._where}
        for part in sorted({self._where[capture][0] for capture in again}):
            self._without(part, again)
        for capture in again:
            del self._where[capture]
        self._write(self._next, _arrow([asdict(row) for row in self._waiting]))
        self._next += 1
        self._waiting.clear()

    def parts(self, columns: Sequence[str] | None = None) -> Iterator[Any]:
        """Every part as an Arrow table, one after the other."""
        return (rows for _, rows in self._parts(columns))

    def _without(self, part: int, captures: set[str]) -> None:
        rows = _read(self._place / _name(part))
        kept = rows.filter([name not in captures for name in rows["capture"].to_pylist()])
        if len(kept):
            self._write(part, kept)
        else:
            (self._place / _name(part)).remove()

    def _write(self, part: int, rows: Any) -> None:
        import pyarrow.parquet as pq

        content = io.BytesIO()
        pq.write_table(rows, content, compression="zstd")
        (self._place / _name(part)).write(content.getvalue())

    def _parts(self, columns: Sequence[str] | None) -> Iterator[tuple[int, Any]]:
        for file in self._place.files():
            if file.name.startswith("part-") and file.name.endswith(".parquet"):
                part = int(file.name.removeprefix("part-").removesuffix(".parquet"))
                yield part, _read(self._place / file.name, columns)


def _name(part: int) -> str:
    return f"part-{part:06d}.parquet"


def _read(place: Place, columns: Sequence[str] | None = None) -> Any:
    import pyarrow.parquet as pq

    return pq.read_table(io.BytesIO(place.read() or b""), columns=None if columns is None else list(columns))


def _arrow(rows: list[dict[str, Any]]) -> Any:
    import pyarrow as pa

    names = [(f.name, _KINDS.get(str(getattr(f.type, "__name__", f.type)), "string")) for f in fields(Row)]
    return pa.Table.from_pylist(rows, schema=pa.schema([(name, pa.type_for_alias(kind)) for name, kind in names]))
