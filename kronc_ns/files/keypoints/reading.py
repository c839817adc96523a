"""Which tool wrote a keypoint file is told by what is in it."""

from dataclasses import replace
from pathlib import Path

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints.coco import read_coco
from kronc_ns.files.keypoints.coco_results import read_coco_results
from kronc_ns.files.keypoints.detections import Detections
from kronc_ns.files.keypoints.label_studio import is_label_studio, read_label_studio
from kronc_ns.files.keypoints.mmpose import is_mmpose, is_mmpose_video, read_mmpose
from kronc_ns.files.keypoints.openpifpaf import SUFFIX, read_openpifpaf
from kronc_ns.files.keypoints.own import read_own
from kronc_ns.files.keypoints.rows import told_unusable, usable
from kronc_ns.files.keypoints.schemas import schema_named
from kronc_ns.files.keypoints.ultralytics import holds_ultralytics, read_ultralytics
from kronc_ns.files.output import read_json
from kronc_ns.keypoints.schema import KeypointSchema

FORMATS = (
    "our keypoints.json, COCO annotations or results, predictions of OpenPifPaf or MMPose, Ultralytics labels/*.txt, "
    "or Label Studio JSON"
)


def read_keypoints(path: Path, names: str | None = None) -> Detections:
    """Read a keypoint file or folder of any format that is known.

    ``names`` says which points they are (``--keypoint-names``) where the file does not, or says it wrongly. Points
    whose numbers are none count as not seen, and a note tells how many.
    """
    found = _read(path, None if names is None else schema_named(names))
    note = told_unusable(found.frames, found.schema)
    if note:
        found = replace(found, notes=(*found.notes, f"{found.source}: {note}"))
    found = replace(found, frames={name: usable(rows) for name, rows in found.frames.items()})
    for name, instances in found.frames.items():
        if instances.size and (most := instances[..., 2].max()) > 1:
            raise KroncError(f"{found.source}, {name}: a confidence is {most:g}: expected 0 (not seen) to 1")
        if instances.size and instances[..., 2].min() < 0:
            raise KroncError(f"{found.source}, {name}: a confidence is negative: expected 0 (not seen) to 1")
    return found


def _read(path: Path, names: KeypointSchema | None) -> Detections:
    if path.is_dir():
        return _read_folder(path, names)
    if not path.exists():
        raise KroncError(f"{path} does not exist: expected {FORMATS}")
    if path.suffix.lower() == ".txt":
        return read_ultralytics(path.parent, names)
    content = read_json(path)
    if isinstance(content, dict) and {"annotations", "images"} <= content.keys():
        return read_coco(path, content, names)
    if isinstance(content, dict) and "frames" in content:
        return read_own(path, content, names)
    if path.name.endswith(SUFFIX):
        return read_openpifpaf(path.parent, names)
    if isinstance(content, list) and content:
        if isinstance(content[0], dict) and {"image_id", "keypoints"} <= content[0].keys():
            return read_coco_results(path, content, names)
        if is_mmpose(content):
            return read_mmpose(path.parent, names)
        if is_label_studio(content):
            return read_label_studio(path, content, names)
        if is_mmpose_video(content):
            raise KroncError(
                f"{path} has MMPose's keypoints of a video: run it on the images instead, and give its predictions/"
            )
    raise KroncError(f"{path} is no keypoint file that can be read: expected {FORMATS}")


def _read_folder(folder: Path, names: KeypointSchema | None) -> Detections:
    own = folder / "keypoints.json"
    if own.exists():
        return _read(own, names)
    if any(folder.glob(f"*{SUFFIX}")):
        return read_openpifpaf(folder, names)
    if holds_ultralytics(folder):
        return read_ultralytics(folder, names)
    for place in (folder / "predictions", folder):
        files = sorted(place.glob("*.json"))
        if files and all(is_mmpose(read_json(file)) for file in files):
            return read_mmpose(place, names)
    raise KroncError(f"{folder} holds no keypoint file: expected {FORMATS}")
