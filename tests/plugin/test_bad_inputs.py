"""Whatever comes through `kronc-dataparser` trains or ends with one line that says why, never with NaN."""

import copy
import functools
import json
import math
import random
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

pytest.importorskip("nerfstudio")

from kronc_ns.benchmark.training import write_variant
from kronc_ns.files.presets import KroncConfig
from kronc_ns.plugin import methods
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import default_camera, make_capture
from tests.plugin.commands import forget_writers

pytestmark = [pytest.mark.nerfstudio, pytest.mark.usefixtures("without_lpips")]
METHODS = ["kronc_splatfacto_cpu", "kronc_tensorf_cpu", "kronc_dvgo_cpu"]
CAMERA = default_camera("carpatch", 48)
SMALL = {
    "kronc_splatfacto_cpu": {"warmup_length": 10, "refine_every": 10, "num_downscales": 0},
    "kronc_tensorf_cpu": {"upsampling_iters": (10, 20), "init_resolution": 16, "final_resolution": 24},
    "kronc_dvgo_cpu": {"coarse_iterations": 60, "coarse_voxels": 16**3, "fine_voxels": 24**3, "growth_steps": (10,)},
}
RAYS = 512
OF_VIEWS = ["views", "initial_c2w"]
STEPS = {"kronc_splatfacto_cpu": 25, "kronc_tensorf_cpu": 25, "kronc_dvgo_cpu": 72}
"""All that changes on the way has happened by then: images are densified, grids have grown."""
LONGER = {"kronc_splatfacto_cpu": 60, "kronc_tensorf_cpu": 100, "kronc_dvgo_cpu": 80}
"""What has been learned shows."""


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> Callable[..., Path]:
    """Folder of eight rendered views with exact poses by a camera; each made once."""
    root, made = tmp_path_factory.mktemp("rendered"), {}

    def get(camera=CAMERA) -> Path:
        if camera not in made:
            capture = make_capture("carpatch", 8, seed=5, camera=camera)
            data, folder = root / f"capture_{len(made)}", root / f"exact_{len(made)}"
            write_capture(data, capture, render=True)
            write_variant(folder, data, "exact", KroncConfig(), capture.car.keypoints)
            made[camera] = folder
        return made[camera]

    return get


@pytest.fixture(scope="module")
def plain_psnr(rendered, tmp_path_factory) -> Callable[[str], float]:
    """Test views of a pinhole camera with square pixels, trained once a method."""
    return functools.cache(lambda method: train_longer(method, rendered(), tmp_path_factory.mktemp("plain"))["psnr"])


@pytest.fixture
def painted(rendered, tmp_path) -> Callable[[str, int], Path]:
    """The same data set with all images or masks of one grey value."""

    def paint(kind: str, value: int) -> Path:
        source = rendered()
        capture = source.with_name(source.name.replace("exact", "capture"))
        for folder in (capture, source):
            shutil.copytree(folder, tmp_path / folder.name)
        for path in (tmp_path / capture.name / kind).iterdir():
            Image.fromarray(np.full_like(np.asarray(Image.open(path)), value)).save(path)
        return tmp_path / source.name

    return paint


def train(method: str, data: Path, out: Path, parser=None, model=None, steps=None, rates=None) -> dict[str, float]:
    """Metrics of the test views after a short training; every parameter must be finite."""
    forget_writers()
    random.seed(0)  # which images nerfstudio draws its rays from
    torch.manual_seed(0)
    config = copy.deepcopy(getattr(methods, method).config)
    manager = config.pipeline.datamanager
    config.data = manager.data = manager.dataparser.data = data
    for name, value in ({"eval_interval": 4} | (parser or {})).items():
        setattr(manager.dataparser, name, value)
    if hasattr(manager, "train_num_rays_per_batch"):
        manager.train_num_rays_per_batch = RAYS
    for name, value in (model or {}).items():
        assert hasattr(config.pipeline.model, name)
        setattr(config.pipeline.model, name, value)
    for group in rates or {}:
        config.optimizers[group]["optimizer"].lr = rates[group]
    config.max_num_iterations = steps or STEPS[method]
    config.output_dir, config.experiment_name, config.timestamp = out, "bad", "run"
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.train()
    assert all(bool(p.isfinite().all()) for p in trainer.pipeline.parameters())
    return trainer.pipeline.get_average_eval_image_metrics(step=config.max_num_iterations)


def train_longer(method: str, data: Path, out: Path) -> dict[str, float]:
    return train(method, data, out, model=SMALL[method], steps=LONGER[method])


def first_views(folder: Path, count: int) -> None:
    """Keep only the first views of a data set."""
    for name, keys in (("transforms.json", ["frames"]), ("keypoints.json", ["frames"]), ("kronc.json", OF_VIEWS)):
        content = json.loads((folder / name).read_text())
        content |= {key: content[key][:count] for key in keys}
        (folder / name).write_text(json.dumps(content))


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "camera",
    [replace(CAMERA, fy=0.6 * CAMERA.fy), replace(CAMERA, k1=-0.35, k2=0.12), replace(CAMERA, k1=0.6, k2=0.3)],
    ids=["pixels that are not square", "barrel", "pincushion"],
)
def test_any_camera_trains_as_a_plain_one(method, camera, rendered, plain_psnr, tmp_path):
    other = train_longer(method, rendered(camera), tmp_path)
    assert other["psnr"] > plain_psnr(method) - 1.5


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("parser", [{"scene_scale": 0.02}, {"num_seed_points": 0}, {"seeds": "box"}], ids=str)
def test_a_box_within_the_car_and_few_seeds_train_or_say_why(method, parser, rendered, tmp_path, capsys):
    ends_or_trains(method, rendered(), tmp_path, capsys, parser)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("background", ["white", "keep", "mask"])
def test_black_images_train_or_say_why(method, background, painted, tmp_path, capsys):
    ends_or_trains(method, painted("images", 0), tmp_path, capsys, {"background": background})


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_one_training_view_trains_or_says_why(method, rendered, tmp_path, capsys):
    data = shutil.copytree(rendered().parent, tmp_path / "all") / rendered().name
    first_views(data, 2)
    ends_or_trains(method, data, tmp_path, capsys, {"eval_interval": 2})


def ends_or_trains(method: str, data: Path, out: Path, capsys, parser) -> None:
    """Finite metrics, or status 2 with one line on stderr."""
    status, metrics = 0, {"psnr": 0.0}
    try:
        metrics = train(method, data, out, parser, SMALL[method])
    except SystemExit as ended:
        status = ended.code
    reasons = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    print(metrics, reasons)
    assert (status, len(reasons)) in [(0, 0), (2, 1)]
    assert math.isfinite(metrics["psnr"])


@pytest.mark.parametrize("background", ["white", "mask"])
def test_empty_masks_are_named_before_training(background, painted, tmp_path, capsys):
    data = painted("masks", 0)
    with pytest.raises(SystemExit) as ended:
        train("kronc_tensorf_cpu", data, tmp_path, {"background": background})
    assert ended.value.code == 2
    assert "masks are empty" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_empty_masks_do_not_matter_to_the_full_frame(method, painted, tmp_path, capsys):
    ends_or_trains(method, painted("masks", 0), tmp_path, capsys, {"background": "keep"})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "group"),
    [
        ("kronc_splatfacto_cpu", "means"),
        ("kronc_splatfacto_cpu", "camera_opt"),
        ("kronc_tensorf_cpu", "fields"),
        ("kronc_tensorf_cpu", "camera_opt"),
        ("kronc_dvgo_cpu", "coarse"),
        ("kronc_dvgo_cpu", "camera_opt"),
    ],
)
def test_an_infinite_rate_ends_training_early(method, group, rendered, tmp_path, capsys):
    config = getattr(methods, method).config
    camera_optimizer = replace(config.pipeline.model.camera_optimizer, mode="SO3xR3")
    model = SMALL[method] | {"camera_optimizer": camera_optimizer}
    with pytest.raises(SystemExit) as ended:
        train(method, rendered(), tmp_path, model=model, steps=10_000, rates={group: math.inf})
    assert ended.value.code == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "training cannot recover" in error
    assert int(error.split("at step ")[1].split(",")[0]) < 100


@pytest.mark.parametrize(
    "wrong",
    [{"coarse_voxels": 0}, {"fine_voxels": -1}, {"step_size": math.nan}, {"fine_alpha_init": 1.0}, {"mlp_width": 0}],
    ids=str,
)
def test_options_of_dvgo_that_cannot_be_are_named(wrong, rendered, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        train("kronc_dvgo_cpu", rendered(), tmp_path, model=wrong)
    assert ended.value.code == 2
    (name,) = wrong
    assert f"error: {name} is " in capsys.readouterr().err
