"""Depths under the keypoints: sampled from estimated maps, by DINOv2 with a DPT head as transformers builds it."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from kronc_ns.capture import depth as depth_module
from kronc_ns.capture.depth import DinoDepth, depth_estimator, estimate_depths, with_depths
from kronc_ns.commands.main import Solve
from kronc_ns.errors import KroncError
from kronc_ns.files.images import read_depth
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.fit.options import KroncConfig
from kronc_ns.scene import Scene
from kronc_ns.solve.adam import AdamConfig
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import default_camera, make_capture

PRIOR = KroncConfig(solver="adam", depth_init="prior", adam=AdamConfig(steps=20))


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KRONC_NS_CACHE", str(tmp_path / "cache"))
    depth_module._dino.cache_clear()


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three rendered views with their exact depth maps."""
    folder = tmp_path_factory.mktemp("rendered") / "walk"
    write_capture(folder, make_capture("walk", 3, seed=2, camera=default_camera("walk", 160)), render=True)
    return folder


def without_maps(scene: Scene) -> Scene:
    return replace(scene, given_depths=None)


class Mean:
    """Takes 255 minus the brightness of an image for its depth, at a quarter of its size."""

    identity = "mean"

    def __init__(self) -> None:
        self.calls = 0

    def estimate(self, rgb: np.ndarray) -> np.ndarray:
        self.calls += 1
        return 255 - rgb[::4, ::4].astype(np.float32).mean(-1)


class Exact:
    """Knows the depth maps, up to a factor."""

    identity = "exact"

    def __init__(self, folder: Path, scale: float) -> None:
        content = json.loads((folder / "transforms.json").read_text())
        self._maps = [scale * read_depth(folder / frame["depth_file_path"]) for frame in content["frames"]]

    def estimate(self, rgb: np.ndarray) -> np.ndarray:
        return self._maps.pop(0)


def test_estimated_maps_are_sampled_as_depth_maps_are(rendered: Path):
    scene = load_scene(rendered)
    assert scene.given_depths is not None
    found = estimate_depths(Exact(rendered, 0.25), without_maps(scene), rendered)
    np.testing.assert_allclose(found.given_depths, 0.25 * scene.given_depths, rtol=1e-5, atol=1e-5)
    assert np.isfinite(scene.given_depths).sum() > 20


def test_maps_are_kept_by_content_and_cover_the_image(rendered: Path):
    scene, estimator = without_maps(load_scene(rendered)), Mean()
    steps: list[tuple[int, int]] = []
    found = estimate_depths(estimator, scene, rendered, lambda step, steps_, _: steps.append((step, steps_)))
    again = estimate_depths(estimator, scene, rendered)
    assert estimator.calls == 3
    assert steps == [(1, 3), (2, 3), (3, 3)]
    assert found.given_depths is not None
    np.testing.assert_array_equal(found.given_depths, again.given_depths)
    view, point = np.argwhere(scene.seen)[5]
    rgb = np.array(Image.open(rendered / scene.names[view]).convert("RGB"))
    column, line = (scene.keypoints[view, point, :2] / 4).astype(int)
    assert float(found.given_depths[view, point]) == pytest.approx(255 - rgb[4 * line, 4 * column].mean(), abs=1e-3)
    assert np.isnan(found.given_depths[~scene.seen]).all()


def test_depth_maps_of_the_scene_come_first(rendered: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    scene = load_scene(rendered)
    assert with_depths(scene, rendered, PRIOR, None) is scene
    with pytest.raises(KroncError, match=r"pip install 'kronc-ns\[depth\]'"):
        with_depths(without_maps(scene), rendered, PRIOR, None)
    random = replace(PRIOR, depth_init="random")
    assert with_depths(without_maps(scene), rendered, random, None).given_depths is None
    with pytest.raises(KroncError, match="--depth-weights x without a prior"):
        depth_estimator(random, Path("x"))


def test_what_cannot_be_estimated_is_named(rendered: Path):
    class Nothing(Mean):
        identity = "nothing"

        def estimate(self, rgb: np.ndarray) -> np.ndarray:
            return np.zeros((8, 8), dtype=np.float32)

    scene = without_maps(load_scene(rendered))
    with pytest.raises(KroncError, match="no depth was estimated under any keypoint"):
        estimate_depths(Nothing(), scene, rendered)
    with pytest.raises(KroncError, match=r"frame_00001\.png does not exist: --depth-init prior estimates"):
        estimate_depths(Mean(), scene, rendered / "nowhere")
    with pytest.raises(KroncError, match='needs solver "adam"'):
        KroncConfig(depth_init="prior-fixed")


@pytest.fixture(scope="module")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """DINOv2 and DPT as facebook/dpt-dinov2-* are built, with few weights and none trained."""
    from transformers import DPTConfig, DPTForDepthEstimation, DPTImageProcessor
    from transformers.models.dinov2 import Dinov2Config

    torch.manual_seed(0)
    stages = ["stage1", "stage2", "stage3", "stage4"]
    backbone = Dinov2Config(
        hidden_size=24, num_hidden_layers=4, num_attention_heads=2, image_size=70, patch_size=14,
        out_features=stages, reshape_hidden_states=False, apply_layernorm=False,
    )  # fmt: skip
    config = DPTConfig(
        backbone_config=backbone, neck_hidden_sizes=[8, 8, 16, 16], fusion_hidden_size=256, is_hybrid=False,
        head_in_index=-1, add_projection=True, readout_type="project", reassemble_factors=[4, 2, 1, 0.5],
        backbone_out_indices=None, use_bias_in_fusion_residual=False,
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("model")
    model = DPTForDepthEstimation(config)
    torch.nn.init.ones_(model.head.head[-2].bias)  # a ReLU follows: untrained depths shall not all be 0
    model.save_pretrained(folder)
    processor = DPTImageProcessor(
        do_resize=False, do_pad=True, size_divisor=14, image_mean=[0.5] * 3, image_std=[0.2] * 3
    )
    processor.save_pretrained(folder)
    return folder


@pytest.mark.slow
def test_the_real_network_with_few_untrained_weights(untrained: Path, rendered: Path):
    pytest.importorskip("transformers")
    rgb = np.random.default_rng(0).integers(0, 255, (90, 160, 3), dtype=np.uint8)
    estimator = DinoDepth(untrained)
    found = estimator.estimate(rgb)
    assert found.shape[1] / found.shape[0] == pytest.approx(160 / 90, rel=0.03)
    assert (found > 0).any()
    scene = with_depths(without_maps(load_scene(rendered)), rendered, PRIOR, untrained)
    assert scene.given_depths is not None
    assert np.isfinite(scene.given_depths).sum() > 0
    with pytest.raises(KroncError, match=r"nowhere cannot be loaded .*--depth-weights a folder with what `hf download"):
        DinoDepth(Path("nowhere"))


@pytest.mark.slow
def test_the_command_estimates_what_it_starts_from(untrained: Path, rendered: Path, tmp_path: Path):
    pytest.importorskip("transformers")
    content = json.loads((rendered / "transforms.json").read_text())
    for frame in content["frames"]:
        del frame["depth_file_path"]
    scene = tmp_path / "scene"
    scene.mkdir()
    (scene / "images").symlink_to(rendered / "images")
    (scene / "transforms.json").write_text(json.dumps(content))
    (scene / "keypoints.json").write_text((rendered / "keypoints.json").read_text())
    command = Solve(
        data=(scene,), output_dir=tmp_path / "out", solver="adam", depth_init="prior-fixed", depth_weights=untrained
    )
    assert command.run() in (0, 3)  # untrained depths are wrong
    assert (tmp_path / "out" / "kronc.json").exists()
