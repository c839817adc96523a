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


def test_points_that_one_other_view_sees_speak_for_no_pose(attempt):
    """They lie where this view sees them, wherever it stands."""
    found, met = attempt.found, np.flatnonzero(attempt.inlier[VIEW])[:10]
    keypoints = found.scene.keypoints.copy()
    keypoints[VIEW, :, 2] = np.isin(np.arange(keypoints.shape[1]), met)
    inlier = attempt.inlier.copy()
    inlier[VIEW] = np.isin(np.arange(inlier.shape[1]), met)
    known = replace(attempt, found=replace(found, scene=replace(found.scene, keypoints=keypoints)), inlier=inlier)
    assert lead(known)[VIEW] > 3
    alone = inlier.copy()
    alone[np.arange(len(inlier)) > VIEW + 1] = False
    alone[np.arange(len(inlier)) < VIEW] = False
    assert (alone[:, met].sum(0) <= 2).all()
    assert lead(replace(known, inlier=alone))[VIEW] <= 0
