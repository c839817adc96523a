"""nerfstudio's own tools on a run of each method that trains on a CPU, and of a stock method.

All of them look at what comes out. What nerfstudio cannot do with a method stands at the end, and in the README.
"""

import functools
import gzip
import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import av
import msgspec
import numpy as np
import pytest
import trimesh
from jaxtyping import Float
from PIL import Image
from websockets.sync.client import connect

from kronc_ns.benchmark.training import train, write_variant
from kronc_ns.errors import KroncError
from kronc_ns.files.transforms import read_poses
from kronc_ns.fit.options import KroncConfig
from kronc_ns.geometry.poses import flip_camera_axes
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import default_camera, make_capture
from tests.plugin.commands import InProcess, evaluate

pytestmark = [pytest.mark.slow, pytest.mark.nerfstudio, pytest.mark.usefixtures("without_lpips")]
SIZE, VIEWS = 48, 8
EVERY_FOURTH = ["--eval-interval", "4"]
TEST_VIEWS = ["frame_00001", "frame_00005"]
MODEL = "--pipeline.model."
FEW_RAYS = ["--pipeline.datamanager.train-num-rays-per-batch", "512"]
SPLATS, DVGO, TENSORF, STOCK = "kronc-splatfacto-cpu", "kronc-dvgo-cpu", "kronc-tensorf-cpu", "vanilla-nerf"
REFINED = f"{TENSORF}, refined"
OPTIONS = {
    SPLATS: ["--max-num-iterations", "40", f"{MODEL}num-downscales", "0"],
    TENSORF: ["--max-num-iterations", "100", *FEW_RAYS],
    REFINED: ["--max-num-iterations", "10", *FEW_RAYS, f"{MODEL}camera-optimizer.mode", "SO3xR3"],
    DVGO: [
        *("--max-num-iterations", "100", *FEW_RAYS, f"{MODEL}coarse-iterations", "60"),
        *(f"{MODEL}coarse-voxels", str(16**3), f"{MODEL}fine-voxels", str(32**3), f"{MODEL}growth-steps", "10"),
    ],
    STOCK: [
        *("--max-num-iterations", "10", *FEW_RAYS, "--vis", "tensorboard", "--machine.device-type", "cpu"),
        *("--steps-per-eval-batch", "0", "--steps-per-eval-image", "0", "--steps-per-eval-all-images", "0"),
        *(f"{MODEL}num-coarse-samples", "16", f"{MODEL}num-importance-samples", "8"),
    ],
}
"""Enough that the car shows, but for the stock method's, which would take minutes."""
PARSER = {STOCK: ["--scale-factor", "4"]}  # vanilla-nerf sees from 2 to 6 units
ON_RAYS = [DVGO, TENSORF]
OURS = [SPLATS, *ON_RAYS]
RGB = {STOCK: "rgb_fine"}
POINTS = ["--num-points", "2000", "--num-rays-per-batch", "1024", "--normal-method", "open3d"]
TEXTURE = ["--num-pixels-per-side", "64", "--target-num-faces", "200"]


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """A rendered car with masks, on its exact poses."""
    root = tmp_path_factory.mktemp("tools")
    capture = make_capture("carpatch", VIEWS, seed=8, camera=default_camera("carpatch", SIZE))
    write_capture(root / "capture", capture, render=True, ground=False)
    write_variant(root / "exact", root / "capture", "exact", KroncConfig(), capture.points)
    return root / "exact"


@pytest.fixture(scope="module")
def run(data, tmp_path_factory) -> Callable[[str], Path]:
    """config.yml of a short training of a method; each trained once."""
    out = tmp_path_factory.mktemp("runs")
    return functools.cache(lambda kind: trained(kind, data, out / kind))


def trained(kind: str, data: Path, out: Path, *more: str) -> Path:
    """config.yml of a training as `OPTIONS` has it, with ``more``."""
    parser = [*EVERY_FOURTH, *PARSER.get(kind, [])]
    return train(data, kind.split(",")[0], out, [*OPTIONS[kind], *more], parser, InProcess())


@pytest.fixture
def tool(run, tmp_path) -> Callable[..., Path]:
    """Runs a tool on a method's run; the path of what it wrote."""

    def call(method: str, command: str, kind: str, *options: str) -> Path:
        output = tmp_path / (f"{kind}.mp4" if command == "ns-render" and kind != "dataset" else kind)
        where = "--output-path" if command == "ns-render" else "--output-dir"
        InProcess().run(command, kind, "--load-config", str(run(method)), where, str(output), *options)
        return output

    return call


def frames(video: Path) -> list[Float[np.ndarray, "h w 3"]]:
    with av.open(str(video)) as container:
        return [frame.to_ndarray(format="rgb24") / 255 for frame in container.decode(video=0)]


def shows_something(image: Float[np.ndarray, "h w 3"]) -> bool:
    """Neither all background nor all car."""
    return image.std() > 0.1


def in_training(run: Path, c2w: Float[np.ndarray, "n 3 4"]) -> Float[np.ndarray, "n 3 4"]:
    """Poses (OpenCV axes) as a run has them: OpenGL axes, moved to the car's centre and scaled."""
    world = json.loads((run.parent / "dataparser_transforms.json").read_text())
    moved = flip_camera_axes(c2w)
    moved[..., 3] = (moved[..., 3] + np.array(world["transform"])[:, 3]) * world["scale"]
    return moved


def car_box(data: Path) -> Float[np.ndarray, "2 3"]:
    """Around the keypoints, with half a metre to spare."""
    points = np.array(json.loads((data / "kronc.json").read_text())["points"])
    return np.stack([points.min(0) - 0.5, points.max(0) + 0.5])


@pytest.mark.parametrize("method", [*OURS, STOCK])
def test_runs_are_evaluated(method, run):
    metrics = evaluate(run(method))
    assert 5 < metrics["psnr"] < 60


@pytest.mark.parametrize("method", [*OURS, STOCK])
def test_runs_are_resumed(method, run, data, tmp_path):
    checkpoints = run(method).parent / "nerfstudio_models"
    (last,) = (int(path.stem.split("-")[1]) for path in checkpoints.glob("*.ckpt"))
    resumed = trained(method, data, tmp_path, "--load-dir", str(checkpoints), "--max-num-iterations", "2")
    assert [path.name for path in (resumed.parent / "nerfstudio_models").iterdir()] == [f"step-{last + 2:09d}.ckpt"]


@pytest.mark.parametrize("method", [*OURS, STOCK])
def test_paths_are_rendered(method, run, tool, data, tmp_path):
    names = ["--rendered-output-names", RGB.get(method, "rgb")]
    between = frames(tool(method, "ns-render", "interpolate", "--interpolation-steps", "3", *names))
    pose = in_training(run(method), read_poses(data / "transforms.json").popitem()[1])
    stop = {"camera_to_world": np.vstack([pose, [0, 0, 0, 1]]).ravel().tolist(), "fov": 50, "aspect": 1}
    path = {"render_height": SIZE, "render_width": SIZE, "seconds": 1, "fps": 2, "camera_path": [stop, stop]}
    (tmp_path / "path.json").write_text(json.dumps(path))
    along = frames(tool(method, "ns-render", "camera-path", "--camera-path-filename", f"{tmp_path}/path.json", *names))
    assert [len(between), len(along)] == [3, 2]
    assert method == STOCK or all(map(shows_something, between + along))


@pytest.mark.parametrize("method", [*ON_RAYS, STOCK])
def test_spirals_are_rendered(method, tool):
    names = ["--rendered-output-names", RGB.get(method, "rgb")]
    spiral = frames(tool(method, "ns-render", "spiral", "--seconds", "1", "--frame-rate", "2", *names))
    assert len(spiral) == 2
    assert method == STOCK or all(map(shows_something, spiral))


@pytest.mark.parametrize("method", OURS)
def test_test_views_are_rendered_under_their_names(method, tool):
    names = ["rgb", "rgba", "gt-rgb", "depth", "accumulation", "raw-depth"]
    options = ["--image-format", "png", "--rendered-output-names", *names]
    output = tool(method, "ns-render", "dataset", *options)
    suffixes = {"raw-depth": ".npy.gz"}
    for name in names:
        expected = [f"{view}{suffixes.get(name, '.png')}" for view in TEST_VIEWS]
        assert sorted(path.name for path in (output / "test" / name).iterdir()) == expected
    first = {name: output / "test" / name / f"{TEST_VIEWS[0]}.png" for name in names}
    rgb, rgba = (np.asarray(Image.open(first[name])) / 255 for name in ("rgb", "rgba"))
    on_white = rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]
    np.testing.assert_allclose(on_white, rgb, atol=3 / 255)
    assert rgba[0, 0, 3] < 0.3
    assert rgba[SIZE // 2, SIZE // 2, 3] > 0.5
    with gzip.open(output / "test/raw-depth" / f"{TEST_VIEWS[0]}.npy.gz") as file:
        assert np.isfinite(np.load(file)).all()


@pytest.mark.parametrize("kind", [*OURS, REFINED, STOCK])
def test_cameras_are_exported(kind, run, tool, data):
    output = tool(kind, "ns-export", "cameras")
    poses = {Path(name).name: pose for name, pose in read_poses(data / "transforms.json").items()}
    for split, views in (("train", VIEWS - len(TEST_VIEWS)), ("eval", len(TEST_VIEWS))):
        exported = json.loads((output / f"transforms_{split}.json").read_text())
        expected = in_training(run(kind), np.stack([poses[Path(frame["file_path"]).name] for frame in exported]))
        moved = np.abs(np.array([frame["transform"] for frame in exported]) - expected).max(axis=(1, 2))
        assert len(moved) == views
        if kind == REFINED:
            assert (moved > 1e-4).all()
            assert (moved < 0.5).all()  # of 10 to the farthest camera
        else:
            assert (moved < 1e-4).all()


def test_splats_are_exported(run, tool, data):
    cloud = trimesh.load(tool(SPLATS, "ns-export", "gaussian-splat") / "splat.ply")
    world = json.loads((run(SPLATS).parent / "dataparser_transforms.json").read_text())
    points = np.asarray(cloud.vertices) / world["scale"] - np.array(world["transform"])[:, 3]
    low, high = car_box(data)
    assert len(points) > 1000
    assert ((points > low) & (points < high)).all(-1).mean() > 0.95


@pytest.mark.parametrize("method", ON_RAYS)
def test_point_clouds_are_of_the_car_alone(method, tool, data):
    cloud = trimesh.load(
        tool(method, "ns-export", "pointcloud", *POINTS, "--save-world-frame", "True") / "point_cloud.ply"
    )
    low, high = car_box(data)
    assert len(cloud.vertices) > 1500
    assert ((cloud.vertices > low) & (cloud.vertices < high)).all(-1).mean() > 0.95


@pytest.mark.parametrize("method", ON_RAYS)
def test_meshes_are_exported(method, tool):
    in_the_box = ["--resolution", "32", "--use-bounding-box", "False"]
    for kind, options in (("tsdf", in_the_box), ("poisson", POINTS)):
        output = tool(method, "ns-export", kind, *options, *TEXTURE)
        assert len(trimesh.load(output / f"{kind}_mesh.ply").faces) > 100
        assert (output / "mesh.obj").stat().st_size > 1000
        assert shows_something(np.asarray(Image.open(output / "material_0.png").convert("RGB")) / 255)


def test_clouds_and_meshes_of_a_stock_method_are_exported(tool):
    names = ["--rgb-output-name", "rgb_fine", "--depth-output-name", "depth_fine"]
    cloud = trimesh.load(tool(STOCK, "ns-export", "pointcloud", *POINTS, *names) / "point_cloud.ply")
    assert len(cloud.vertices) > 500


@pytest.fixture(params=OURS)
def viewer(request, run) -> Iterator[tuple[int, Path]]:
    """Port of `ns-viewer`, which runs as a process of its own, and the run that it shows."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    config = run(request.param)
    command = [str(Path(sys.executable).parent / "ns-viewer"), "--load-config", str(config)]
    process = subprocess.Popen(
        [*command, "--viewer.websocket-port", str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    yield port, config
    process.terminate()
    process.wait(30)


def test_the_viewer_shows_the_car(viewer, data, tmp_path):
    port, config = viewer
    pose = in_training(config, read_poses(data / "transforms.json").popitem()[1])
    (tmp_path / "seen.jpg").write_bytes(picture_at(port, flip_camera_axes(pose)))
    assert shows_something(np.asarray(Image.open(tmp_path / "seen.jpg").convert("RGB")) / 255)


def picture_at(port: int, c2w: Float[np.ndarray, "3 4"]) -> bytes:
    """The first picture that nerfstudio's viewer sends a browser whose camera stands at ``c2w`` (OpenCV axes)."""
    quaternion = trimesh.transformations.quaternion_from_matrix(c2w[:, :3])
    position = (10 * c2w[:, 3]).tolist()  # the viewer shows scenes ten times as large
    camera = {"type": "ViewerCameraMessage", "wxyz": quaternion.tolist(), "position": position, "fov": 0.9}
    camera |= {"aspect": 1.0, "look_at": [0.0, 0.0, 0.0], "up_direction": [0.0, 0.0, 1.0]}
    deadline = time.monotonic() + 120
    while True:
        try:
            browser = connect(f"ws://127.0.0.1:{port}", max_size=None)
            break
        except OSError:  # not there yet
            assert time.monotonic() < deadline
            time.sleep(0.5)
    with browser:
        browser.send(msgspec.msgpack.encode(camera))
        while True:
            received = msgspec.msgpack.decode(browser.recv(timeout=deadline - time.monotonic()))
            for message in received if isinstance(received, list) else received["messages"]:
                if message["type"] == "BackgroundImageMessage":
                    return message["rgb_bytes"]


# ---- what nerfstudio cannot do: should one of these work one day, the README is to say so


@pytest.mark.parametrize("kind", ["pointcloud", "poisson"])
def test_nerfstudio_makes_no_clouds_of_splats(kind, tool):
    with pytest.raises(AttributeError, match="train_pixel_sampler"):
        tool(SPLATS, "ns-export", kind, *POINTS)


def test_nerfstudio_makes_no_meshes_of_splats(tool):
    with pytest.raises(KroncError, match="Could not find rgb"):
        tool(SPLATS, "ns-export", "tsdf")


def test_nerfstudio_renders_no_spirals_of_splats(tool):
    with pytest.raises(AssertionError):
        tool(SPLATS, "ns-render", "spiral")


@pytest.mark.parametrize("method", ON_RAYS)
def test_nerfstudio_takes_normals_from_models_that_have_them(method, tool):
    with pytest.raises(KroncError, match="change --normal-method"):
        tool(method, "ns-export", "pointcloud")
