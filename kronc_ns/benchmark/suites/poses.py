"""The suite of poses: how near the solver comes to the best that the data allow."""

from collections.abc import Callable
from functools import partial

from kronc_ns.benchmark import paper
from kronc_ns.benchmark.suites import pose_measures as measures
from kronc_ns.benchmark.suites.captures import Options, Shapes, capture_shape
from kronc_ns.benchmark.suites.rows import NONE_LOST, Limit, Row, Statistic
from kronc_ns.synthetic.scenes import Capture, Preset
from kronc_ns.synthetic.variations import reverse, shuffle

_HEMISPHERE, _WALK = "hemisphere 400x400", "walk 480x270"
_PRESETS: tuple[tuple[Preset, str], ...] = (("walk", _WALK), ("carpatch", _HEMISPHERE))
_START = "1 px, 100 views, from (4 deg, 0.5 m)"
_NO_START = "1 px, 100 views, no initial pose"
_ERRORS = ("rotation_deg", "centre_cm", "best_rotation_deg", "best_centre_cm")
"""Of the solver, and of maximum likelihood."""
_MEDIANS: dict[Statistic, tuple[str, ...]] = {"median": _ERRORS}
_SPREAD: dict[Statistic, tuple[str, ...]] = {"median": _ERRORS, "worst": ("rotation_deg",)}


def pose_rows(options: Options) -> list[Row]:
    """All rows, in the order of docs/results.md."""
    cars = options.shapes
    return [
        *(_efficiency(start, options) for start in paper.BY_NOISE),
        *(
            Row(
                f"no initial pose, {where.split()[0]}",
                f"{where}, {_NO_START}, 10 % outliers, {cars}",
                50,
                lambda seed, preset=preset: measures.without_pose(
                    capture_shape(cars(seed), preset, seed, outliers=0.1)[0]
                ),
                (
                    Limit("rotation_deg", "worst", at_most=1.0),
                    Limit("rotation_ratio", "median", at_most=1.05),
                    NONE_LOST,
                ),
                _MEDIANS,
            )
            for preset, where in _PRESETS
        ),
        Row(
            "30 % outliers",
            f"{_HEMISPHERE}, {_START}; beside the optimum of the same capture without outliers",
            20,
            measures.many_outliers,
            (
                Limit("rotation_to_clean", "worst", at_most=1.5),
                Limit("centre_to_clean", "worst", at_most=1.5),
                NONE_LOST,
            ),
            {"median": ("rotation_to_clean", *_ERRORS)},
        ),
        *(
            Row(
                f"focal length x {factor:g}",
                f"{_HEMISPHERE}, {_START}, focal length refined",
                20,
                partial(measures.wrong_focal, factor=factor),
                (Limit("focal_percent", "worst", at_most=0.5), Limit("rotation_deg", "worst", at_most=0.6), NONE_LOST),
                {"worst": ("best_focal_percent",), **_MEDIANS},
            )
            for factor in (1.25, 0.8)
        ),
        *(
            Row(
                f"10 % of views left-right swapped, {where.split()[0]}",
                f"{where}, {_START if given else _NO_START}, {cars}",
                20,
                lambda seed, preset=preset, given=given: measures.swapped_sides(
                    *capture_shape(cars(seed), preset, seed), given, seed
                ),
                (
                    Limit("missed", "total", at_most=0.0),
                    Limit("wrong", "total", at_most=0.0),
                    Limit("found", "total", at_least=1.0),
                    NONE_LOST,
                ),
                _MEDIANS,
            )
            for (preset, where), given in zip(_PRESETS, (False, True), strict=True)
        ),
        *_hard(cars),
        *(_by_views(views, errors) for views, errors in paper.BY_VIEWS.items()),
        Row(
            "20 % of views without keypoints",
            f"{_WALK}, {_NO_START}, {cars}; errors of the emptied views in the frame of the others",
            20,
            lambda seed: measures.emptied_views(*capture_shape(cars(seed), "walk", seed)),
            (
                Limit("completed_percent", "worst", at_least=100.0),
                Limit("completed_rotation_deg", "median", at_most=3.0),
                Limit("completed_centre_cm", "median", at_most=25.0),
                NONE_LOST,
            ),
            {"median": ("solved_rotation_deg",)},
        ),
        *(
            Row(
                f"95 % intervals, {where.split()[0]}",
                f"{where}, {_START}; {measures.INTERVAL} sigma, relative to the points",
                20,
                partial(measures.coverage, preset=preset),
                tuple(Limit(f"{of}_percent", at_least=90.0, at_most=98.0) for of in ("rotation", "centre")),
                {"mean": ("rotation_error_over_sigma", "centre_error_over_sigma")},
            )
            for preset, where in _PRESETS
        ),
        *_other_walks(cars),
    ]


def _efficiency(start: tuple[float, float], options: Options) -> Row:
    """How near the errors are to those of maximum likelihood, whatever the start."""
    most: tuple[tuple[Statistic, float], ...] = (("median", 1.01), ("worst", 1.05))
    return Row(
        f"efficiency from ({start[0]:g} deg, {start[1]:g} m)",
        f"{_HEMISPHERE}, 100 views, 1 px; ratio to maximum likelihood",
        20,
        lambda seed: measures.from_start(seed, start, adam=options.with_adam(seed)),
        (
            *(Limit(f"{of}_ratio", which, at_most=ratio) for which, ratio in most for of in ("rotation", "centre")),
            NONE_LOST,
        ),
        {"mean": (*_ERRORS, "adam_rotation_deg", "adam_centre_cm")},
        _printed(paper.BY_NOISE[start]),
    )


def _hard(cars: Shapes) -> list[Row]:
    """Captures with little to hold on to."""
    makes: tuple[tuple[str, str, Callable[[int], Capture]], ...] = (
        (
            "5 views of a lap",
            f"{_WALK}, 1 px, 5 views, no initial pose, {cars}",
            lambda seed: capture_shape(cars(seed), "walk", seed, views=5)[0],
        ),
        (
            "<= 12 points a view, 10 % outliers",
            f"{_WALK}, {_NO_START}, {cars}",
            lambda seed: measures.few_points(*capture_shape(cars(seed), "walk", seed, outliers=0.1)),
        ),
        (
            "shape 20 % longer than it should be",
            f"{_WALK}, {_NO_START}, {cars} stretched along x",
            lambda seed: capture_shape(cars(seed) * (1.2, 1, 1), "walk", seed)[0],
        ),
    )
    return [
        Row(
            name,
            note,
            20,
            lambda seed, make=make: measures.without_pose(make(seed)),
            (Limit("rotation_deg", "median", at_most=1.5),),
            _SPREAD,
        )
        for name, note, make in makes
    ]


def _by_views(views: int, errors: tuple[float, float]) -> Row:
    """The paper's table, whose keypoints are exact."""
    return Row(
        f"paper's table, {views} views",
        f"{_HEMISPHERE}, 1 px, from (4 deg, 0.5 m); the paper's errors, of exact keypoints, are asked",
        20,
        partial(measures.by_views, views=views, paper_cm=errors[1]),
        (Limit("rotation_deg", at_most=errors[0]), Limit("centre_cm", at_most=errors[1]), NONE_LOST),
        {"mean": ("best_rotation_deg", "best_centre_cm", "median_deg", "median_cm", "limit_is_the_papers_at_px")},
        _printed(errors),
    )


def _other_walks(cars: Shapes) -> list[Row]:
    """Laps in another sense, length or order."""
    makes: dict[str, Callable[[int], Capture]] = {
        "clockwise lap": lambda seed: capture_shape(cars(seed), "walk", seed, clockwise=True)[0],
        "half a lap": lambda seed: capture_shape(cars(seed), "walk", seed, laps=0.5)[0],
        "a lap and a half": lambda seed: capture_shape(cars(seed), "walk", seed, laps=1.5)[0],
        "images in reverse order": lambda seed: reverse(capture_shape(cars(seed), "walk", seed)[0]),
        "images in shuffled order": lambda seed: shuffle(*capture_shape(cars(seed), "walk", seed)),
    }
    return [
        Row(
            name,
            f"{_WALK}, {_NO_START}, {cars}",
            10,
            lambda seed, make=make: measures.without_pose(make(seed)),
            (Limit("rotation_deg", "worst", at_most=1.0), NONE_LOST),
            _MEDIANS,
        )
        for name, make in makes.items()
    ]


def _printed(errors: tuple[float, float]) -> dict[str, float]:
    return {"paper_rotation_deg": errors[0], "paper_centre_cm": errors[1]}
