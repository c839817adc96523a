"""The image files of a folder, in the order in which they were taken, and what lies between them."""

import os
import re
from collections import Counter
from pathlib import Path

from kronc_ns.capture.images import HEIF_SUFFIXES, read_heif
from kronc_ns.errors import KroncError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
"""Image files that are taken, in lower case."""
PHOTO_SUFFIXES = (*IMAGE_SUFFIXES, *HEIF_SUFFIXES)
"""What is taken of a folder of photos."""
_VIDEO_SUFFIXES = (".mov", ".mp4", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp")
_OTHER_FOLDERS = re.compile(r"\..*|((images|masks|depths)_\d+)|masks|depths")
_SCENE_FILES = ("transforms.json", "kronc.json")


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key under which img2 comes before img10."""
    return [
        (0, int(part), "") if part.isdecimal() else (1, 0, part.lower()) for part in re.split(r"(\d+)", name) if part
    ]


def list_images(folder: Path, suffixes: tuple[str, ...] = IMAGE_SUFFIXES) -> tuple[Path, ...]:
    """Image files of a folder (no subfolders, no hidden files), naturally sorted."""
    files = [f for f in folder.iterdir() if f.suffix.lower() in suffixes and not f.name.startswith(".") and f.is_file()]
    return tuple(sorted(files, key=lambda file: natural_key(file.name)))


def list_below(folder: Path, suffixes: tuple[str, ...] = IMAGE_SUFFIXES) -> tuple[Path, ...]:
    """Image files of a folder and its subfolders (none that is hidden), naturally sorted."""
    below: list[Path] = []
    for here, folders, _ in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        below += list_images(Path(here), suffixes)
    return tuple(sorted(below, key=lambda file: natural_key(file.relative_to(folder).as_posix())))


def find_photos(data: Path) -> tuple[Path, tuple[Path, ...]]:
    """The folder of a capture that holds its photos (``data`` or its ``images``), and the photos.

    They may lie in subfolders, as of several rounds, where the folder itself holds none.
    """
    for folder in (data, data / "images"):
        if folder.is_dir() and (images := list_images(folder, PHOTO_SUFFIXES)):
            break
    else:
        folder = data / "images" if (data / "images").is_dir() else data
        images = _in_subfolders(folder)
    if not images:
        others = Counter(f.suffix.lower() for f in folder.iterdir() if f.is_file() and f.suffix)
        found = ", ".join(f"{count} {suffix}" for suffix, count in others.most_common(3)) or "no files"
        raise KroncError(
            f"{folder} holds no images that can be read ({found}): expected {', '.join(PHOTO_SUFFIXES)}, "
            "a transforms.json, or as --data a video file itself"
        )
    if heif := next((image for image in images if image.suffix.lower() in HEIF_SUFFIXES), None):
        read_heif(heif)
    return folder, images


def _in_subfolders(folder: Path) -> tuple[Path, ...]:
    inner = sorted(f for f in folder.iterdir() if f.is_dir() and not _OTHER_FOLDERS.fullmatch(f.name))
    if scene := next((f / name for f in inner for name in _SCENE_FILES if (f / name).exists()), None):
        raise KroncError(f"{folder} holds several captures ({scene}): expected one; give its folder, {scene.parent}")
    images = [image for subfolder in inner for image in list_below(subfolder, PHOTO_SUFFIXES)]
    return tuple(sorted(images, key=lambda file: natural_key(file.relative_to(folder).as_posix())))


def told_of(folder: Path, images: tuple[Path, ...]) -> str:
    """In words, what is not to be seen from the number of photos: their subfolders, and videos that are left out."""
    subfolders = list(dict.fromkeys(image.parent.relative_to(folder).as_posix() for image in images))
    notes = [] if subfolders == ["."] else [f"of the subfolders {', '.join(subfolders)}"]
    photos = {image.with_suffix("").as_posix().lower() for image in images}
    beside = [video for parent in {image.parent for image in images} for video in list_images(parent, _VIDEO_SUFFIXES)]
    others = sorted(video.name for video in beside if video.with_suffix("").as_posix().lower() not in photos)
    if len(beside) > len(others):
        notes.append(f"the videos of {len(beside) - len(others)} Live Photos were left out")
    if others:
        more = f" and {len(others) - 1} more videos" if len(others) > 1 else ""
        notes.append(f"{others[0]}{more} beside the photos left out (give a video itself as --data)")
    return "; ".join(notes)


def relative_names(folder: Path, images: tuple[Path, ...]) -> tuple[str, ...]:
    """Names as keypoint files and masks may have them: as seen from the folder of the photos."""
    return tuple(image.relative_to(folder).as_posix() for image in images)
