"""BARF and L2G-NeRF through nerfstudio's own commands: begun, gone on with, tested, and their poses exported."""

import json

import numpy as np
import pytest

pytest.importorskip("nerfstudio")

from kronc_ns.benchmark.training import train
from kronc_ns.errors import KroncError
from kronc_ns.files.transforms import read_poses
from kronc_ns.metrics.poses import evaluate_poses
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import default_camera, make_capture
from kronc_ns.synthetic.variations import noisy_poses
from tests.plugin.commands import InProcess, evaluate

pytestmark = [pytest.mark.slow, pytest.mark.nerfstudio, pytest.mark.usefixtures("without_lpips")]
UNSOLVED = ["--solver", "none"]
SHORT = ["--pipeline.datamanager.train-num-rays-per-batch", "64", "--pipeline.test-pose-steps", "2"]
SMALL = [*SHORT, "--pipeline.model.width", "16", "--pipeline.model.samples", "8", "--pipeline.model.poses-from", "2"]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A rendered car with noisy poses."""
    folder = tmp_path_factory.mktemp("barf") / "car"
    capture = make_capture("carpatch", 10, 1, camera=default_camera("carpatch", 32))
    start = noisy_poses(capture.c2w, 2.0, 0.2, np.random.default_rng(0))
    write_capture(folder, capture, start, render=True, ground=False)
    return folder


@pytest.fixture(scope="module")
def trained(scene):
    """A short run of a method."""
    made = {}

    def run(method):
        if method not in made:
            options = [*SMALL, "--max-num-iterations", "12"]
            made[method] = train(scene, method, scene.parent / "runs", options, UNSOLVED, InProcess())
        return made[method]

    return run


@pytest.mark.parametrize("method", ["barf-cpu", "l2g-nerf-cpu"])
def test_a_run_is_tested_and_its_poses_are_exported(method, trained, scene, tmp_path):
    config = trained(method)
    assert evaluate(config)["psnr"] > 3
    output = tmp_path / "transforms.json"
    InProcess().run("kronc", "export", "--run", str(config), "--format", "transforms", "--output", str(output))
    found, given = read_poses(output), read_poses(scene / "transforms.json")
    assert len(found) == 8  # of ten, two are tested
    distance = [np.linalg.norm(found[name] - given[f"images/{name.rsplit('/', 1)[1]}"]) for name in found]
    assert 1e-5 < max(distance) < 1  # in the world of the poses that were given
    printed = InProcess().run(
        "kronc", "eval", "--poses", str(output), "--reference", str(scene / "reference.json"), "--json"
    )
    assert json.loads(printed)["rotation_deg"]["mean"] < 10


def test_a_run_goes_on_from_its_checkpoint(trained, scene, tmp_path):
    config = trained("l2g-nerf-cpu")
    more = ["--load-dir", str(config.parent / "nerfstudio_models"), "--max-num-iterations", "3", *SMALL]
    resumed = train(scene, "l2g-nerf-cpu", tmp_path, more, UNSOLVED, InProcess())
    assert [path.stem for path in (resumed.parent / "nerfstudio_models").glob("*.ckpt")] == ["step-000000014"]


def test_poses_that_training_has_not_moved_are_exported_as_they_were_given(scene, tmp_path):
    options = [*SMALL, "--max-num-iterations", "2", "--pipeline.model.poses-from", "9"]
    config = train(scene, "barf-cpu", tmp_path, options, UNSOLVED, InProcess())
    InProcess().run("kronc", "export", "--run", str(config), "--format", "transforms")
    found, given = read_poses(config.parent / "refined" / "transforms.json"), read_poses(scene / "transforms.json")
    for name, pose in found.items():
        np.testing.assert_allclose(pose, given[f"images/{name.rsplit('/', 1)[1]}"], atol=1e-4)
    errors = evaluate_poses(found, given)
    assert errors.rotation_deg.max() < 0.01
    with pytest.raises(KroncError, match="status 2"):  # it is there already
        InProcess().run("kronc", "export", "--run", str(config), "--format", "transforms")


def test_the_end_says_whether_poses_have_settled(scene, tmp_path, capsys):
    options = [*SMALL, "--max-num-iterations", "20", "--optimizers.camera-opt.optimizer.lr", "0.3"]
    printed = []
    commands = InProcess()
    commands.run = lambda command, *arguments: printed.append(InProcess.run(commands, command, *arguments))
    train(scene, "barf-cpu", tmp_path, options, UNSOLVED, commands)
    assert "poses have not settled: in the last tenth of the steps cameras moved by" in " ".join(printed[0].split())


@pytest.mark.parametrize("method", ["barf-cpu", "l2g-nerf-cpu"])
def test_poses_that_go_astray_end_the_training(method, scene, tmp_path, capsys):
    options = [*SMALL, "--max-num-iterations", "500", "--optimizers.camera-opt.optimizer.lr", "1e30"]
    with pytest.raises(KroncError, match="status 2"):
        train(scene, method, tmp_path, options, UNSOLVED, InProcess())
    assert "loss is nan at step 3" in capsys.readouterr().err


def test_what_cannot_be_trained_or_exported_is_told_in_one_line(scene, tmp_path, capsys):
    few = tmp_path / "few"
    capture = make_capture("carpatch", 2, 1, camera=default_camera("carpatch", 32))
    write_capture(few, capture, capture.c2w, render=True, ground=False)
    with pytest.raises(KroncError, match="status 2"):
        train(few, "barf-cpu", tmp_path / "runs", SMALL, UNSOLVED, InProcess())
    assert "error: 1 training views: expected at least 3" in capsys.readouterr().err
    blind = tmp_path / "blind"
    unseen = make_capture("carpatch", 8, 1)
    write_capture(blind, unseen, unseen.c2w)
    with pytest.raises(KroncError, match="status 2"):
        train(blind, "barf-cpu", tmp_path / "runs", SMALL, UNSOLVED, InProcess())
    assert "does not exist: training needs the images" in capsys.readouterr().err
    options = ["--max-num-iterations", "1", *SMALL, "--pipeline.model.camera-optimizer.mode", "off"]
    config = train(scene, "barf-cpu", tmp_path / "runs", options, UNSOLVED, InProcess())
    with pytest.raises(KroncError, match="status 2"):
        InProcess().run("kronc", "export", "--run", str(config), "--format", "transforms")
    assert "poses were not refined in this run" in capsys.readouterr().err
