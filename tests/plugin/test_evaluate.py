"""Test views of trained runs: their metrics, which pixels are the vehicle's, and what cannot be evaluated."""

import dataclasses
import json
import math
import shutil

import numpy as np
import pytest
import yaml
from PIL import Image

from kronc_ns.benchmark.training import train, write_variant
from kronc_ns.commands.console import metrics_table
from kronc_ns.errors import KroncError
from kronc_ns.fit.options import KroncConfig
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import default_camera, make_capture
from tests.plugin.commands import InProcess

pytestmark = pytest.mark.nerfstudio
slow = pytest.mark.slow
VIEWS, SIZE = 8, 64
FEW = ["--max-num-iterations", "3"]
EVERY_OTHER = ["--eval-interval", "2"]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A rendered car with alpha and masks, on its exact poses."""
    root = tmp_path_factory.mktemp("evaluate")
    capture = make_capture("carpatch", VIEWS, seed=8, camera=default_camera("carpatch", SIZE))
    write_capture(root / "capture", capture, render=True, ground=False)
    write_variant(root / "exact", root / "capture", "exact", KroncConfig(), capture.points)
    return root / "exact"


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    """config.yml of a run that has hardly learned anything."""
    return train(data, "kronc-dvgo-cpu", tmp_path_factory.mktemp("run"), FEW, EVERY_OTHER, InProcess())


@pytest.fixture
def changed(trained, data, tmp_path):
    """The same run with other options of its dataparser, on a copy of its data whose transforms.json may be edited."""

    def make(edit=lambda transforms: None, **options):
        copy = tmp_path / "data"
        shutil.copytree(data, copy)
        content = json.loads((data / "transforms.json").read_text())
        for frame in content["frames"]:
            for key in ("file_path", "mask_path"):
                frame[key] = str((data / frame[key]).resolve())
        edit(content)
        (copy / "transforms.json").write_text(json.dumps(content))
        config = yaml.load(trained.read_text(), Loader=yaml.Loader)
        manager = config.pipeline.datamanager
        manager.data = copy
        manager.dataparser = dataclasses.replace(manager.dataparser, data=copy, **options)
        file = tmp_path / "config.yml"
        file.write_text(yaml.dump(config))
        return file

    return make


def views(config):
    from kronc_ns.plugin.trained import load_run

    return list(load_run(config).render())


def file_masks(data):
    frames = json.loads((data / "transforms.json").read_text())["frames"][::2]
    return [np.asarray(Image.open(data / frame["mask_path"])) > 0 for frame in frames]


def without_masks(transforms):
    for frame in transforms["frames"]:
        del frame["mask_path"]


@slow
def test_the_frame_is_measured_as_nerfstudio_does(trained, tmp_path):
    from kronc_ns.plugin.evaluate import evaluate_run
    from kronc_ns.plugin.trained import load_run

    result = evaluate_run(trained, tmp_path / "pictures")
    reference = load_run(trained).pipeline.get_average_eval_image_metrics()
    assert result["full"]["psnr"] == pytest.approx(reference["psnr"], abs=1e-4)
    assert result["full"]["lpips"] is None or 0 < result["full"]["lpips"] < 1
    assert (result["method"], result["step"], result["views"]) == ("kronc-dvgo-cpu", 2, VIEWS // 2)
    for part in ("full", "masked"):
        for metric in ("psnr", "ssim"):
            values = [image[part][metric] for image in result["images"]]
            assert result[part][metric] == pytest.approx(np.mean(values))
    # hardly trained, the car is what is wrong
    assert result["masked"]["psnr"] < result["full"]["psnr"]
    assert json.loads(json.dumps(result, allow_nan=False)) == result
    assert metrics_table(result).row_count == VIEWS // 2 + 1
    names = [image["file_path"].split("/")[-1] for image in result["images"]]
    assert names == [f"frame_{i + 1:05d}.png" for i in range(0, VIEWS, 2)]
    pictures = sorted((tmp_path / "pictures").iterdir())
    assert [path.name[5:] for path in pictures] == names
    assert {Image.open(path).size for path in pictures} == {(3 * SIZE, SIZE)}
    with pytest.raises(KroncError, match="pictures exists already"):
        evaluate_run(trained, tmp_path / "pictures")


@slow
@pytest.mark.parametrize("background", ["white", "mask", "keep"])
def test_the_vehicle_is_where_the_masks_say_on_any_background(changed, data, background):
    for view, expected in zip(views(changed(background=background)), file_masks(data), strict=True):
        assert view.mask.tolist() == expected.tolist()
        assert view.rendered.shape == view.truth.shape == (SIZE, SIZE, 3)
        rgba = np.asarray(Image.open(view.image)) / 255.0
        alpha = rgba[..., 3:] * (view.mask[..., None] if background == "white" else 1)
        np.testing.assert_allclose(view.truth, rgba[..., :3] * alpha + (1 - alpha), atol=1 / 254, rtol=0)


@slow
def test_without_masks_the_alpha_says_where_the_vehicle_is(changed, data):
    for view, expected in zip(views(changed(without_masks)), file_masks(data), strict=True):
        assert (view.mask != expected).mean() < 0.02  # rims that are half covered


@slow
def test_without_masks_and_alpha_there_is_no_vehicle(changed, tmp_path):
    from kronc_ns.plugin.evaluate import evaluate_run

    def opaque(transforms):
        without_masks(transforms)
        for frame in transforms["frames"]:
            image = Image.open(frame["file_path"]).convert("RGB")
            frame["file_path"] = str(tmp_path / frame["file_path"].split("/")[-1])
            image.save(frame["file_path"])

    result = evaluate_run(changed(opaque))
    assert result["masked"] is None
    assert all(image["masked"] is None for image in result["images"])
    assert math.isfinite(result["full"]["psnr"])
    assert metrics_table(result).row_count == VIEWS // 2 + 1


@slow
def test_masks_are_undistorted_where_photos_are(data, tmp_path):
    shutil.copytree(data.parent, tmp_path / "distorted")
    file = tmp_path / "distorted" / "exact" / "transforms.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "k1": -0.3}))
    config = train(file.parent, "kronc-splatfacto-cpu", tmp_path / "run", FEW, EVERY_OTHER, InProcess())
    for view, straight in zip(views(config), file_masks(data), strict=True):
        car = (view.truth < 0.97).any(-1)
        assert (car != view.mask).mean() < 0.03
        same_size = view.mask.shape == straight.shape
        assert not same_size or (view.mask != straight).mean() > 0.05, "the photo was not undistorted"


@slow
def test_what_cannot_be_evaluated_is_refused(trained, tmp_path):
    from kronc_ns.plugin.trained import load_run

    with pytest.raises(KroncError, match=r"missing\.yml does not exist"):
        load_run(tmp_path / "missing.yml")
    for content in (b"- 1", b"\xff\xfe", b"!!python/object:no.such.Type {}"):
        (tmp_path / "junk.yml").write_bytes(content)
        with pytest.raises(KroncError, match=r"junk\.yml is no config\.yml of a run"):
            load_run(tmp_path / "junk.yml")
    config = yaml.load(trained.read_text(), Loader=yaml.Loader)
    for change, message in (
        ({"timestamp": "never"}, "holds no checkpoint"),
        ({"method_name": "nerf2"}, "nerf2 is not"),
    ):
        (tmp_path / "other.yml").write_text(yaml.dump(dataclasses.replace(config, **change)))
        with pytest.raises(KroncError, match=message):
            load_run(tmp_path / "other.yml")
