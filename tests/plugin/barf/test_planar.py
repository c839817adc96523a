"""Patches of one image find their places while a network learns the image, if it learns from coarse to fine."""

import pytest

pytest.importorskip("nerfstudio")

from tests.plugin.barf.planar import align

pytestmark = [pytest.mark.nerfstudio, pytest.mark.slow]
STEPS = 800


@pytest.mark.parametrize(
    ("method", "motion", "steps"), [("barf", "homography", 1000), ("barf", "rigid", STEPS), ("l2g", "rigid", STEPS)]
)
def test_patches_find_their_places(method, motion, steps):
    found = align(method, motion, steps)
    print(method, motion, found)
    assert found.before_px > 10
    assert found.after_px <= 1


def test_with_all_frequencies_from_the_start_they_do_not():
    found = align("plain", "rigid", STEPS)
    print(found)
    assert found.after_px > 5
