"""The detectors there are, and how the user chooses one; imports nothing, so that commands can show their help."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from typing_extensions import assert_never

from kronc_ns.errors import KroncError

if TYPE_CHECKING:
    from kronc_ns.capture.detection.detector import Detector

DetectorName: TypeAlias = Literal["builtin", "none", "openpifpaf", "onnx", "yolo-pose", "simcc"]


@dataclass
class DetectorOptions:
    """How keypoints are found."""

    detector: DetectorName | None = None
    """Find the keypoints with the network in the package (builtin; the default where no file holds keypoints), with
    openpifpaf (in an environment of its own, made on first use), a composite-field network that `kronc
    convert-detector` wrote (onnx), a YOLO pose model or a SimCC model such as RTMPose, both as ONNX; or not at all."""
    detector_weights: Path | None = None
    """ONNX file of the detector (for builtin another one than the package's, with its JSON file beside it); for
    openpifpaf a checkpoint or its name (default shufflenetv2k16-apollo-66)."""
    detector_python: Path | None = None
    """A Python that has openpifpaf, instead of one that uvx provides."""

    def make(self, default: Literal["builtin", "none"] = "none") -> "Detector | None":
        """The detector that was chosen, else the default, ready to run; raises `KroncError` for what is missing."""
        name, weights = self.detector or default, self.detector_weights
        if self.detector in (None, "none") and (weights is not None or self.detector_python is not None):
            raise KroncError("--detector-weights and --detector-python say what a --detector uses: give that too")
        match name:
            case "none":
                return None
            case "builtin":
                from kronc_ns.capture.detection.builtin.detector import BuiltinDetector

                return BuiltinDetector(weights)
            case "openpifpaf":
                from kronc_ns.capture.detection.pifpaf import OpenPifPafDetector

                return OpenPifPafDetector(weights, self.detector_python)
            case "onnx":
                from kronc_ns.capture.detection.composite import CompositeFieldDetector

                return CompositeFieldDetector(self._weights())
            case "yolo-pose":
                from kronc_ns.capture.detection.yolo_pose import YoloPoseDetector

                return YoloPoseDetector(self._weights())
            case "simcc":
                from kronc_ns.capture.detection.simcc import SimccDetector

                return SimccDetector(self._weights())
            case _:
                assert_never(name)

    def _weights(self) -> Path:
        if self.detector_weights is None:
            raise KroncError(f"--detector {self.detector} needs --detector-weights: expected an ONNX file")
        return self.detector_weights
