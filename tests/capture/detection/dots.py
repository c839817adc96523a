"""Pictures of coloured dots, and small ONNX networks that find them: every pixel on the way to a detection counts."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from PIL import Image

from kronc_ns.capture.detection.pixels import IMAGENET_MEAN, IMAGENET_STD

COLOURS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, 1]], dtype=np.float64)
"""One keypoint each; the background is grey."""
POINTS = len(COLOURS)


def draw(uv: np.ndarray, size: tuple[int, int], radius: float = 6.0) -> np.ndarray:
    """RGB picture of soft-edged dots at ``uv`` ([K, 2] or [cars, K, 2]; NaN: none) on grey."""
    picture = np.full((size[1], size[0], 3), 0.5)
    reach = int(radius) + 2
    for car in np.asarray(uv, dtype=np.float64).reshape(-1, POINTS, 2):
        for place, colour in zip(car, COLOURS, strict=True):
            if not np.isfinite(place).all():
                continue
            left, top = np.maximum(place.astype(int) - reach, 0)
            patch = picture[top : int(place[1]) + reach, left : int(place[0]) + reach]
            row, column = np.indices(patch.shape[:2]) + 0.5
            share = np.clip(radius + 0.5 - np.hypot(column + left - place[0], row + top - place[1]), 0, 1)[..., None]
            patch[:] = (1 - share) * patch + share * colour
    return (255 * picture).round().astype(np.uint8)


def save(path: Path, rgb: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(rgb).save(path)
    return path


class Net:
    """A graph that grows call by call: ``name = net("Relu", x)``."""

    def __init__(self) -> None:
        self.nodes: list = []
        self.constants: list = []

    def __call__(self, op: str, *inputs: str, outputs: int = 1, **attributes) -> str:
        names = [f"t{len(self.nodes)}_{i}" for i in range(outputs)]
        self.nodes.append(helper.make_node(op, list(inputs), names, **attributes))
        return names[0]

    def constant(self, values, kind=np.float32) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(values, dtype=kind), name))
        return name

    def save(self, path: Path, shape: Sequence, outputs: dict[str, Sequence], metadata: dict[str, str] | None = None):
        for name, (source, _) in zip(outputs, outputs.values(), strict=True):
            self.nodes.append(helper.make_node("Identity", [source], [name]))
        graph = helper.make_graph(
            self.nodes,
            "dots",
            [helper.make_tensor_value_info("image", TensorProto.FLOAT, shape)],
            [helper.make_tensor_value_info(name, TensorProto.FLOAT, s) for name, (_, s) in outputs.items()],
            self.constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 14)], ir_version=8)
        helper.set_model_props(model, metadata or {})
        onnx.checker.check_model(model)
        onnx.save(model, str(path))
        return path

    def masses(self, normalised: bool) -> str:
        """[1, K, h, w]: 1 on a dot of the colour, 0 on grey and on other dots."""
        sign, count = 2 * COLOURS - 1, COLOURS.sum(1)
        weight, bias = 2 * sign, 1 - 2 * count  # of pixels in [0, 1]
        if normalised:
            weight, bias = weight * IMAGENET_STD, bias + weight @ IMAGENET_MEAN
        return self("Relu", self("Conv", "image", self.constant(weight[:, :, None, None]), self.constant(bias)))

    def centroids(self, masses: str, width: int, height: int) -> tuple[str, str]:
        """x and y [1, K] of the centre of each mass, counted from the centre of the first pixel."""
        axes = self.constant([2, 3], np.int64)
        total = self("Add", self("ReduceSum", masses, axes, keepdims=0), self.constant(1e-9))
        across, down = np.arange(width)[None, None, None], np.arange(height)[None, None, :, None]
        return tuple(  # pyright: ignore[reportReturnType]
            self("Div", self("ReduceSum", self("Mul", masses, self.constant(ramp)), axes, keepdims=0), total)
            for ramp in (across, down)
        )


def composite_net(path: Path, stride: int = 8) -> Path:
    """Intensity fields [1, K, 5, h, w]: a cell that has a whole dot within its reach points to its centre."""
    net = Net()
    masses = net.masses(normalised=True)

    def over_window(reach: int, moment: int | None = None) -> str:
        ramp = np.arange(-reach, reach + 1, dtype=np.float64)
        kernel = np.ones((2 * reach + 1, 2 * reach + 1))
        kernel = kernel if moment is None else kernel * (ramp if moment == 3 else ramp[:, None])
        weights = net.constant(np.tile(kernel, (POINTS, 1, 1, 1)))
        return net("Conv", masses, weights, group=POINTS, strides=[stride] * 2, pads=[reach] * 4)

    near, far = over_window(2 * stride), over_window(3 * stride)
    cells = net("Add", net("Mul", near, net.constant(0.0)), net.constant(1.0))
    cut_off = net("Div", net("Sub", far, near), net("Add", far, net.constant(1e-6)))
    exists = net("Clip", net("Mul", near, net.constant(0.1)), net.constant(0.0), net.constant(1.0))
    whole = net("Relu", net("Sub", net.constant(1.0), net("Mul", cut_off, net.constant(100.0))))
    parts = [net("Mul", net("Mul", whole, exists), net.constant(0.9))]
    for axis in (3, 2):
        index = net("Sub", net("CumSum", cells, net.constant(axis, np.int64)), net.constant(1.0))
        mean = net("Div", over_window(2 * stride, axis), net("Add", near, net.constant(1e-6)))
        parts.append(net("Add", index, net("Div", mean, net.constant(float(stride)))))
    parts += [cells, cells]
    stacked = [net("Unsqueeze", part, net.constant([2], np.int64)) for part in parts]
    fields = net("Concat", *stacked, axis=2)
    return net.save(path, [1, 3, "height", "width"], {"fields": (fields, [1, POINTS, 5, "rows", "columns"])})


def simcc_net(path: Path, size: tuple[int, int] = (96, 128), split: int = 2) -> Path:
    """Logits [1, K, bins] for x and y: a parabola about the dot."""
    net, outputs = Net(), {}
    masses = net.masses(normalised=True)
    axes = net.constant([2, 3], np.int64)
    found = net("Clip", net("ReduceSum", masses, axes, keepdims=0), net.constant(0.0), net.constant(1.0))
    for name, centre, side in zip(("simcc_x", "simcc_y"), net.centroids(masses, *size), size, strict=True):
        bins = net.constant(np.arange(split * side)[None, None] / split)
        offset = net("Sub", bins, net("Unsqueeze", centre, net.constant([2], np.int64)))
        height = net("Mul", net("Unsqueeze", found, net.constant([2], np.int64)), net.constant(0.9))
        logits = net("Sub", height, net("Mul", net("Mul", offset, offset), net.constant(0.01)))
        outputs[name] = (logits, [1, POINTS, split * side])
    return net.save(path, [1, 3, size[1], size[0]], outputs)


def yolo_net(
    path: Path, size: tuple[int, int] = (128, 96), finished: bool = False, values: int = 3, fixed: bool = True
) -> Path:
    """Two cars, one in each half, the left one twice (less sure the second time), and one candidate that is nothing.

    Candidates [1, 5 + K * values, 4], or if ``finished`` instances [1, 2, 6 + K * values].
    """
    net = Net()
    masses = net.masses(normalised=False)
    left = np.arange(size[0])[None, None, None] < size[0] / 2
    cars = [net("Mul", masses, net.constant(half)) for half in (left, ~left)]
    axes, last = net.constant([2, 3], np.int64), net.constant([2], np.int64)
    instances = []
    for car in cars:
        x, y = (net("Add", place, net.constant(0.5)) for place in net.centroids(car, *size))
        seen = net("Clip", net("ReduceSum", car, axes, keepdims=0), net.constant(0.0), net.constant(1.0))
        rows = net("Concat", *(net("Unsqueeze", part, last) for part in (x, y, seen)[:values]), axis=2)
        flat = net("Reshape", rows, net.constant([1, POINTS * values], np.int64))
        bounds = [net(op, part, axes=[1], keepdims=1) for op in ("ReduceMin", "ReduceMax") for part in (x, y)]
        instances.append((bounds, flat))
    constant = {score: net.constant([[score]]) for score in (0.95, 0.9, 0.6, 0.01)}
    rows = []
    for number, score in ((0, 0.6), (0, 0.9), (1, 0.95), (1, 0.01)):
        (low_x, low_y, high_x, high_y), flat = instances[number]
        if finished:
            parts = [low_x, low_y, high_x, high_y, constant[score], net.constant([[0.0]]), flat]
            if score in (0.6, 0.01):
                continue
        else:
            half = net.constant(0.5)
            middle = [net("Mul", net("Add", a, b), half) for a, b in ((low_x, high_x), (low_y, high_y))]
            sides = [net("Sub", b, a) for a, b in ((low_x, high_x), (low_y, high_y))]
            parts = [*middle, *sides, constant[score], flat]
        rows.append(net("Unsqueeze", net("Concat", *parts, axis=1), net.constant([1], np.int64)))
    output = net("Concat", *rows, axis=1)
    shape = [1, len(rows), (6 if finished else 5) + POINTS * values]
    if not finished:
        output, shape = net("Transpose", output, perm=[0, 2, 1]), [1, shape[2], shape[1]]
    metadata = {"kpt_shape": f"[{POINTS}, {values}]", "imgsz": f"[{size[1]}, {size[0]}]", "task": "pose"}
    image = [1, 3, size[1], size[0]] if fixed else [1, 3, "height", "width"]
    return net.save(path, image, {"output0": (output, shape)}, metadata)
