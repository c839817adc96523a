"""Training, evaluation, rendering and resuming through nerfstudio's own commands, without internet or GPU."""

import json
import math

import pytest

from kronc_ns.benchmark.training import train, write_poses, write_variant
from kronc_ns.config import load_config
from kronc_ns.geometry.alignment import umeyama
from kronc_ns.init import circular_poses
from kronc_ns.scene import load_scene
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import default_camera, make_capture
from tests.plugin.commands import add_half_size, evaluate, run

pytestmark = [pytest.mark.slow, pytest.mark.nerfstudio]
ITERATIONS = ["--max-num-iterations", "500"]
HALF = ["--downscale-factor", "2"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Configs of the same short training on three kinds of poses of one rendered walk."""
    root = tmp_path_factory.mktemp("training")
    capture = make_capture("walk", views=32, seed=3, noise_px=0.67, camera=default_camera("walk", 320))
    write_capture(root / "capture", capture, render=True)
    add_half_size(root / "capture")
    config = load_config("phone_walk")
    for which in ("exact", "solved"):
        write_variant(root / which, root / "capture", which, config, capture.points)
    circle = circular_poses(len(capture.c2w), config.radius_m, config.direction, config.laps)
    nearest = umeyama(circle[..., 3], capture.c2w[..., 3]).apply_to_poses(circle)
    write_poses(root / "circle", root / "capture", load_scene(root / "capture"), nearest, capture.points)
    configs = {}
    for which in ("exact", "solved", "circle"):
        configs[which] = train(root / which, "kronc-tensorf-cpu", root / "runs", ITERATIONS, HALF)
    return configs


def test_solved_poses_train_like_exact_ones_and_the_circle_does_not(runs):
    results = {which: evaluate(config) for which, config in runs.items()}
    psnr = {which: result["psnr"] for which, result in results.items()}
    print(psnr)
    assert psnr["solved"] > psnr["exact"] - 1.5, psnr
    assert psnr["solved"] > psnr["circle"] + 3.0, psnr
    assert all(math.isnan(r["lpips"]) or 0 < r["lpips"] < 1 for r in results.values())


def test_training_resumes_from_its_checkpoint(runs):
    config = runs["solved"]
    root = config.parents[3]
    more = ["--load-dir", str(config.parent / "nerfstudio_models"), "--max-num-iterations", "10"]
    resumed = train(root.parent / "solved", "kronc-tensorf-cpu", root / "resumed", more, HALF)
    checkpoints = sorted((resumed.parent / "nerfstudio_models").glob("*.ckpt"))
    assert [int(path.stem.split("-")[1]) for path in checkpoints] == [509]


def test_a_video_is_rendered_from_the_checkpoint(runs, tmp_path):
    output = tmp_path / "orbit.mp4"
    arguments = ["--load-config", str(runs["solved"]), "--output-path", str(output)]
    run("ns-render", "interpolate", *arguments, "--interpolation-steps", "2", "--downscale-factor", "4")
    assert output.stat().st_size > 1000


def test_poses_and_cache_survive_in_the_run(runs):
    transform = json.loads((runs["solved"].parent / "dataparser_transforms.json").read_text())
    assert transform["scale"] > 0
