"""ONNX files and the JSON file beside each that says what the network does not."""

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from kronc_ns.errors import KroncError
from kronc_ns.files.keypoints import read_schema
from kronc_ns.files.output import read_json
from kronc_ns.keypoints.schema import KeypointSchema, schema_of_count

INSTALL = "pip install onnxruntime"


@dataclass(frozen=True)
class OnnxModel:
    """A network that onnxruntime has loaded, with one image input."""

    path: Path
    session: Any
    """``onnxruntime.InferenceSession``."""
    sidecar: Mapping[str, Any]
    """NAME.json beside NAME.onnx; empty where there is none."""

    @property
    def metadata(self) -> Mapping[str, str]:
        """What the exporter wrote into the file itself."""
        return self.session.get_modelmeta().custom_metadata_map

    @property
    def input_size(self) -> tuple[int, int] | None:
        """(width, height), where the network takes one size only."""
        height, width = self.session.get_inputs()[0].shape[2:]
        return (width, height) if isinstance(width, int) and isinstance(height, int) else None

    @cached_property
    def sha256(self) -> str:
        """Hash of the file."""
        return file_sha256(self.path)

    def schema(self, count: int) -> KeypointSchema:
        """The sidecar's schema, else a known one of so many points."""
        described = self.sidecar.get("schema")
        if described is None:
            return schema_of_count(count)
        schema = read_schema(described, self.path.with_suffix(".json"))
        if len(schema) != count:
            raise KroncError(
                f"{self.path} finds {count} points, but the schema in {self.path.with_suffix('.json')} names "
                f"{len(schema)}: expected the JSON file that belongs to it"
            )
        return schema

    def number(self, key: str, default: float) -> float:
        """A number above 0 of the sidecar."""
        value = self.sidecar.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            raise KroncError(f"{self.path.with_suffix('.json')}: {key} is {value!r}: expected a number above 0")
        return float(value)

    def run(self, image: np.ndarray) -> list[np.ndarray]:
        """All outputs for one batch [1, 3, h, w], in float32."""
        declared = self.session.get_inputs()[0]
        kind = np.float16 if "float16" in declared.type else np.float32
        try:
            outputs = self.session.run(None, {declared.name: image.astype(kind)})
        except Exception as error:  # onnxruntime's own exceptions share no base class
            size = f"{image.shape[3]}x{image.shape[2]}"
            raise KroncError(
                f"{self.path} fails on an input of {size} ({_first_line(error)}): export it anew"
            ) from None
        return [output.astype(np.float32) for output in outputs]


def open_model(path: Path) -> OnnxModel:
    """Load an ONNX file of a detector that takes planes [1, 3, h, w]."""
    session = open_session(path)
    card = path.with_suffix(".json")
    sidecar = read_json(card) if card.is_file() else {}
    if not isinstance(sidecar, dict):
        raise KroncError(f"{card} is no JSON object: expected what `kronc convert-detector` writes beside an ONNX file")
    inputs = session.get_inputs()
    if len(inputs) != 1 or len(inputs[0].shape) != 4 or inputs[0].shape[1] not in (3, "channels"):
        shapes = ", ".join(str(i.shape) for i in inputs)
        raise KroncError(f"{path} takes {shapes}: expected a detector of one RGB image, [1, 3, height, width]")
    return OnnxModel(path, session, sidecar)


def open_session(path: Path) -> Any:
    """``onnxruntime.InferenceSession`` of a file, on the GPU where onnxruntime's package for GPUs is installed."""
    try:
        import onnxruntime
    except ImportError:
        raise KroncError(f"{path} needs onnxruntime, which is not installed: {INSTALL}") from None
    if not path.is_file():
        raise KroncError(f"{path} does not exist: expected the ONNX file of a keypoint detector")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3  # its warnings about graphs help no user
    # by itself it counts physical cores, of which a share of a machine may have one
    options.intra_op_num_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # leave idle cores to others
    wanted = ("CUDAExecutionProvider", "CPUExecutionProvider")
    providers = [name for name in wanted if name in onnxruntime.get_available_providers()]
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=providers)
    except Exception as error:  # onnxruntime's own exceptions share no base class
        reason = _first_line(error)
        raise KroncError(f"{path} is no ONNX file that onnxruntime can run ({reason}): export it anew") from None


def file_sha256(path: Path) -> str:
    """Hash of a file's content, read in pieces."""
    with path.open("rb") as file:
        digest = hashlib.sha256()
        while piece := file.read(1 << 20):
            digest.update(piece)
    return digest.hexdigest()


def _first_line(error: Exception) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__)
