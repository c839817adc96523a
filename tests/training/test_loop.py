import numpy as np
import pytest
import torch

from kronc_ns.errors import KroncError
from kronc_ns.training.export import export
from kronc_ns.training.loop import Training, train, weights_of
from kronc_ns.training.network import INPUT_SIZE, KeypointNetwork
from kronc_ns.training.shards import Picture, write_shard


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    folder, rng = tmp_path_factory.mktemp("pictures"), np.random.default_rng(0)
    made = []
    for _ in range(6):
        rgb = rng.integers(0, 255, (352, 480, 3), dtype=np.uint8)
        mask = np.zeros((352, 480), dtype=np.uint8)
        mask[100:250, 80:400] = 255
        points = np.column_stack([rng.uniform(80, 400, 66), rng.uniform(100, 250, 66), rng.integers(0, 3, 66)])
        made.append(Picture(rgb, mask, points, "noise"))
    write_shard(folder / "0.npz", made)
    return folder


def _run(pictures, output, steps, minutes=None):
    options = Training(pictures, output, steps=steps, batch=2, workers=0, seed=3, minutes=minutes)
    return list(train(options, compiled=False))


@pytest.fixture(scope="module")
def trained(pictures, tmp_path_factory):
    output = tmp_path_factory.mktemp("trained")
    _run(pictures, output, 4)
    return output / "checkpoint.pt"


def test_training_that_was_interrupted_ends_where_it_would_have(pictures, trained, tmp_path):
    for step in range(1, 5):  # no time: one step each
        _run(pictures, tmp_path, 4, minutes=0.0)
        assert torch.load(tmp_path / "checkpoint.pt", weights_only=True)["step"] == step
    whole, pieces = weights_of(trained), weights_of(tmp_path / "checkpoint.pt")
    for name, value in whole.items():
        torch.testing.assert_close(pieces[name], value)


def test_exported_network_answers_as_the_trained_one(trained, tmp_path):
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    export(trained, tmp_path / "car.onnx")
    assert (tmp_path / "car.onnx").stat().st_size < 12e6
    image = np.random.default_rng(1).integers(0, 255, (2, INPUT_SIZE[1], INPUT_SIZE[0], 3), dtype=np.uint8)
    heat, visible, mask = onnxruntime.InferenceSession(tmp_path / "car.onnx").run(None, {"image": image})
    network = KeypointNetwork().eval()
    network.load_state_dict(weights_of(trained))
    with torch.no_grad():
        answer = network(torch.from_numpy(image).permute(0, 3, 1, 2))
    np.testing.assert_allclose(heat, answer.heat.exp(), atol=2e-3)
    np.testing.assert_allclose(visible, answer.visible.sigmoid(), atol=5e-3)
    np.testing.assert_allclose(mask, answer.mask.sigmoid(), atol=5e-3)


def test_a_missing_checkpoint_is_named(tmp_path):
    with pytest.raises(KroncError, match=r"none\.pt does not exist"):
        weights_of(tmp_path / "none.pt")
