"""A car model of OpenPifPaf as ONNX, which then needs no OpenPifPaf."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from kronc_ns.capture.detection.environment import find_environment
from kronc_ns.capture.detection.model import file_sha256
from kronc_ns.capture.detection.pifpaf import find_checkpoint
from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import describe_schema
from kronc_ns.files.output import atomic_path, write_json
from kronc_ns.keypoints.schema import KeypointSchema

_SCRIPT = Path(__file__).with_name("isolated") / "export_fields.py"
_THRESHOLD = 0.1  # of a keypoint's confidence


def convert_detector(
    output: Path, checkpoint: Path | None = None, sha256: str | None = None, detector_python: Path | None = None
) -> tuple[int, Path]:
    """Convert ``checkpoint`` (a file, or a name that OpenPifPaf knows) to the ONNX file ``output``.

    Beside it goes NAME.json with what a detector has to know of it. ``sha256`` is what the checkpoint must hash to;
    ``detector_python`` a Python that has openpifpaf. Returns the number of keypoints and the path of NAME.json.
    """
    card_file = output.with_suffix(".json")
    if output.suffix != ".onnx":
        raise KroncError(f"--output {output}: expected a name that ends in .onnx")
    for file in (output, card_file):
        if file.exists():
            raise KroncError(f"{file} exists already: give another --output")
    environment = find_environment(detector_python)
    found_checkpoint, _, named = find_checkpoint(checkpoint)
    with TemporaryDirectory(prefix="kronc-convert-") as temporary, atomic_path(output) as model:
        folder = Path(temporary)
        arguments = [str(_SCRIPT), found_checkpoint, str(model.resolve()), "card.json"]
        with environment.run(arguments, folder) as child:
            found = child.wait_for_json(folder / "card.json")
        assert isinstance(found, dict)
        card = _card(found, file_sha256(model), named, sha256)
    write_json(card_file, card)
    return len(found["keypoints"]), card_file


def _card(found: dict[str, Any], model_sha256: str, named: KeypointSchema, expected: str | None) -> dict[str, Any]:
    checkpoint = found["checkpoint"]
    if expected is not None and checkpoint["sha256"] != expected.lower():
        raise KroncError(
            f"{checkpoint['name']} has sha256 {checkpoint['sha256']}, not --sha256 {expected}: fetch it anew"
        )
    names = tuple(map(str, found["keypoints"]))
    # the network's own names say nothing of mirror images; a known schema does, or the file beside the checkpoint
    own = KeypointSchema(Path(checkpoint["name"]).stem, names, tuple(range(len(names))))
    schema = named if len(named) == len(names) else own
    return {
        "schema": describe_schema(schema),
        "stride": found["stride"],
        "threshold": _THRESHOLD,
        "sha256": model_sha256,
        "checkpoint": checkpoint,
    }
