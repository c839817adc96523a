"""The rows of `kronc bench --suite poses`: how near the solver comes to the best that the data allow."""

from collections.abc import Callable
from functools import partial

import torch

from kronc_ns.benchmark import paper
from kronc_ns.benchmark import pose_measures as measures
from kronc_ns.benchmark.problems import Options, capture_shape
from kronc_ns.benchmark.rows import Task
from kronc_ns.synthetic.scenes import Capture, Preset
from kronc_ns.synthetic.variations import reverse, shuffle


def pose_tasks(options: Options) -> list[Task]:
    """All rows, in the order of docs/results.md."""
    cars, lap = options.shapes, "1 px, 100 views, no initial pose"
    tasks = [
        Task(
            f"efficiency from ({start[0]:g} deg, {start[1]:g} m)",
            "ratio to maximum likelihood: median <= 1.01, worst <= 1.05, no seed lost",
            "hemisphere 400x400, 100 views, 1 px",
            20,
            lambda seed, start=start: measures.from_start(seed, start, adam=options.with_adam(seed)),
            partial(measures.judge_efficiency, paper=paper.BY_NOISE[start]),
        )
        for start in paper.BY_NOISE
    ]
    presets: tuple[tuple[Preset, str], ...] = (("walk", "walk 480x270"), ("carpatch", "hemisphere 400x400"))
    for preset, words in presets:
        tasks.append(
            Task(
                f"no initial pose, {words.split()[0]}",
                "every seed < 1 deg mean; median ratio <= 1.05 to maximum likelihood on the inliers",
                f"{words}, {lap}, 10 % outliers, {cars}",
                50,
                lambda seed, preset=preset: measures.without_pose(
                    capture_shape(cars(seed), preset, seed, outliers=0.1)[0]
                ),
                measures.judge_without_pose,
            )
        )
    tasks += [
        Task(
            "30 % outliers",
            "every seed <= 1.5 x the optimum of the same capture without outliers, every view with a pose",
            "hemisphere 400x400, 100 views, 1 px, from (4 deg, 0.5 m)",
            20,
            measures.many_outliers,
            measures.judge_outliers,
        ),
        *(
            Task(
                f"focal length x {factor:g}",
                "focal within 0.5 %, < 0.6 deg mean, every seed",
                "hemisphere 400x400, 100 views, 1 px, from (4 deg, 0.5 m), focal length refined",
                20,
                partial(measures.wrong_focal, factor=factor),
                measures.judge_focal,
            )
            for factor in (1.25, 0.8)
        ),
        Task(
            "10 % of views left-right swapped, walk",
            "all found, none wrongly",
            f"walk 480x270, {lap}, {cars}",
            20,
            lambda seed: measures.swapped_sides(*capture_shape(cars(seed), "walk", seed), False, seed),
            measures.judge_swapped,
        ),
        Task(
            "10 % of views left-right swapped, hemisphere",
            "all found, none wrongly",
            f"hemisphere 400x400, 1 px, 100 views, from (4 deg, 0.5 m), {cars}",
            20,
            lambda seed: measures.swapped_sides(*capture_shape(cars(seed), "carpatch", seed), True, seed),
            measures.judge_swapped,
        ),
        _hard(
            "5 views of a lap",
            f"walk 480x270, 1 px, 5 views, no initial pose, {cars}",
            lambda s: capture_shape(cars(s), "walk", s, views=5)[0],
        ),
        _hard(
            "<= 12 points a view, 10 % outliers",
            f"walk 480x270, {lap}, {cars}",
            lambda s: measures.few_points(*capture_shape(cars(s), "walk", s, outliers=0.1)),
        ),
        _hard(
            "shape 20 % longer than it should be",
            f"walk 480x270, {lap}, {cars} stretched along x",
            lambda s: capture_shape(cars(s) * torch.tensor([1.2, 1, 1]), "walk", s)[0],
        ),
    ]
    tasks += [
        Task(
            f"paper's table, {views} views",
            f"< {errors[0]} deg, < {errors[1]} cm: the paper's",
            "hemisphere 400x400, 1 px, from (4 deg, 0.5 m); means over seeds",
            20,
            partial(measures.from_start, start=measures.USUAL_START, views=views),
            partial(measures.judge_views, paper=errors),
        )
        for views, errors in paper.BY_VIEWS.items()
    ]
    tasks += [
        Task(
            "20 % of views without keypoints",
            "all completed, median <= 3 deg, <= 25 cm",
            f"walk 480x270, {lap}, {cars}; errors of the emptied views in the frame of the others",
            20,
            lambda seed: measures.emptied_views(*capture_shape(cars(seed), "walk", seed)),
            measures.judge_emptied,
        ),
        *(
            Task(
                f"95 % intervals, {words.split()[0]}",
                "cover 90 to 98 %",
                f"{words}, 100 views, 1 px, from (4 deg, 0.5 m); {measures.INTERVAL} sigma, relative to the points",
                20,
                partial(measures.coverage, preset=preset),
                measures.judge_coverage,
            )
            for preset, words in presets
        ),
    ]
    walks: dict[str, Callable[[int], Capture]] = {
        "clockwise lap": lambda s: capture_shape(cars(s), "walk", s, clockwise=True)[0],
        "half a lap": lambda s: capture_shape(cars(s), "walk", s, laps=0.5)[0],
        "a lap and a half": lambda s: capture_shape(cars(s), "walk", s, laps=1.5)[0],
        "images in reverse order": lambda s: reverse(capture_shape(cars(s), "walk", s)[0]),
        "images in shuffled order": lambda s: shuffle(*capture_shape(cars(s), "walk", s)),
    }
    tasks += [
        Task(
            name,
            "every seed < 1 deg mean",
            f"walk 480x270, {lap}, {cars}",
            10,
            lambda seed, make=make: measures.without_pose(make(seed)),
            measures.judge_every_seed,
        )
        for name, make in walks.items()
    ]
    return tasks


def _hard(name: str, note: str, make: Callable[[int], Capture]) -> Task:
    return Task(
        name,
        "<= 1.5 deg median over seeds",
        note,
        20,
        lambda seed: measures.without_pose(make(seed)),
        measures.judge_hard,
    )
