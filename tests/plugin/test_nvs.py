"""View synthesis on solved poses is as good as on exact ones: the suite of `kronc bench`, small, on every method."""

import pytest

from kronc_ns.benchmark.nvs_measures import Trainings
from kronc_ns.benchmark.nvs_rows import METHODS, nvs_tasks
from kronc_ns.benchmark.rows import measure_rows
from tests.plugin.commands import InProcess

pytestmark = [pytest.mark.slow, pytest.mark.nerfstudio]

RAYS = ["--pipeline.datamanager.train-num-rays-per-batch", "400"]
SHORT = {
    "kronc-splatfacto-cpu": ["--max-num-iterations", "300", "--pipeline.model.num-downscales", "0"],
    "kronc-tensorf-cpu": ["--max-num-iterations", "300", *RAYS],
    "kronc-dvgo-cpu": ["--max-num-iterations", "400", *RAYS],
}
KINDS = ("exact poses", "1 px at 400x400")  # unsolved poses: test_training, test_fields


@pytest.mark.parametrize("method", METHODS)
def test_solved_poses_train_like_exact_ones(method, tmp_path):
    tasks = nvs_tasks(Trainings(tmp_path, InProcess(), views=50, width=64, options=SHORT[method]))
    chosen = [task for task in tasks if method in task.name and task.name.endswith(KINDS)]
    rows = list(measure_rows(chosen, first_seed=7))
    assert not any(row.failures for row in rows), [row.failures for row in rows]
    exact, solved = (row.reached for row in rows)
    print(f"{method}: {exact}, {solved}")
    assert 0 < solved["rotation_deg"] < 0.5
    assert solved["psnr_below_exact"] == pytest.approx(exact["psnr"] - solved["psnr"])
    assert solved["psnr_below_exact"] < 1.5
    pictures = sorted((tmp_path / "seed_7" / "pictures" / method / "exact").iterdir())
    assert len(pictures) == 10
