"""Options that no scene can be solved with."""

import math

import pytest

from kronc_ns.errors import KroncError
from kronc_ns.fit.options import KroncConfig
from kronc_ns.solve.options import AdamConfig, LmConfig


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"radius_m": 0.0}, "radius_m is 0.0: expected a finite number above 0"),
        ({"laps": -1.0}, "laps is -1.0"),
        ({"adam": AdamConfig(steps=0)}, "adam.steps is 0"),
        ({"adam": AdamConfig(learning_rate=math.nan)}, "adam.learning_rate is nan"),
        ({"lm": LmConfig(iterations=0)}, "lm.iterations is 0"),
        ({"lm": LmConfig(tolerance=math.inf)}, "lm.tolerance is inf"),
        ({"car_length_m": 4400.0}, "car_length_m is 4400: expected metres"),
        ({"solver": "adam", "refine_focal": True}, 'need solver "lm"'),
        ({"solver": "lm", "depth_init": "prior"}, 'needs solver "adam"'),
    ],
)
def test_impossible_options_are_refused(options, message):
    with pytest.raises(KroncError, match=message):
        KroncConfig(**options)


@pytest.mark.parametrize("weights", [(0.0, 0.0), (-1.0, 1.0), (math.nan, 1.0), (1.0, math.inf)])
def test_impossible_weights_are_refused(weights):
    with pytest.raises(KroncError, match="not both 0"):
        KroncConfig(solver="adam", adam=AdamConfig(weight_2d=weights[0], weight_3d=weights[1]))
