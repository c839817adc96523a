"""Folders anywhere: whatever fsspec opens by a URL, with errors that name it."""

import hashlib
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from kronc_ns.capture.detection.model import file_sha256
from kronc_ns.errors import KroncError

EXTRA = "pip install 'kronc-ns[fleet]'"
_STAMPS = ("ETag", "etag", "md5Hash", "content_md5", "generation", "mtime", "LastModified", "modified", "created")
"""What file systems call a mark that changes with a file's content, the best first."""


class StorageError(KroncError):
    """Something could not be read or written that perhaps can be another time."""


@dataclass(frozen=True)
class Stored:
    """A file as its storage lists it."""

    name: str
    """Path in the folder that was listed."""
    size: int
    stamp: str
    """Changes with the content; empty where the storage has nothing of the kind."""


@dataclass(frozen=True)
class Place:
    """A folder by its URL."""

    url: str
    options: Mapping[str, Any] = field(default_factory=dict)
    """For fsspec: endpoints and the like."""

    @property
    def is_local(self) -> bool:
        """Whether its files are in this machine's own tree."""
        return self.url.startswith("file://")

    @property
    def is_in_memory(self) -> bool:
        """Whether only this process has it."""
        return self.url.startswith("memory://")

    def __str__(self) -> str:
        return self.url.removeprefix("file://")

    def __truediv__(self, name: str) -> "Place":
        return Place(f"{self.url.rstrip('/')}/{name.rstrip('/')}", self.options)

    def opened(self) -> tuple[Any, str]:
        """The file system (the same for all places of its kind in this process) and the path in it."""
        from fsspec.core import url_to_fs

        with _telling(self, "opened"):
            return url_to_fs(self.url, use_listings_cache=False, **self.options)

    def entries(self) -> Iterator[tuple[str, bool]]:
        """(name, whether it is a folder) of what lies in it, in no order."""
        fs, root = self.opened()
        if self.is_local:  # one by one, whatever their number
            with _telling(self, "listed"), os.scandir(root) as found:
                yield from ((entry.name, entry.is_dir()) for entry in found)
            return
        with _telling(self, "listed"):
            listed = fs.ls(root, detail=True)
        for info in listed:
            name = PurePosixPath(info["name"]).name
            if info["name"].rstrip("/") != root.rstrip("/"):  # an object store may list the folder itself
                yield name, info["type"] == "directory"

    def files(self) -> list[Stored]:
        """All files of it (or itself, where it is one), at any depth, by name."""
        fs, root = self.opened()
        with _telling(self, "listed"):
            found = fs.find(root, detail=True)
        listed = []
        for path, info in found.items():
            name = path[len(root) :].lstrip("/") or PurePosixPath(path).name
            if ".." in PurePosixPath(name).parts:
                raise KroncError(f"{self} holds {name!r}: expected names without '..'")
            if not name.endswith("/"):  # the mark of an empty folder
                stamp = next((str(info[key]) for key in _STAMPS if info.get(key)), "")
                listed.append(Stored(name, int(info["size"] or 0), stamp))
        return sorted(listed, key=lambda file: file.name)

    def fetch(self, files: Sequence[Stored], folder: Path) -> None:
        """Copy files of it into ``folder``; raises `StorageError` where one is not what was listed."""
        fs, root = self.opened()
        remote = [f"{root.rstrip('/')}/{file.name}" for file in files]
        if len(files) == 1 and fs.isfile(root):
            remote = [root]
        local = [folder / file.name for file in files]
        for parent in {path.parent for path in local}:
            parent.mkdir(parents=True, exist_ok=True)
        with _telling(self, "read"):
            fs.get(remote, [str(path) for path in local])
        for file, path in zip(files, local, strict=True):
            if not path.is_file() or path.stat().st_size != file.size:
                raise StorageError(f"{self / file.name} changed or vanished while it was read: leave it, then --resume")

    def send(self, folder: Path, last: Sequence[str] = ()) -> int:
        """Copy all files of ``folder`` into it, those named ``last`` in the end; the bytes."""
        files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
        names = [path.relative_to(folder).as_posix() for path in files]
        fs, root = self.opened()
        groups = [[name for name in names if name not in last], *([name] for name in last if name in names)]
        with _telling(self, "written"):
            for parent in {(Path(root) / name).parent for name in names} if self.is_local else ():
                parent.mkdir(parents=True, exist_ok=True)
            for group in groups:
                if group:
                    fs.put([str(folder / name) for name in group], [f"{root}/{name}" for name in group])
        return sum(path.stat().st_size for path in files)

    def read(self) -> bytes | None:
        """Content of it as a file; None where there is none."""
        fs, root = self.opened()
        try:
            with _telling(self, "read"):
                return fs.cat_file(root)
        except StorageError as error:
            if isinstance(error.__cause__, FileNotFoundError | NotADirectoryError):
                return None
            raise

    def write(self, content: bytes) -> None:
        """Write it as a file, whole or not at all."""
        fs, root = self.opened()
        with _telling(self, "written"):
            if not self.is_local:
                fs.pipe_file(root, content)
                return
            path = Path(root)
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = path.with_name(f".{path.name}.{os.getpid()}")
            try:
                temporary.write_bytes(content)
                temporary.replace(path)
            finally:
                temporary.unlink(missing_ok=True)

    def remove(self) -> None:
        """Delete it with all that is in it, if it is there."""
        fs, root = self.opened()
        with _telling(self, "deleted"):
            if fs.exists(root):
                fs.rm(root, recursive=True)


def place_of(url: str, options: Mapping[str, Any] | None = None) -> Place:
    """A folder given as a path or URL; raises `KroncError` where fsspec is missing or knows no such kind of URL."""
    try:
        from fsspec.core import split_protocol, url_to_fs
    except ImportError:
        raise KroncError(f"{url} needs fsspec, which is not installed: {EXTRA}") from None
    protocol, path = split_protocol(url)
    if protocol in (None, "file", "local"):
        return Place(f"file://{os.path.abspath(os.path.expanduser(path))}", {})
    try:
        url_to_fs(url, use_listings_cache=False, **(options or {}))
    except ImportError as error:
        raise KroncError(f"{url}: {_line(error)}") from None
    except ValueError as error:
        raise KroncError(f"{url}: {_line(error)}: expected a folder or a URL that fsspec takes") from None
    return Place(url.rstrip("/"), options or {})


def digest(files: Sequence[Stored], salt: str) -> str:
    """Hash of what a listing tells of files; empty where it cannot tell a change."""
    if not all(file.stamp for file in files):
        return ""
    lines = [salt, *(f"{file.name}\t{file.size}\t{file.stamp}" for file in files)]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def content_digest(folder: Path, files: Sequence[Stored], salt: str) -> str:
    """Hash of the files' names and contents."""
    whole = hashlib.sha256(salt.encode())
    for file in files:
        whole.update(f"\n{file.name}\t{file_sha256(folder / file.name)}".encode())
    return whole.hexdigest()


class _telling:
    """Errors of a file system, of which each has its own, as `StorageError`."""

    def __init__(self, place: Place, what: str) -> None:
        self._place, self._what = place, what

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, Exception) and not isinstance(error, KroncError):
            raise StorageError(f"{self._place} cannot be {self._what}: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    if isinstance(error, FileNotFoundError):
        return "it does not exist"
    if isinstance(error, PermissionError):
        return f"access is refused ({_line(error)}): check the credentials and the bucket's rights"
    if type(error).__name__ in ("NoCredentialsError", "PartialCredentialsError", "DefaultCredentialsError"):
        return "there are no credentials: set them as its command line tools take them"
    return error.strerror if isinstance(error, OSError) and error.strerror else _line(error)


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:300] or type(error).__name__
