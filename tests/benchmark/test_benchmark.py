"""The measuring side: yardsticks, limits, rows and `kronc bench`."""

import json
import math
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from kronc_ns.benchmark import paper
from kronc_ns.benchmark.commands import Commands
from kronc_ns.benchmark.peers.ceres import bundle_adjustment
from kronc_ns.benchmark.subjects import capture_scene
from kronc_ns.benchmark.suites.captures import REPORT_SEEDS, Options, best_poses, load_shapes, solution_figures
from kronc_ns.benchmark.suites.nvs import METHODS, nvs_rows
from kronc_ns.benchmark.suites.overview import in_a_line, overview
from kronc_ns.benchmark.suites.poses import pose_rows
from kronc_ns.benchmark.suites.rows import NONE_LOST, Limit, Row, measure_row, measure_rows
from kronc_ns.benchmark.suites.speed import speed_rows
from kronc_ns.benchmark.suites.speed_measures import throughput
from kronc_ns.benchmark.suites.timing import in_turns, processor_seconds, timed
from kronc_ns.benchmark.suites.trainings import Trainings
from kronc_ns.commands import main as cli
from kronc_ns.errors import KroncError
from kronc_ns.fit.options import KroncConfig
from kronc_ns.fit.pipeline import solve_scene
from kronc_ns.geometry.alignment import pose_errors
from kronc_ns.synthetic.scenes import make_capture
from kronc_ns.synthetic.variations import empty_views, noisy_poses
from tests.likelihood import maximum_likelihood


def start(capture, degrees=4.0, metres=0.5):
    return noisy_poses(capture.c2w, degrees, metres, np.random.default_rng(0))


def test_maximum_likelihood_finds_the_truth_of_exact_keypoints():
    capture = make_capture("walk", views=8, seed=11)
    moved = capture.points + np.random.default_rng(0).normal(0, 0.02, capture.points.shape)
    found = maximum_likelihood(capture_scene(capture), capture.c2w, moved, robust=False)
    rotation, translation = pose_errors(found, capture.c2w)
    assert rotation.max() < 0.05
    assert translation.max() < 0.005


def test_the_two_maximum_likelihood_solutions_are_one():
    capture = make_capture("walk", views=12, seed=0, noise_px=1.0)
    scene = capture_scene(capture)
    ceres = bundle_adjustment(scene, capture.c2w, capture.points)
    scipy = maximum_likelihood(scene, capture.c2w, capture.points, robust=False)
    assert ceres.converged
    rotation, translation = pose_errors(ceres.c2w, scipy)
    assert rotation.max() < 0.01  # a hundredth of what either is off from the truth
    assert translation.max() < 0.001


def test_no_solver_beats_it_by_much():
    capture = make_capture("walk", views=12, seed=12, noise_px=1.0)
    solved = solve_scene(capture_scene(capture, start(capture)), KroncConfig(init="given"))
    errors = pose_errors(best_poses(capture), capture.c2w)[1]
    assert errors.mean() < 1.1 * pose_errors(solved.c2w, capture.c2w)[1].mean()


def test_bundle_adjustment_from_afar_ends_at_the_same_optimum():
    capture = make_capture("carpatch", views=20, seed=0, noise_px=1.0)
    scene = capture_scene(capture, start(capture))
    best = bundle_adjustment(scene, capture.c2w, capture.points)
    for solver in ("auto", "ITERATIVE_SCHUR"):
        found = bundle_adjustment(scene, start(capture), linear_solver=solver, function_tolerance=1e-6)
        assert pose_errors(found.c2w, best.c2w)[0].max() < 0.01
        assert 0 < found.seconds < 10


def test_bundle_adjustment_finds_the_focal_length():
    capture = make_capture("carpatch", views=20, seed=0)
    wrong = replace(capture.camera, fx=500.0, fy=500.0)
    found = bundle_adjustment(replace(capture_scene(capture), camera=wrong), capture.c2w, refine_focal=True)
    assert found.focal_px == pytest.approx(555.0, abs=0.01)


def test_the_oracle_leaves_outliers_and_empty_views_alone():
    capture, empty = empty_views(
        make_capture("walk", views=20, seed=1, noise_px=1.0, outliers=0.3), 0.2, np.random.default_rng(0)
    )
    best = best_poses(capture)
    assert np.array_equal(np.isnan(best).all((1, 2)), empty)
    blind = bundle_adjustment(capture_scene(capture), capture.c2w, capture.points)
    mean = [pose_errors(c2w[~empty], capture.c2w[~empty])[0].mean() for c2w in (best, blind.c2w)]
    assert mean[0] < 1.0 < mean[1]


def test_figures_of_the_truth_are_zero_and_its_ratio_is_of_common_views():
    capture = make_capture("walk", views=12, seed=3, noise_px=1.0)
    solution = solve_scene(capture_scene(capture, start(capture)), KroncConfig(init="given"))
    exact = replace(solution, c2w=capture.c2w)
    assert solution_figures(exact, capture.c2w)["rotation_deg"] < 1e-6
    partial = best_poses(capture)
    partial[:4] = math.nan
    figures = solution_figures(replace(solution, c2w=best_poses(capture)), capture.c2w, partial)
    assert figures["registered"] == 1
    assert figures["centre_ratio"] == pytest.approx(1.0)


def test_a_limit_prints_what_it_judges():
    assert str(Limit("rotation_deg", "worst", at_most=1.0)) == "rotation_deg_worst <= 1"
    assert str(Limit("psnr", at_least=28.0)) == "psnr >= 28"
    assert str(Limit("percent", "median", at_least=90.0, at_most=98.0)) == "90 <= percent_median <= 98"
    assert str(NONE_LOST) == "seeds_lost <= 0"


@pytest.mark.parametrize(
    ("limit", "reached", "holds"),
    [
        (Limit("x", "mean", at_most=2.0), 2.0, True),
        (Limit("x", "mean", at_most=1.9), 2.0, False),
        (Limit("x", "median", at_most=1.0), 1.0, True),
        (Limit("x", "worst", at_most=3.0), 4.0, False),
        (Limit("x", "worst", at_least=1.0), 1.0, True),
        (Limit("x", "total", at_least=6.0), 6.0, True),
        (Limit("x", "mean", at_least=2.5, at_most=3.0), 2.0, False),
    ],
)
def test_a_limit_judges_by_its_statistic(limit, reached, holds):
    seeds = [{"x": x} for x in (1.0, 4.0, 1.0)]
    assert limit.reached(seeds) == reached
    assert limit.holds(limit.reached(seeds)) is holds


def test_a_seed_that_failed_is_infinitely_bad_and_a_figure_that_nobody_has_is_never_good():
    failed = [{"x": 1.0}, {"failed": 1.0}]
    assert Limit("x", "mean", at_most=5.0).reached(failed) == math.inf
    assert Limit("x", "worst", at_least=0.0).reached(failed) == -math.inf
    assert Limit("x", "median", at_most=5.0).reached([*failed, {"x": 3.0}]) == 3.0
    nobody = Limit("y", at_most=5.0)
    assert not nobody.holds(nobody.reached([{"x": 1.0}]))


def test_a_failed_seed_counts_against_what_is_asked_but_not_against_the_others():
    def measure(seed: int) -> dict[str, float]:
        if seed == 1:
            raise KroncError("no luck")
        return {"rotation_deg": 0.5, "best_rotation_deg": 0.25}

    limits = (Limit("rotation_deg", at_most=1.0), NONE_LOST)
    beside = {"mean": ("rotation_deg", "best_rotation_deg", "missing")}
    row = measure_row(Row("name", "1 px", 3, measure, limits, beside, {"paper_deg": 0.6}), range(3))
    assert row.asked == "rotation_deg <= 1, seeds_lost <= 0"
    assert row.reached == {"rotation_deg": math.inf, "best_rotation_deg": 0.25, "paper_deg": 0.6, "seeds_lost": 1}
    assert row.passed is False
    assert row.failures == {1: "no luck"}
    plain = json.loads(json.dumps(row.as_dict(), allow_nan=False))
    assert plain["reached"]["rotation_deg"] is None
    assert plain["seeds"] == [0, 1, 2]
    assert in_a_line(row).startswith("missed: name (")
    assert "seed 1 failed: no luck" in overview("suite", [row]).markdown()
    assert overview("suite", [row]).on_terminal().row_count == 1


def test_a_row_that_loses_views_loses_the_seed_and_one_without_limits_is_not_judged():
    def measure(seed: int) -> dict[str, float]:
        return {"registered": 1.0 if seed else 0.9}

    row = Row("name", "", 2, measure)
    assert measure_row(row, range(2)).passed is None
    assert measure_row(replace(row, limits=(NONE_LOST,)), range(2)).passed is False
    assert measure_row(replace(row, limits=(NONE_LOST,)), range(1, 3)).passed is True


def test_those_who_take_turns_are_timed_by_their_second_calls():
    calls = []

    def run(name: str) -> float:
        calls.append(name)
        return float(len(calls))

    assert in_turns(partial(run, "a"), partial(run, "b")) == [10, 12]
    assert "".join(calls) == "aabb" * 5


def test_time_on_the_wall_is_not_that_of_processors():
    def sleep() -> None:
        with Commands() as commands:
            commands.run("python", "-S", "-c", "import time; time.sleep(0.5)")

    assert timed(sleep)() > 0.5 > processor_seconds(sleep) > 0


def test_every_row_of_the_issue_is_there():
    names = [row.name for row in pose_rows(Options())]
    assert len(set(names)) == len(names)
    assert sum("efficiency" in name for name in names) == len(paper.BY_NOISE) == 6
    assert sum("paper's table" in name for name in names) == len(paper.BY_VIEWS) == 8
    parts = ("no initial pose", "outliers", "focal", "swapped", "5 views", "<= 12 points", "20 % longer")
    for part in (*parts, "without keypoints", "95 %", "clockwise", "half", "reverse", "shuffled"):
        assert any(part in name for name in names), part
    names = [row.name for row in speed_rows(Options())]
    assert len(set(names)) == len(names)
    parts = ("solve_scene, 100 views", "without initial pose", "Adam", "Ceres", "1,600", "throughput")
    for part in (*parts, "look through", "kronc --help", "kronc solve", "new machine"):
        assert any(part in name for name in names), part


def test_many_scenes_on_all_cores_are_as_those_on_one():
    figures = throughput(0, 4)
    assert figures["processes_over_one_core"] > 0
    assert (figures["apart"], figures["failed_scenes"]) == (0, 0)
    assert figures["over_one_core"] == pytest.approx(figures["scenes_per_s"] / figures["scenes_per_s_on_one_core"])


def test_report_seeds_meet_held_out_shapes_only(tmp_path):
    cube = np.random.default_rng(0).uniform(size=(42, 66, 3))
    file = tmp_path / "shapes.json"
    file.write_text(json.dumps({"cars": [{"keypoints": shape.tolist()} for shape in cube]}))
    shapes = load_shapes(file)
    assert (len(shapes.tuning), len(shapes.report)) == (40, 2)
    assert shapes(0) is shapes.report[0]
    assert shapes(3) is shapes.report[1]
    assert shapes(REPORT_SEEDS) is shapes.tuning[REPORT_SEEDS % 40]
    assert (shapes(0) - cube[40]).std(0).max() < 1e-12, "moved as a whole"
    file.write_text(json.dumps({"cars": [{"keypoints": [[0, 0, 0]]}]}))
    with pytest.raises(KroncError, match=r"shapes\.json: expected more than 40 cars"):
        load_shapes(file)


def test_rows_come_in_their_order_however_many_are_measured_at_once():
    together = threading.Barrier(2, timeout=10)

    def measure(seed: int, name: str) -> dict[str, float]:
        together.wait()  # broken where a row waits for the other to end
        time.sleep(0.2 if name == "first" else 0.0)
        return {"value": float(seed)}

    rows = [Row(name, "", 1, partial(measure, name=name)) for name in ("first", "second")]
    measured = list(measure_rows(rows, first_seed=5, workers=2))
    assert [(row.name, row.seeds) for row in measured] == [("first", (5,)), ("second", (5,))]


def test_commands_give_what_they_print_and_the_end_of_their_errors():
    with Commands({"GREETING": "hello"}) as commands:
        assert commands.run("python", "-c", "import os; print(os.environ['GREETING'])") == "hello\n"
        with pytest.raises(KroncError, match="python ended with status 3: last words"):
            commands.run("python", "-c", "import sys; print('last words', file=sys.stderr); sys.exit(3)")


def test_commands_end_with_their_context():
    with ThreadPoolExecutor(1) as pool:
        begin = time.perf_counter()
        with Commands() as commands:
            waiting = pool.submit(commands.run, "python", "-c", "import time; time.sleep(60)")
            time.sleep(0.5)
        with pytest.raises(KroncError, match="python ended with status"):
            waiting.result()
        assert time.perf_counter() - begin < 30
        with pytest.raises(KroncError, match="was not started"):
            commands.run("python", "-c", "")


def test_every_method_is_trained_on_every_kind_of_poses(tmp_path):
    rows = nvs_rows(Trainings(tmp_path, Commands()))
    for method in METHODS:
        asked = [row.limits[0] if row.limits else None for row in rows if row.name.startswith(method)]
        losses = [Limit("psnr_below_exact", at_most=db) for db in (0.3, 1.0)]
        assert asked == [Limit("psnr", at_least=28.0), *losses, None]
    assert len({row.name for row in rows}) == len(rows) == 12


class Pretended(Commands):
    """Notes what would be run; all fields show their test views alike."""

    def __init__(self) -> None:
        super().__init__()
        self.ran: list[tuple[str, ...]] = []

    def run(self, command: str, *arguments: str) -> str:
        self.ran.append((command, *arguments))
        metrics = {"psnr": 30.0, "ssim": 0.9, "lpips": None}
        return "" if command == "ns-train" else json.dumps({"full": metrics, "masked": {**metrics, "psnr": 27.0}})


def test_rows_of_a_method_share_its_trainings_and_differ_in_their_poses(tmp_path):
    commands = Pretended()
    rows = nvs_rows(Trainings(tmp_path, commands, views=10, width=64))[:4]
    exact, solved, noisy, unsolved = (row.reached for row in measure_rows(rows, first_seed=3, workers=2))
    trained = [arguments for arguments in commands.ran if arguments[0] == "ns-train"]
    assert len(trained) == len({arguments[3] for arguments in trained}) == 4
    assert exact["rotation_deg"] < 1e-6 < solved["rotation_deg"] < 0.05 < noisy["rotation_deg"] < 1.5
    assert 3 < unsolved["rotation_deg"] < 12
    assert (exact["psnr"], exact["vehicle_psnr"], solved["psnr_below_exact"]) == (30.0, 27.0, 0.0)
    assert "psnr_below_exact" not in exact
    assert "lpips" not in exact
    assert exact["centre_cm"] < 1e-3 < noisy["centre_cm"] < 15 < unsolved["centre_cm"]


@pytest.mark.parametrize(("loss", "reached"), [(0.29, True), (0.31, False)])
def test_a_loss_is_judged_by_its_mean_over_the_seeds(tmp_path, loss, reached):
    def measure(seed: int) -> dict[str, float]:
        if seed == 2:
            raise KroncError("out of memory")
        return {"psnr": 30.0 - 10 * seed, "psnr_below_exact": loss - 0.2 + 0.4 * seed}

    _, solved, *_ = nvs_rows(Trainings(tmp_path, Commands()))
    row = replace(solved, measure=measure)
    measured = measure_row(row, range(2))
    assert measured.passed is reached
    assert measured.reached == pytest.approx({"psnr": 25.0, "psnr_below_exact": loss, "seeds_lost": 0})
    assert measure_row(row, range(3)).passed is False


@pytest.fixture
def bench(monkeypatch, capsys):
    """Run `kronc bench ARGUMENTS` in this process: (status, stdout, stderr)."""

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["kronc", "bench", *arguments])
        with pytest.raises(SystemExit) as caught:
            cli.main()
        return int(caught.value.code or 0), *capsys.readouterr()

    return run


def test_bench_prints_json(bench):
    status, out, err = bench("--rows", "paper's table, 10", "--seeds", "2", "--first-seed", "3", "--json")
    assert status == 0
    content = json.loads(out)
    assert set(content) == {"suite", "hardware", "rows"}
    assert content["suite"] == "poses"
    assert content["hardware"]["cores"] >= 1
    (row,) = content["rows"]
    assert set(row) == {"name", "asked", "reached", "passed", "seeds", "seconds", "note", "failures", "per_seed"}
    assert row["seeds"] == [3, 4]
    assert "1 px" in row["note"]
    assert row["reached"]["paper_rotation_deg"] == 0.73
    assert 0 < row["reached"]["best_rotation_deg"] < 2
    assert row["reached"]["rotation_deg"] == pytest.approx(np.mean([one["rotation_deg"] for one in row["per_seed"]]))
    assert err.count("\n") == 1


def test_bench_prints_a_table(bench, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    status, out, _ = bench("--suite", "speed", "--rows", "solve_scene, 100", "--seeds", "1")
    assert status == 0
    for part in ("milliseconds_median", "asked: solve_over_iterative_schur_median <= 1", "seed 0", "numpy", "speed: "):
        assert part in out


def test_bench_refuses_what_it_cannot_measure(bench):
    for arguments, part in (
        (("--rows", "nothing"), "clockwise lap"),
        (("--seeds", "0"), "--seeds is 0"),
        (("--shapes", "missing.json"), "missing.json"),
        (("--suite", "nvs", "--rows", "nothing"), "kronc-dvgo-cpu, exact poses"),
        (("--suite", "nvs", "--keep", "."), "--keep . exists already"),
    ):
        status, _, err = bench(*arguments)
        assert status == 2
        assert part in err
