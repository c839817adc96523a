"""What is said of poses at the end of a training."""

import math

import numpy as np
import pytest

from kronc_ns.geometry.alignment import Similarity
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.plugin.barf.settling import last_tenth, motion, verdict
from kronc_ns.synthetic.scenes import make_capture
from kronc_ns.synthetic.variations import noisy_poses


@pytest.fixture(scope="module")
def poses():
    return make_capture("walk", 12, 0).c2w


def test_the_last_tenth_begins_where_nine_are_done():
    assert last_tenth(0, 1000) == 900
    assert last_tenth(500, 20) == 518
    assert last_tenth(0, 3) == 2


def test_a_world_that_moves_as_a_whole_is_at_rest(poses):
    moved = Similarity(1.3, so3_exp(np.array([0.2, 0.1, -0.4])), np.array([1.0, 2, 3])).apply_to_poses(poses)
    assert motion(poses, moved) == pytest.approx((0, 0), abs=1e-6)
    settled, words = verdict(poses, moved)
    assert settled
    assert words.startswith("poses have settled")


def test_cameras_that_move_have_not_settled(poses):
    moved = noisy_poses(poses, 2.0, 0.2, np.random.default_rng(0))
    turn, shift = motion(poses, moved)
    assert 2 < turn < 5
    assert 0.02 < shift < 0.1
    settled, words = verdict(poses, moved)
    assert not settled
    assert "have not settled" in words


def test_a_run_that_ended_early_says_so(poses):
    settled, words = verdict(np.full_like(poses, math.nan), poses)
    assert not settled
    assert "ended before its last tenth" in words
