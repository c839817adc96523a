"""The suite of trust: whether what is said of a solution is so, over captures with every kind of trouble."""

from functools import lru_cache, partial

from kronc_ns.benchmark.suites.captures import Shapes, random_car
from kronc_ns.benchmark.suites.killed import killed
from kronc_ns.benchmark.suites.pose_measures import INTERVAL
from kronc_ns.benchmark.suites.rows import Limit, Row
from kronc_ns.benchmark.suites.trials import TUNING_TRIALS, Shape, run_trial

_CARS = 40  # where no shapes are given


def trust_rows(shapes: Shapes) -> list[Row]:
    """Many trials, and many interruptions."""
    return [
        Row(
            "random captures",
            "4 to 80 views, hemispheres and walks of 0.15 to 1.5 laps, 0.5 to 4 px, up to 40 % outliers, 70 % missing "
            f"and 30 % swapped views, poor starts or none, focal lengths 10 to 30 % wrong, junk, two cars; {shapes}; "
            "wrong: mean over the solved views above 3 deg or 0.5 m; off: by 5 deg; right: mean over all poses below "
            f"1.5 deg and 15 cm; intervals of {INTERVAL} sigma",
            1000,
            partial(_trial, shapes),
            (
                Limit("converged_wrong", "total", at_most=0.0),
                Limit("views_off", at_most=0.1, percent_of="views"),
                Limit("rotations_within", at_least=90.0, at_most=98.0, percent_of="views"),
                Limit("centres_within", at_least=90.0, at_most=98.0, percent_of="views"),
                Limit("right_not_converged", at_most=8.0, percent_of="right"),
                Limit("junk_converged", "total", at_most=0.0),
                Limit("two_cars_converged", "total", at_most=0.0),
            ),
            {"total": ("scenes", "converged", "right", "views", "views_off", "junk", "two_cars")},
        ),
        Row(
            "killed at random moments",
            "`kronc solve`, `kronc-process-data`, the cache of `kronc-dataparser` in turn: kill -9, then run again",
            50,
            killed,
            (
                Limit("half_taken_for_whole", "total", at_most=0.0),
                Limit("next_run_failed", "total", at_most=0.0),
                Limit("killed", "total", at_least=30.0),
            ),
        ),
    ]


def _trial(shapes: Shapes, seed: int) -> dict[str, float]:
    known = shapes.tuning if seed >= TUNING_TRIALS else shapes.report
    return dict(run_trial(known or _random_cars(seed >= TUNING_TRIALS), seed))


@lru_cache(maxsize=2)
def _random_cars(tuning: bool) -> tuple[Shape, ...]:
    return tuple(random_car(_CARS * tuning + i) for i in range(_CARS))
