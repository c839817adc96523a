"""The suite of speed: times as ratios to others' in the same run, and memory."""

from functools import partial

from kronc_ns.benchmark.suites import processes
from kronc_ns.benchmark.suites import speed_measures as measures
from kronc_ns.benchmark.suites.captures import Options
from kronc_ns.benchmark.suites.rows import NONE_LOST, Limit, Row, Statistic

_CAPTURE = "hemisphere 400x400, 66 points, 1 px, from (4 deg, 0.5 m)"
_OF_A_SOLVE: dict[Statistic, tuple[str, ...]] = {
    "median": ("milliseconds", "iterations"),
    "worst": ("milliseconds",),
    "mean": ("rotation_deg",),
}


def speed_rows(options: Options) -> list[Row]:
    """All rows; of every seed the median of repeated calls, warm and in turns with what they are compared to."""
    settings = (*measures.CERES, "iterative_schur_cauchy")
    return [
        Row(
            "solve_scene, 100 views, against pycolmap's bundle adjustment (Ceres)",
            f"{_CAPTURE}; pycolmap's adjustment alone, its model being built: ITERATIVE_SCHUR with a function "
            "tolerance of 1e-6 against solve_scene in whole, the fastest setting against our adjustment alone",
            20,
            measures.against_ceres,
            (
                Limit("solve_over_iterative_schur", "median", at_most=1.0),
                Limit("adjustment_over_fastest", "median", at_most=1.0),
                NONE_LOST,
            ),
            {
                **_OF_A_SOLVE,
                "median": (
                    *_OF_A_SOLVE["median"],
                    "adjustment_milliseconds",
                    *(f"{name}_milliseconds" for name in settings),
                ),
                "mean": ("rotation_deg", "iterative_schur_rotation_deg"),
            },
        ),
        Row(
            "against 10,000 steps of Adam",
            f"{_CAPTURE}, 100 views; Adam is our own, its gradients written out",
            max(options.adam_seeds, 1),
            measures.against_adam,
            (
                Limit("times_faster", "median", at_least=600.0),
                Limit("seeds_less_accurate", "total", at_most=0.0),
                NONE_LOST,
            ),
            {
                "mean": (
                    *("milliseconds", "adam_seconds"),
                    *("rotation_deg", "adam_rotation_deg", "centre_cm", "adam_centre_cm"),
                )
            },
        ),
        Row(
            "solve_scene without initial pose",
            f"walk 480x270, 100 views, 1 px, 10 % outliers, {options.shapes}; over {_CAPTURE}, 100 views",
            5,
            partial(measures.without_pose, shapes=options.shapes),
            (Limit("over_plain", "median", at_most=2.0), NONE_LOST),
            {**_OF_A_SOLVE, "median": (*_OF_A_SOLVE["median"], "plain_milliseconds")},
        ),
        Row(
            "many views look through the car",
            f"{_CAPTURE}, 100 views, {options.shapes}; over the same of a car that hides its far side",
            10,
            partial(measures.seen_through, shapes=options.shapes),
            (Limit("over_plain", "median", at_most=1.5), NONE_LOST),
            {**_OF_A_SOLVE, "median": (*_OF_A_SOLVE["median"], "plain_milliseconds")},
        ),
        Row(
            "growth from 100 to 1,600 views",
            f"{_CAPTURE}; peak of resident memory above the level before, each size in a process of its own; what a "
            "further view costs from 400 views on over what it costs up to there",
            3,
            measures.growth,
            (Limit("times_longer", "median", at_most=10.7), Limit("memory_slope_ratio", "median", at_most=1.25)),
            {"median": tuple(f"{what}_{n}" for what in ("milliseconds", "megabytes") for n in measures.SIZES)},
        ),
        Row(
            "solve_scenes, throughput",
            f"{_CAPTURE}, {options.scenes} scenes of 100 views on all cores, over the same on one of them; "
            "processes: one for each core, which share nothing",
            1,
            partial(measures.throughput, count=options.scenes),
            (
                Limit("over_one_core", "median", at_least=1.9),
                Limit("apart", "worst", at_most=1e-6),
                Limit("failed_scenes", "total", at_most=0.0),
            ),
            {
                "median": ("scenes_per_s", "scenes_per_s_on_one_core", "processes_over_one_core"),
                "worst": ("rotation_deg",),
            },
        ),
        *(
            Row(
                f"{command}, whole process",
                note,
                1,
                measure,
                (Limit("over_import_torch", "median", at_most=most),),
                {"median": ("milliseconds", "import_torch_milliseconds")},
            )
            for command, note, measure, most in (
                ("kronc --help", "over python -c 'import torch'", processes.help_over_torch, 0.25),
                (
                    "kronc solve",
                    f"{_CAPTURE}, 100 views in a scene folder, caches warm; over python -c 'import torch'",
                    processes.solve_over_torch,
                    0.6,
                ),
            )
        ),
        Row(
            "first call on a new machine",
            f"kronc solve, {_CAPTURE}, 100 views; user and system time of a process with an empty NUMBA_CACHE_DIR less "
            "that of the next one",
            1,
            processes.first_call,
            (Limit("processor_s_more", "median", at_most=10.0),),
            {"median": ("first_processor_s", "again_processor_s")},
        ),
    ]
