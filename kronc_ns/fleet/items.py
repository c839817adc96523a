"""What a fleet is made of: captures, and what became of each."""

from dataclasses import dataclass, replace
from pathlib import PurePosixPath
from typing import Literal, TypeAlias

VIDEO_SUFFIXES = (".mov", ".mp4", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp")
"""Files that are captures by themselves, in lower case."""

Kind: TypeAlias = Literal["keypoints", "images", "video", "unknown"]
Action: TypeAlias = Literal["done", "large", "again"]


@dataclass(frozen=True)
class Item:
    """A capture of the fleet on its way."""

    entry: str
    """Its subfolder (with a slash at the end) or video in the captures' folder."""
    attempts: int = 0
    """Tasks that it has been part of."""
    strikes: int = 0
    """Of those, the ones that failed for no reason of its own."""
    avoid: str = ""
    """The node where it failed last."""

    @property
    def name(self) -> str:
        """Of its folder of results."""
        return PurePosixPath(self.entry).stem if self.is_video else self.entry.rstrip("/")

    @property
    def is_video(self) -> bool:
        """Whether it is a video file rather than a folder."""
        return not self.entry.endswith("/")

    def tried(self) -> "Item":
        """It takes part in another task."""
        return replace(self, attempts=self.attempts + 1)

    def seen(self) -> "Item":
        """That was no attempt, only a look at it."""
        return replace(self, attempts=self.attempts - 1)

    def struck(self, node: str) -> "Item":
        """It failed on a node, perhaps because of the node."""
        return replace(self, strikes=self.strikes + 1, avoid=node)


@dataclass(frozen=True)
class Row:
    """A row of fleet.parquet."""

    capture: str
    """Name of its folder of results."""
    path: str
    """URL of the capture."""
    kind: Kind
    """What was there to begin with."""
    status: str
    """converged, weak or failed as in kronc.json; error where there is no result."""
    reason: str
    views: int = 0
    solved: int = 0
    """Views whose pose rests on their own keypoints."""
    completed: int = 0
    """Views placed between their neighbours."""
    rmse_px: float | None = None
    median_px: float | None = None
    sigma_rot_deg: float | None = None
    """Of the median view."""
    sigma_trans_m: float | None = None
    """Of the median view."""
    focal_px: float | None = None
    seconds: float = 0.0
    """From the first look at the capture to its last result."""
    fetch_s: float = 0.0
    work_s: float = 0.0
    """Frames, detection and poses, with images also the report."""
    report_s: float = 0.0
    upload_s: float = 0.0
    bytes_in: int = 0
    bytes_out: int = 0
    node: str = ""
    attempts: int = 1
    version: str = ""
    """Of kronc_ns."""
    inputs: str = ""
    """Hash of the capture's content, the options and the version."""
    listed: str = ""
    """Hash of what the capture's storage tells of it without reading it, the options and the version."""
    thumbnail: str = ""
    """File in the folder of results."""
    has_report: bool = False
    """Whether there is a report.html in it."""
    finished: float = 0.0
    """Seconds since 1970."""


@dataclass(frozen=True)
class Outcome:
    """What a task tells of a capture."""

    item: Item
    action: Action
    """done: `row` says how it ended, now or earlier; large: it has images and wants a task of its own; again: something
    failed that may go well another time, or elsewhere."""
    row: Row | None = None
    reason: str = ""
