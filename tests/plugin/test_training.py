"""Training, evaluation, rendering and resuming through nerfstudio's own commands, without internet or GPU.

The first two run as processes of their own, in which nobody but nerfstudio imports the plugin.
"""

import json
import math

import pytest

from kronc_ns.benchmark.commands import Commands
from kronc_ns.benchmark.training import train, write_variant
from kronc_ns.files.presets import load_config
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import default_camera, make_capture
from tests.plugin.commands import InProcess, add_half_size, evaluate

pytestmark = [pytest.mark.slow, pytest.mark.nerfstudio]
METHOD = "kronc-tensorf-cpu"
RAYS = ["--pipeline.datamanager.train-num-rays-per-batch", "256"]
HALF = ["--downscale-factor", "2"]
ONE_THREAD = Commands({"OMP_NUM_THREADS": "1"})


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The config of a short training on the solved poses of a rendered walk, and its data set."""
    root = tmp_path_factory.mktemp("training")
    capture = make_capture("walk", views=32, seed=3, noise_px=0.67, camera=default_camera("walk", 160))
    write_capture(root / "capture", capture, render=True)
    add_half_size(root / "capture")
    data = root / "solved"
    write_variant(data, root / "capture", "solved", load_config("phone_walk"), capture.points)
    return train(data, METHOD, root / "runs", ["--max-num-iterations", "500", *RAYS], HALF, ONE_THREAD), data


def test_training_on_solved_poses_shows_the_car(trained):
    config, _ = trained
    results = evaluate(config, commands=ONE_THREAD)
    print(results)
    assert results["psnr"] > 20
    assert math.isnan(results["lpips"]) or 0 < results["lpips"] < 1
    assert json.loads((config.parent / "dataparser_transforms.json").read_text())["scale"] > 0


def test_training_resumes_from_its_checkpoint(trained, tmp_path):
    config, data = trained
    more = ["--load-dir", str(config.parent / "nerfstudio_models"), "--max-num-iterations", "10"]
    resumed = train(data, METHOD, tmp_path, more, HALF, InProcess())
    checkpoints = sorted((resumed.parent / "nerfstudio_models").glob("*.ckpt"))
    assert [int(path.stem.split("-")[1]) for path in checkpoints] == [509]


def test_a_video_is_rendered_from_the_checkpoint(trained, tmp_path):
    config, _ = trained
    output = tmp_path / "orbit.mp4"
    arguments = ["--load-config", str(config), "--output-path", str(output)]
    InProcess().run("ns-render", "interpolate", *arguments, "--interpolation-steps", "2", "--downscale-factor", "4")
    assert output.stat().st_size > 1000
