"""A network as the builtin detector takes it, which knows a flat car by its colours: every pixel on the way counts.

The car is a grey patch with a dot of its own colour for each of some points. As the real network does, this one takes
the side from the whole picture: it exchanges left and right where the car points the other way, and knows no car that
does not stand upright.
"""

import json
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper

from kronc_ns.capture.detection.builtin.weights import INPUT_SIZE, STRIDE
from kronc_ns.capture.detection.model import file_sha256
from kronc_ns.keypoints.schema import APOLLOCAR3D_66
from tests.capture.detection.dots import Net

BACKGROUND, BODY, RADIUS = 114.0, 160.0, 95.0  # grey values, and length of the dots' colours from the body's
POINTS = (0, 2, 7, 9, 13, 20, 25, 38, 41, 50, 55, 58, 61)
"""Those the car has."""
FRONT, REAR, TOP, BOTTOM = 7, 20, 9, 58
"""Dots that say which way it stands: the front is left of the rear, the top above the bottom."""
PLACES = np.array([
    [0.08, 0.45], [0.10, 0.55], [0.15, 0.80], [0.35, 0.15], [0.45, 0.45], [0.80, 0.80], [0.92, 0.50],
    [0.65, 0.60], [0.70, 0.15], [0.30, 0.62], [0.20, 0.30], [0.50, 0.88], [0.60, 0.35],
])  # fmt: skip
"""Of the points, as shares of the body's width and height."""
CARD = {
    "version": 1,
    "calibration": [[0.0, 0.0], [0.5, 0.6], [1.0, 1.0]],
    "sigma_factor": 1.0,
    "point_confidence": 0.2,
    "car_points": 6,
    "car_confidence": 0.4,
    "car_area": 0.05,
}


def colours() -> np.ndarray:
    """[66, 3] directions from the body's grey, at least 20 degrees apart, none towards the background."""
    count = 84
    z = 1 - 2 * (np.arange(count) + 0.5) / count
    angle = np.arange(count) * np.pi * (3 - np.sqrt(5))
    sphere = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=-1)
    order = np.random.default_rng(0).permutation(np.argsort(-sphere.sum(1))[:66])
    return sphere[order]


def car(box: tuple[float, float, float, float]) -> np.ndarray:
    """[13, 2] where the dots of a car are whose body is this box (left, top, right, bottom)."""
    corner, end = np.array(box).reshape(2, 2)
    return corner + PLACES * (end - corner)


def draw_cars(size: tuple[int, int], *boxes: tuple[float, float, float, float], radius: float = 0.02) -> np.ndarray:
    """RGB picture of cars; ``radius`` of the dots is a share of the body's width."""
    picture = np.full((size[1], size[0], 3), BACKGROUND)
    for left, top, right, bottom in boxes:
        body = np.array([left, top, right, bottom]).clip(0).round().astype(int)
        picture[body[1] : body[3], body[0] : body[2]] = BODY
        for j, (u, v) in zip(POINTS, car((left, top, right, bottom)), strict=True):
            reach = radius * (right - left)
            first = (max(0, int(v - reach) - 1), max(0, int(u - reach) - 1))
            patch = picture[first[0] : int(v + reach) + 2, first[1] : int(u + reach) + 2]
            row, column = np.indices(patch.shape[:2]) + 0.5
            share = np.clip(reach + 0.5 - np.hypot(column + first[1] - u, row + first[0] - v), 0, 1)[..., None]
            patch[:] = (1 - share) * patch + share * (BODY + RADIUS * colours()[j])
    return picture.round().clip(0, 255).astype(np.uint8)


def builtin_net(folder: Path, **card) -> Path:
    """The network's file in ``folder``, with its card beside it."""
    net, schema = Net(), APOLLOCAR3D_66
    width, height = INPUT_SIZE
    planes = net("Transpose", net("Cast", "image", to=TensorProto.FLOAT), perm=[0, 3, 1, 2])
    weight = colours() / RADIUS
    purity = net("Conv", planes, net.constant(weight[:, :, None, None]), net.constant(-BODY * weight.sum(1)))
    dots = net(
        "Clip",
        net("Mul", net("Sub", purity, net.constant(0.96)), net.constant(25.0)),
        net.constant(0.0),
        net.constant(1.0),
    )
    ramp = 1 - np.abs(np.arange(2 * STRIDE) + 0.5 - STRIDE) / STRIDE  # bilinear: keeps centroids

    def over_cells(pixels: str, count: int, kernel: np.ndarray) -> str:
        weights = net.constant(np.tile(kernel, (count, 1, 1, 1)))
        pads = [(len(kernel) - STRIDE) // 2] * 4
        return net("Conv", pixels, weights, group=count, strides=[STRIDE] * 2, pads=pads)

    mass = over_cells(dots, len(schema), np.outer(ramp, ramp))
    axes = net.constant([2, 3], np.int64)
    total = net("ReduceSum", mass, axes, keepdims=1)

    def centre(j: int, ramp: np.ndarray) -> str:
        one = net(
            "Slice", mass, net.constant([j], np.int64), net.constant([j + 1], np.int64), net.constant([1], np.int64)
        )
        moment = net("ReduceSum", net("Mul", one, net.constant(ramp)), axes, keepdims=1)
        return net("Div", moment, net("Add", net("ReduceSum", one, axes, keepdims=1), net.constant(1e-9)))

    def step(difference: str, from_: float = 0.0) -> str:
        return net("Clip", net("Sub", difference, net.constant(from_)), net.constant(0.0), net.constant(1.0))

    across = np.arange(width // STRIDE)[None, None, None]
    down = np.arange(height // STRIDE)[None, None, :, None]
    faces_left = step(net("Sub", centre(REAR, across), centre(FRONT, across)))
    upright = step(net("Sub", centre(BOTTOM, down), centre(TOP, down)), 3.0)
    flip = net.constant(schema.flip, np.int64)
    other = net("Sub", net.constant(1.0), faces_left)

    def named(values: str) -> str:
        exchanged = net("Gather", values, flip, axis=1)
        return net("Add", net("Mul", values, faces_left), net("Mul", exchanged, other))

    floor = net.constant(1e-6)
    heat = named(
        net("Div", net("Add", mass, floor), net("Add", total, net.constant(1e-6 * width * height / STRIDE**2)))
    )
    there = net("Clip", net("Mul", total, net.constant(0.2)), net.constant(0.0), net.constant(1.0))
    visible = net("ReduceSum", net("Mul", named(there), upright), axes, keepdims=0)
    from_grey = net("Sub", planes, net.constant(BACKGROUND))
    distance = net("ReduceSum", net("Mul", from_grey, from_grey), net.constant([1], np.int64), keepdims=1)
    on_car = net(
        "Clip",
        net("Mul", net("Sub", distance, net.constant(40.0**2)), net.constant(0.01)),
        net.constant(0.0),
        net.constant(1.0),
    )
    mask = net("Squeeze", over_cells(on_car, 1, np.full((STRIDE, STRIDE), STRIDE**-2.0)), net.constant([1], np.int64))

    cells = [height // STRIDE, width // STRIDE]
    shapes = {"heat": (heat, [1, 66, *cells]), "visible": (visible, [1, 66]), "mask": (mask, [1, *cells])}
    file = folder / "kronc66.onnx"
    for name, (source, _) in shapes.items():
        net.nodes.append(helper.make_node("Identity", [source], [name]))
    graph = helper.make_graph(
        net.nodes,
        "flat car",
        [helper.make_tensor_value_info("image", TensorProto.UINT8, [1, height, width, 3])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, (_, shape) in shapes.items()],
        net.constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 14)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, str(file))
    file.with_suffix(".json").write_text(json.dumps({**CARD, "sha256": file_sha256(file), **card}))
    return file
