"""The rows of `kronc bench --suite nvs`: are solved poses as good to train on as exact ones?"""

from functools import partial

from kronc_ns.benchmark.nvs_measures import EXACT, PoseKind, Trainings, judge_exact, judge_nothing, judge_solved
from kronc_ns.benchmark.rows import Judge, Task

METHODS = ("kronc-splatfacto-cpu", "kronc-tensorf-cpu", "kronc-dvgo-cpu")
_CAPTURE = "rendered car, hemisphere, 60 + 15 views 160x160 on white, full frame"
_START = "from (4 deg, 0.5 m) noise"
_DETECTED_PX = 400  # width of the paper's images, in which a detector looks

_KINDS: tuple[tuple[PoseKind, str, Judge], ...] = (
    (EXACT, ">= 28 dB", partial(judge_exact, least_db=28.0)),
    (
        PoseKind(f"solved {_START}, exact keypoints", "solved", "solved"),
        "within 0.3 dB of exact poses",
        partial(judge_solved, limit_db=0.3),
    ),
    (
        PoseKind(f"solved {_START}, keypoints of 1 px at 400x400", "solved_1px", "solved", 1 / _DETECTED_PX),
        "within 1 dB of exact poses",
        partial(judge_solved, limit_db=1.0),
    ),
    (PoseKind(f"{_START}, not solved", "given", "given"), "", judge_nothing),
)


def nvs_tasks(trainings: Trainings) -> list[Task]:
    """All rows: each method on each kind of poses."""
    return [
        Task(f"{method}, {kind.name}", asked, _CAPTURE, 1, partial(trainings.figures, method, kind), judge)
        for method in METHODS
        for kind, asked, judge in _KINDS
    ]
