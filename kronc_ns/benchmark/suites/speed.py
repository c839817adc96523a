"""The rows of `kronc bench --suite speed`: time, memory, and the peers on the same captures in the same run."""

from functools import partial

from kronc_ns.benchmark import speed_measures as measures
from kronc_ns.benchmark.problems import Options
from kronc_ns.benchmark.rows import Task

_CAPTURE = "hemisphere 400x400, 66 points, 1 px, from (4 deg, 0.5 m)"


def speed_tasks(options: Options) -> list[Task]:
    """All rows; the median over seeds is the time."""
    return [
        Task(
            "solve_scene, 100 views",
            "<= 30 ms median (stretch: 10)",
            f"{_CAPTURE}, warm",
            20,
            measures.warm,
            measures.judge_warm,
        ),
        Task(
            "solve_scene without initial pose",
            "",
            f"walk 480x270, 100 views, 1 px, 10 % outliers, {options.shapes}, warm",
            5,
            partial(measures.without_pose, shapes=options.shapes),
            measures.judge_time,
        ),
        Task(
            "against 10,000 steps of Adam",
            ">= 500 x faster, not less accurate on any seed",
            f"{_CAPTURE}, 100 views",
            max(options.adam_seeds, 1),
            measures.against_adam,
            measures.judge_adam,
        ),
        Task(
            "against pycolmap's bundle adjustment (Ceres)",
            "not slower than the fastest of its settings",
            f"{_CAPTURE}, 100 views; either adjustment alone, models being built; solve_scene in whole beside",
            20,
            measures.against_ceres,
            measures.judge_ceres,
        ),
        Task(
            "growth from 100 to 1,600 views",
            "time <= 18 x; memory linear (a view costs at most 1.25 x as much)",
            f"{_CAPTURE}; peak of resident memory above the level before, each size in a process of its own",
            3,
            measures.growth,
            measures.judge_growth,
        ),
        Task(
            "solve_scenes, throughput",
            ">= 60 scenes/s, equal to one by one within 1e-6",
            f"{_CAPTURE}, {options.scenes} scenes of 100 views",
            1,
            partial(measures.throughput, count=options.scenes),
            measures.judge_throughput,
        ),
    ]
