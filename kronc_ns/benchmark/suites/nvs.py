"""The suite of view synthesis: are solved poses as good to train on as exact ones?"""

from functools import partial

from kronc_ns.benchmark.suites.rows import NONE_LOST, Limit, Row
from kronc_ns.benchmark.suites.trainings import EXACT, PoseKind, Trainings

METHODS = ("kronc-splatfacto-cpu", "kronc-tensorf-cpu", "kronc-dvgo-cpu")
_CAPTURE = "rendered car, hemisphere, 60 + 15 views 160x160 on white, full frame; losses against exact poses"
_START = "from (4 deg, 0.5 m) noise"
_DETECTED_PX = 400  # width of the paper's images, in which a detector looks

_KINDS: tuple[tuple[PoseKind, tuple[Limit, ...]], ...] = (
    (EXACT, (Limit("psnr", at_least=28.0), NONE_LOST)),
    (
        PoseKind(f"solved {_START}, exact keypoints", "solved", "solved"),
        (Limit("psnr_below_exact", at_most=0.3), NONE_LOST),
    ),
    (
        PoseKind(f"solved {_START}, keypoints of 1 px at 400x400", "solved_1px", "solved", 1 / _DETECTED_PX),
        (Limit("psnr_below_exact", at_most=1.0), NONE_LOST),
    ),
    (PoseKind(f"{_START}, not solved", "given", "given"), ()),
)
_METRICS = ("psnr_below_exact", "psnr", "ssim", "lpips")
_SHOWN = (*_METRICS, *(f"vehicle_{name}" for name in _METRICS), "rotation_deg", "centre_cm", "train_s", "test_s")


def nvs_rows(trainings: Trainings) -> list[Row]:
    """All rows: each method on each kind of poses."""
    return [
        Row(
            f"{method}, {kind.name}",
            _CAPTURE,
            1,
            partial(trainings.figures, method, kind),
            limits,
            {"mean": _SHOWN},
        )
        for method in METHODS
        for kind, limits in _KINDS
    ]
