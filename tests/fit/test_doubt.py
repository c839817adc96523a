"""The best other pose of a view."""

from dataclasses import replace

import numpy as np
import pytest

from kronc_ns.fit.attempts import Attempt
from kronc_ns.fit.doubt import lead
from kronc_ns.geometry.camera import reproject

VIEW = 6


def astray(attempt: Attempt, met: int) -> Attempt:
    """The attempt with one view where another stands, and ``met`` of its detections moved to where it looks right."""
    found = attempt.found
    c2w = found.c2w.copy()
    c2w[VIEW] = found.c2w[VIEW + 10]  # half a lap away
    keypoints = found.scene.keypoints.copy()
    moved = np.flatnonzero(found.scene.seen[VIEW] & (attempt.inlier.sum(0) > 1))[:met]
    keypoints[VIEW, moved, :2] = reproject(found.points[moved], c2w[VIEW : VIEW + 1], found.scene.camera)[0]
    inlier = attempt.inlier.copy()
    inlier[VIEW] = False
    inlier[VIEW, moved] = True
    return replace(
        attempt, found=replace(found, scene=replace(found.scene, keypoints=keypoints), c2w=c2w), inlier=inlier
    )


def test_the_right_pose_of_many_detections_is_not_asked(attempt):
    assert np.isinf(lead(attempt)).all()


@pytest.mark.parametrize("met", [5, 8])
def test_a_view_of_which_few_detections_agree_is_asked_and_told(attempt, met):
    """However few these are: a judge that knows only some of the points may think that they are half."""
    behind = lead(astray(attempt, met))
    assert behind[VIEW] < 0
    assert np.isinf(np.delete(behind, VIEW)).all()
