"""What several tests of fits need."""

from dataclasses import replace

import numpy as np
import pytest
from jaxtyping import Float

from kronc_ns.fit.car_frame import template_frame
from kronc_ns.geometry.alignment import umeyama
from kronc_ns.geometry.rotations import rotation_angle_deg
from kronc_ns.keypoints.schema import APOLLOCAR3D_66, KeypointSchema
from kronc_ns.keypoints.template import car_template
from kronc_ns.scene import Scene

PLAIN = KeypointSchema("things-66", tuple(f"thing {j}" for j in range(66)), tuple(range(66)))
"""As many points of something nobody has a template of."""


def assert_stands_as(points: Float[np.ndarray, "j 3"], truth: Float[np.ndarray, "j 3"]) -> None:
    """x forward, y left, z up, ground at z = 0; metres up to the template's guess of the car's size."""
    known = np.isfinite(points).all(-1)
    assert known.sum() > 60
    to_truth = umeyama(points[known], truth[known])
    assert rotation_angle_deg(to_truth.rotation) < 1.0
    assert to_truth.scale == pytest.approx(1.0, abs=0.06)
    assert np.linalg.norm(to_truth.translation) < 0.1
    assert np.median(np.linalg.norm(to_truth.apply(points[known]) - truth[known], axis=-1)) < 0.02


def length_m(points: Float[np.ndarray, "j 3"]) -> float:
    """Length of a car, as the template tells it from the points."""
    template = car_template(APOLLOCAR3D_66)
    assert template is not None
    frame = template_frame(points, template)
    return template.length_m(frame.apply(points)) / frame.scale


def without_overlap(scene: Scene) -> Scene:
    """Three views of five points each, no point in two of them."""
    keypoints = np.zeros_like(scene.keypoints)
    for view in range(3):
        keypoints[view, 5 * view : 5 * view + 5] = [10.0, 20.0, 1.0]
    return replace(scene, keypoints=keypoints)
