"""The frames of a capture in nerfstudio's layout: images/frame_00001.png, images_2/frame_00001.png, ..."""

import hashlib
import json
import os
import re
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from PIL import Image

from kronc_ns.capture.images import (
    HEIF_SUFFIXES,
    copy_upright,
    downscale_factors,
    level_path,
    upright_size,
    write_downscales,
)
from kronc_ns.capture.photos import IMAGE_SUFFIXES
from kronc_ns.capture.progress import Count
from kronc_ns.capture.selection import Sampling
from kronc_ns.capture.source import MIN_FRAMES, Source
from kronc_ns.capture.video import VideoFrames, probe_video
from kronc_ns.errors import KroncError
from kronc_ns.files.output import read_json, write_json

RECORD = ".kronc-frames.json"
"""Says which source the frames of an output folder are from, so that a second run need not make them again."""
_OURS = re.compile(r"frame_\d{5,}\.(npy|" + "|".join(suffix[1:] for suffix in IMAGE_SUFFIXES) + ")", re.IGNORECASE)
VIDEO_FRAME = "images/frame_{:05d}.png"
_PNG_LEVEL = 3  # half the time of zlib's default for a few per cent more bytes
_FOLDERS = re.compile(r"(images|masks|depths)(_\d+)?")


@dataclass(frozen=True)
class Frames:
    """Frames as they lie in the output folder."""

    names: tuple[str, ...]
    """``file_path`` of each: images/frame_00001.png."""
    source_names: tuple[str, ...]
    """What the source calls each of them; the same as `names` for a video."""
    sizes: tuple[tuple[int, int], ...]
    """(width, height) of each."""
    factors: tuple[int, ...]
    """Downscaled copies there are."""
    reused: bool
    """They were there already, made from the same source by an earlier run."""
    note: str = ""
    """What of the source was left out and why."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of most of them."""
        return usual_size(self.sizes)


def usual_size(sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """The most frequent one."""
    return Counter(sizes).most_common(1)[0][0]


def check_source(source: Source, sampling: Sampling | None = None) -> tuple[tuple[int, int], ...]:
    """(width, height) of the upright images from their headers, or of a video's frames (once) from the first of them.

    Raises `KroncError` unless there are at least 3 readable images, or a readable video.
    """
    if source.kind == "video":
        return (probe_video(source.path, sampling or Sampling()),)
    if len(source.images) < MIN_FRAMES:
        raise KroncError(
            f"{source.path} holds {len(source.images)} images: expected at least {MIN_FRAMES} views of the car"
        )
    sizes = tuple(upright_size(image, orient=source.cameras is None) for image in source.images)
    for image, size, camera in zip(source.images, sizes, source.cameras or (), strict=source.cameras is not None):
        if size != (camera.width, camera.height):
            raise KroncError(
                f"{image} is {_by(size)}, {source.path / 'transforms.json'} says {camera.width}x{camera.height}: "
                "expected intrinsics in the pixels of the images"
            )
    return sizes


def plan_frames(source: Source, num_downscales: int = 3) -> Frames | None:
    """What `prepare_frames` will make of images; None for a video, whose frames are chosen on the way."""
    if source.kind == "video":
        return None
    sizes = tuple(upright_size(image, orient=source.cameras is None) for image in source.images)
    factors = _common_factors(sizes, num_downscales)
    return Frames(frame_names(source.images), source.names, sizes, factors, reused=False, note=source.note)


def _common_factors(sizes: Sequence[tuple[int, int]], num_downscales: int) -> tuple[int, ...]:
    """Copies that even the smallest image has: trainers take one level of all."""
    return downscale_factors(min(sizes, key=min), num_downscales)


def find_frames(source: Source, out: Path, sampling: Sampling | None = None, num_downscales: int = 3) -> Frames | None:
    """The frames that an earlier `prepare_frames` with the same arguments left in ``out``, if they are all there."""
    try:
        content = read_json(out / RECORD)
        sizes = tuple((int(width), int(height)) for width, height in content["sizes"])
        names, factors = tuple(content["names"]), tuple(content["factors"])
        note, source_names = str(content["note"]), tuple(content["source_names"])
        frames = Frames(names, source_names, sizes, factors, reused=True, note=note)
        same = content["source"] == _signature(source, sampling or Sampling(), num_downscales)
    except (KroncError, KeyError, TypeError, ValueError):
        return None
    paths = [level_path(out / name, factor) for name in names for factor in (1, *factors)]
    return frames if same and all(path.is_file() for path in paths) else None


def prepare_frames(
    source: Source,
    out: Path,
    sampling: Sampling | None = None,
    num_downscales: int = 3,
    keep: Sequence[Path] = (),
    progress: Count | None = None,
) -> Frames:
    """Extract or copy the frames of ``source`` into ``out`` with downscaled copies.

    Photos are turned upright as their EXIF says; images of a scene folder are copied as they are stored, since
    its transforms.json speaks of those pixels. Frames of an earlier run are removed first, but nothing in ``keep``.
    """
    signature = _signature(source, sampling or Sampling(), num_downscales)
    count = progress or (lambda *_: None)
    video = VideoFrames(source.path, sampling or Sampling(), count) if source.kind == "video" else None
    if (out / RECORD).exists() and source.reference is None:
        (out / "reference.json").unlink(missing_ok=True)  # of the frames that go now
    (out / RECORD).unlink(missing_ok=True)
    _clear(out, keep)
    (out / "images").mkdir(exist_ok=True)
    if video is not None:
        total = _for_each(partial(_write, out, num_downscales), enumerate(video, start=1))
        names = tuple(VIDEO_FRAME.format(number) for number in range(1, total + 1))
        source_names, note = names, video.note()
    else:
        names, source_names, note = frame_names(source.images), source.names, source.note
        orient = source.cameras is None
        own = _common_factors([upright_size(image, orient) for image in source.images], num_downscales)

        def copy(image: Path, name: str) -> None:
            whole = copy_upright(image, out / name, orient)
            write_downscales(whole, out / name, own)

        pairs = list(zip(source.images, names, strict=True))
        _for_each(copy, pairs, lambda done: count(done, len(pairs), None))
    sizes = tuple(upright_size(out / name, orient=False) for name in names)
    factors = _common_factors(sizes, num_downscales)
    content = {"source": signature, "sizes": sizes, "factors": factors, "names": names, "source_names": source_names}
    write_json(out / RECORD, {**content, "note": note})
    return Frames(names, source_names, sizes, factors, reused=False, note=note)


def frame_names(images: Sequence[Path]) -> tuple[str, ...]:
    """New paths, of different stems: files that are all called frame_NNNNN keep their names, else are counted from 1.

    HEIF becomes JPEG, which trainers read.
    """
    if all(_OURS.fullmatch(image.name) for image in images) and len({image.stem for image in images}) == len(images):
        return tuple(f"images/{image.name}" for image in images)
    suffixes = (".jpg" if image.suffix.lower() in HEIF_SUFFIXES else image.suffix.lower() for image in images)
    return tuple(f"images/frame_{number:05d}{suffix}" for number, suffix in enumerate(suffixes, start=1))


def _write(out: Path, num_downscales: int, number: int, frame: Image.Image) -> None:
    """Write a frame of a video with its downscaled copies."""
    target = out / VIDEO_FRAME.format(number)
    frame.save(target, compress_level=_PNG_LEVEL)
    write_downscales(frame, target, downscale_factors(frame.size, num_downscales))


def _for_each(work: Callable[..., None], items: Iterable[tuple], progress: Callable[[int], None] | None = None) -> int:
    """Do ``work`` on all items with a few threads (coding and scaling release the GIL); returns how many there were.

    Items are taken as threads become free, so that few are held; the first error ends it.
    """
    workers = min(4, os.cpu_count() or 1)
    waiting: deque[Future[None]] = deque()
    done = 0

    def finish_one() -> None:
        nonlocal done
        waiting.popleft().result()
        done += 1
        if progress is not None:
            progress(done)

    with ThreadPoolExecutor(workers) as pool:
        try:
            for item in items:
                waiting.append(pool.submit(work, *item))
                if len(waiting) > workers:
                    finish_one()
            while waiting:
                finish_one()
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    return done


def _signature(source: Source, sampling: Sampling, num_downscales: int) -> str:
    """Hash of everything the frames depend on: files by path, size and time of change.

    Photos that were left out count, so that frames are known again before duplicates are looked for.
    """
    files = sorted((*source.images, *source.left_out)) if source.kind == "photos" else source.images or [source.path]
    states = [(str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    names = source.names if source.kind == "scene folder" else None
    settings = {"photos": sampling.keep_duplicates, "video": asdict(sampling)}.get(source.kind)
    text = json.dumps([states, names, source.cameras is None, settings, num_downscales])
    return hashlib.sha256(text.encode()).hexdigest()


def _clear(out: Path, keep: Sequence[Path]) -> None:
    """Remove frames, masks and depth maps of an earlier run; only files called as we call them."""
    kept = {path.resolve() for path in keep}
    for folder in out.iterdir():
        if folder.is_dir() and _FOLDERS.fullmatch(folder.name) and folder.resolve() not in kept:
            for file in folder.iterdir():
                if _OURS.fullmatch(file.name):
                    file.unlink()


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
