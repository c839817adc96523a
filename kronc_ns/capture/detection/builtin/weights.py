"""The network's file, and the card beside it: kronc66.onnx and kronc66.json.

The hash stands in the card and not in the code: calibration and thresholds there belong to exactly these weights, and
training writes both files at once, so that no third place can fall out of step.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from kronc_ns.capture.detection.model import file_sha256, open_session
from kronc_ns.errors import KroncError
from kronc_ns.files.output import read_json

WEIGHTS = Path(__file__).with_name("kronc66.onnx")
INPUT_SIZE = (320, 224)
"""(width, height) of what the network sees."""
STRIDE = 4
"""Input pixels per cell of the maps: cell c covers [4 c, 4 c + 4)."""
_REMEDY = "reinstall kronc-ns, or give the file as training wrote it"


@dataclass(frozen=True)
class Card:
    """What is known of the weights besides the network; its fields are the keys of the JSON file."""

    version: float
    sha256: str
    calibration: tuple[tuple[float, float], ...]
    """Knots (what the network says, share that is right) of a monotone piecewise-linear function."""
    sigma_factor: float
    """Standard deviation of a place along one axis per spread of its heat."""
    point_confidence: float
    """Points below are not given."""
    car_points: float
    """Points of a confidence above 0.5 that a car must have."""
    car_confidence: float
    """Mean confidence that the points of a car must have."""
    car_area: float
    """Share of the last look that a car must fill."""

    def calibrated(self, confidence: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
        """Probability that the points lie within 2 % of the car's diagonal."""
        said, right = np.array(self.calibration).T
        return np.interp(confidence, said, right)


class Answer(NamedTuple):
    """What the network says of one picture."""

    heat: Float[np.ndarray, "j h w"]
    """Probability over the cells: where a point is, if it is visible."""
    visible: Float[np.ndarray, "j"]
    """Probability that a point is visible and in the picture."""
    mask: Float[np.ndarray, "h w"]
    """Probability that a cell shows the main car."""


class Network:
    """The network, loaded and checked against its card."""

    def __init__(self, weights: Path = WEIGHTS) -> None:
        for file in (weights, weights.with_suffix(".json")):
            if not file.is_file():
                raise KroncError(f"{file} does not exist: {_REMEDY}")
        self.card = read_card(weights.with_suffix(".json"))
        found = file_sha256(weights)
        if found != self.card.sha256:
            raise KroncError(
                f"{weights} was changed: its sha256 is {found}, expected {self.card.sha256} "
                f"({weights.with_suffix('.json').name}): {_REMEDY}"
            )
        self._session = open_session(weights)
        inputs = [(i.type, i.shape[1:]) for i in self._session.get_inputs()]
        names = [output.name for output in self._session.get_outputs()]
        if inputs != [("tensor(uint8)", [*INPUT_SIZE[::-1], 3])] or {*names} != {*Answer._fields}:
            raise KroncError(
                f"{weights} takes {inputs} and gives {names}: expected uint8 [1, {INPUT_SIZE[1]}, {INPUT_SIZE[0]}, 3] "
                f"and {', '.join(Answer._fields)}: {_REMEDY}"
            )
        self._input: str = self._session.get_inputs()[0].name
        self.identity = f"{found} {file_sha256(weights.with_suffix('.json'))}"
        """Changes with the weights and with the card."""

    def __call__(self, rgb: UInt8[np.ndarray, "h w 3"]) -> Answer:
        """The answer for one picture of `INPUT_SIZE`."""
        outputs = self._session.run(list(Answer._fields), {self._input: rgb[None]})
        return Answer(*(output[0].astype(np.float64) for output in outputs))


def read_card(file: Path) -> Card:
    """Read and check the card of a weights file."""
    content = read_json(file)
    names = [field.name for field in fields(Card)]
    if not isinstance(content, Mapping) or not {*names} <= content.keys():
        raise KroncError(f"{file}: expected an object with {', '.join(names)}: {_REMEDY}")
    try:
        knots = tuple((float(said), float(right)) for said, right in content["calibration"])
        numbers = {name: float(content[name]) for name in names if name not in ("sha256", "calibration")}
    except (TypeError, ValueError):
        raise KroncError(f"{file}: expected numbers, and pairs of numbers as calibration: {_REMEDY}") from None
    if not knots or (np.diff(knots, axis=0) < 0).any() or not 0 <= np.min(knots) <= np.max(knots) <= 1:
        raise KroncError(f"{file}: calibration {list(knots)} does not rise from 0 to 1: {_REMEDY}")
    return Card(sha256=str(content["sha256"]), calibration=knots, **numbers)
