"""From a checkpoint to the ONNX file that the package ships: weights in half precision, arithmetic in single."""

import io
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from kronc_ns.errors import KroncError
from kronc_ns.files.output import atomic_path
from kronc_ns.training.loop import weights_of
from kronc_ns.training.network import INPUT_SIZE, KeypointNetwork

_SMALL = 256  # numbers: what is smaller stays in single precision


class _Deployed(nn.Module):
    """The network from stored pixels to probabilities."""

    def __init__(self, network: KeypointNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        answer = self.network(image.permute(0, 3, 1, 2))
        return answer.heat.exp(), answer.visible.sigmoid(), answer.mask.sigmoid()


def export(checkpoint: Path, output: Path) -> None:
    """Write the mean of the weights as ONNX: ``image`` uint8 [b, 224, 320, 3] to ``heat``, ``visible``, ``mask``."""
    try:
        import onnx
        from onnx import TensorProto, helper, numpy_helper
    except ImportError:
        raise KroncError("writing ONNX needs onnx, which is not installed: pip install 'kronc-ns[train]'") from None
    network = KeypointNetwork()
    network.load_state_dict(weights_of(checkpoint))
    deployed = _Deployed(network.eval())
    buffer = io.BytesIO()
    torch.onnx.export(
        deployed,
        (torch.zeros(1, INPUT_SIZE[1], INPUT_SIZE[0], 3, dtype=torch.uint8),),
        buffer,  # pyright: ignore[reportArgumentType]
        input_names=["image"],
        output_names=["heat", "visible", "mask"],
        dynamic_axes={name: {0: "batch"} for name in ("image", "heat", "visible", "mask")},
        opset_version=17,
        dynamo=False,
    )
    model = onnx.load_from_string(buffer.getvalue())
    kept, casts = [], []
    for weight in model.graph.initializer:
        values = numpy_helper.to_array(weight)
        if weight.data_type == TensorProto.FLOAT and values.size >= _SMALL:
            half = f"{weight.name}.half"
            kept.append(numpy_helper.from_array(values.astype(np.float16), half))
            casts.append(helper.make_node("Cast", [half], [weight.name], to=TensorProto.FLOAT))
        else:
            kept.append(weight)
    del model.graph.initializer[:]
    model.graph.initializer.extend(kept)
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    onnx.checker.check_model(model)
    with atomic_path(output) as temporary:
        temporary.write_bytes(model.SerializeToString())
