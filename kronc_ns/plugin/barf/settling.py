"""Whether cameras have come to rest: how far they moved in the last tenth of a training."""

import numpy as np
from jaxtyping import Float

from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.geometry.poses import posed

SETTLED_DEG = 0.5
SETTLED_SHARE = 0.01


def last_tenth(first: int, steps: int) -> int:
    """The step at which the last tenth of ``steps`` from ``first`` on begins."""
    return first + steps - max(1, steps // 10)


def motion(before: Float[np.ndarray, "n 3 4"], after: Float[np.ndarray, "n 3 4"]) -> tuple[float, float]:
    """Median turn (degrees) and shift (share of the distance from the cameras' middle) between two times.

    After a similarity alignment: that all cameras drift together is no matter of theirs.
    """
    turn, shift = pose_errors(before.astype(np.float64), after.astype(np.float64))
    centres = after[..., 3]
    distance = np.linalg.norm(centres - centres.mean(0), axis=-1).mean()
    return float(np.median(turn)), float(np.median(shift) / max(distance, 1e-9))


def verdict(before: Float[np.ndarray, "n 3 4"], after: Float[np.ndarray, "n 3 4"]) -> tuple[bool, str]:
    """Whether poses have settled, and the sentence that says so."""
    if not posed(before).all():
        return False, "nothing is known of the poses' motion: the run ended before its last tenth"
    turn, shift = motion(before, after)
    moved = f"in the last tenth of the steps cameras moved by {turn:.2f} deg and {100 * shift:.2f} % (median)"
    if turn <= SETTLED_DEG and shift <= SETTLED_SHARE:
        return True, f"poses have settled: {moved}"
    return False, (
        f"poses have not settled: {moved}, expected at most {SETTLED_DEG:g} deg and {100 * SETTLED_SHARE:g} %; do not "
        "rely on them: train longer, or begin nearer"
    )
