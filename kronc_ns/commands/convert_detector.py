"""`kronc convert-detector`."""

from dataclasses import dataclass
from pathlib import Path


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
        from kronc_ns.capture.detection.conversion import convert_detector

        count, card = convert_detector(self.output, self.checkpoint, self.sha256, self.detector_python)
        print(f"{count} points: {self.output}, {card}")
        return 0
