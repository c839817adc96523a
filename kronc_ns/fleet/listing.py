"""Which captures there are: the subfolders and videos of a folder, by name alone."""

from collections.abc import Iterable

from kronc_ns.errors import KroncError
from kronc_ns.fleet.items import VIDEO_SUFFIXES, Item
from kronc_ns.fleet.storage import Place

RESERVED = ("fleet.json", "fleet.parquet", "fleet.html")
"""What the output folder holds beside the folders of results."""


def list_captures(place: Place, limit: int | None = None) -> list[str]:
    """The entries (`Item.entry`) of all captures in a place, sorted, at most ``limit``; looks into none of them.

    Raises `KroncError` where there are none, or two whose results would have one name.
    """
    entries = sorted(_captures(place.entries()))
    if not entries:
        raise KroncError(f"{place} holds no captures: expected subfolders, or videos ({', '.join(VIDEO_SUFFIXES)})")
    last: dict[str, str] = {}
    if any(not entry.endswith("/") for entry in entries):  # else the storage itself has each name once
        for entry in entries:
            name = Item(entry).name
            if name in last:
                raise KroncError(
                    f"{place} holds {last[name].rstrip('/')} and {entry.rstrip('/')}, whose results would both be "
                    f"named {name}: rename one"
                )
            last[name] = entry
    return entries[:limit]


def _captures(entries: Iterable[tuple[str, bool]]) -> Iterable[str]:
    for name, is_folder in entries:
        if name.startswith("."):
            continue
        if name in RESERVED and is_folder:
            raise KroncError(f"a capture is named {name}, as a file of every fleet's output: rename it")
        if is_folder:
            yield f"{name}/"
        elif name.lower().endswith(VIDEO_SUFFIXES):
            yield name
