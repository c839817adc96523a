"""`kronc convert-detector`: a car model of OpenPifPaf as ONNX, which then needs no OpenPifPaf."""

from dataclasses import dataclass
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


@dataclass(kw_only=True)
class ConvertDetector:
    """Convert a car model of OpenPifPaf for --detector onnx: OUTPUT.onnx and OUTPUT.json.

    Runs OpenPifPaf in an environment of its own, which uvx makes on first use; afterwards it is not needed.
    """

    output: Path
    """ONNX file to write; NAME.json is written beside it. Neither may exist."""
    checkpoint: Path | None = None
    """Checkpoint file, or a name that OpenPifPaf knows and downloads (default shufflenetv2k16-apollo-66)."""
    sha256: str | None = None
    """What the checkpoint must hash to; the hash of what was converted is written to NAME.json in any case."""
    detector_python: Path | None = None
    """A Python that has openpifpaf, instead of one that uvx provides."""

    def run(self) -> int:
        """Convert and write."""
        card_file = self.output.with_suffix(".json")
        if self.output.suffix != ".onnx":
            raise KroncError(f"--output {self.output}: expected a name that ends in .onnx")
        for file in (self.output, card_file):
            if file.exists():
                raise KroncError(f"{file} exists already: give another --output")
        environment = find_environment(self.detector_python)
        checkpoint, _, named = find_checkpoint(self.checkpoint)
        with TemporaryDirectory(prefix="kronc-convert-") as temporary, atomic_path(self.output) as model:
            folder = Path(temporary)
            arguments = [str(_SCRIPT), checkpoint, str(model.resolve()), "card.json"]
            with environment.run(arguments, folder) as child:
                found = child.wait_for_json(folder / "card.json")
            assert isinstance(found, dict)
            card = self._card(found, file_sha256(model), named)
        write_json(card_file, card)
        print(f"{len(found['keypoints'])} points: {self.output}, {card_file}")
        return 0

    def _card(self, found: dict[str, Any], sha256: str, named: KeypointSchema) -> dict[str, Any]:
        checkpoint = found["checkpoint"]
        if self.sha256 is not None and checkpoint["sha256"] != self.sha256.lower():
            raise KroncError(
                f"{checkpoint['name']} has sha256 {checkpoint['sha256']}, not --sha256 {self.sha256}: fetch it anew"
            )
        names = tuple(map(str, found["keypoints"]))
        # the network's own names say nothing of mirror images; a known schema does, or the file beside the checkpoint
        own = KeypointSchema(Path(checkpoint["name"]).stem, names, tuple(range(len(names))))
        schema = named if len(named) == len(names) else own
        return {
            "schema": describe_schema(schema),
            "stride": found["stride"],
            "threshold": _THRESHOLD,
            "sha256": sha256,
            "checkpoint": checkpoint,
        }
