"""Training that cannot recover ends; refined test poses are those that explain their images."""

import math

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio")

from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import SceneBox

from kronc_ns.errors import KroncError
from kronc_ns.geometry.rotations import so3_exp
from kronc_ns.plugin.dvgo.model import DVGOModelConfig
from kronc_ns.plugin.pipeline import check_finite, check_parameters, refined_pose
from kronc_ns.plugin.splat_cpu.model import SplatfactoCpuModelConfig

pytestmark = pytest.mark.nerfstudio
BOX = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
SIZE, DISTANCE = 48, 3.0


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_is_named(value):
    check_finite({"rgb_loss": torch.tensor(0.2), "tv": torch.tensor(0.0)}, 3)
    with pytest.raises(KroncError, match=rf"tv is {value} at step 17"):
        check_finite({"rgb_loss": torch.tensor(0.2), "tv": torch.tensor(value)}, 17)


def test_a_parameter_without_a_finite_number_is_named_and_a_stray_one_is_not():
    stray = torch.tensor([1.0, math.nan])
    check_parameters({"means": stray, "none": torch.zeros(0, 3)}, 99)
    with pytest.raises(KroncError, match="scales holds no finite number at step 99"):
        check_parameters({"means": stray, "scales": torch.full((4, 3), math.nan)}, 99)


def splats():
    """Splatfacto with small, coloured Gaussians."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(300, 3, generator=generator) * 0.35
    seeds = points, torch.randint(0, 256, (300, 3), generator=generator)
    model = SplatfactoCpuModelConfig(background_color="white").setup(scene_box=BOX, num_train_data=1, seed_points=seeds)
    with torch.no_grad():
        model.gauss_params["opacities"].fill_(2.0)
        model.gauss_params["scales"].fill_(math.log(0.05))
    model.step = 5
    return model


def voxels():
    """DVGO's coarse stage with a solid, coloured ball."""
    torch.manual_seed(0)
    model = DVGOModelConfig(coarse_voxels=24**3, fine_voxels=24**3).setup(scene_box=BOX, num_train_data=1)
    grid, colours = model.coarse.density_grid, model.coarse.colour_grid
    with torch.no_grad():
        grid.values.copy_(40 * (0.7 - grid.nodes().norm(dim=-1, keepdim=True)))
        x, y, z = grid.nodes().unbind(-1)
        colours.values.copy_(torch.stack([3 * (7 * x).sin(), 3 * (6 * y + 2 * x).cos(), 3 * (5 * z - x).sin()], dim=-1))
    return model


def error(c2w: torch.Tensor, truth: torch.Tensor) -> float:
    """How far a camera is from where it should be, by where it sees points on the object (radians)."""
    points = torch.tensor([[0.4, 0.0, 0.0], [0.0, 0.4, 0.0], [0.0, 0.0, 0.4]])
    seen = [torch.nn.functional.normalize((points - pose[:, 3]) @ pose[:, :3], dim=-1) for pose in (c2w, truth)]
    return float((seen[0] - seen[1]).norm(dim=-1).max())


@pytest.mark.parametrize(("build", "whole"), [(splats, True), (voxels, False)])
@pytest.mark.usefixtures("without_lpips")
def test_a_camera_is_found_by_its_image(build, whole):
    model = build().eval()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    truth = torch.eye(4)[:3].clone()
    truth[2, 3] = DISTANCE
    camera = Cameras(truth[None], fx=60.0, fy=60.0, cx=SIZE / 2, cy=SIZE / 2, width=SIZE, height=SIZE)
    with torch.no_grad():
        image = model.get_outputs_for_camera(camera)["rgb"].detach()
    moved = truth.clone()
    moved[:, :3] = torch.from_numpy(so3_exp(np.array([0.012, -0.009, 0.015]))).float() @ truth[:, :3]
    moved[:, 3] += torch.tensor([0.03, -0.02, 0.02])
    start = Cameras(moved[None], fx=60.0, fy=60.0, cx=SIZE / 2, cy=SIZE / 2, width=SIZE, height=SIZE)
    found = refined_pose(model, start, {"image": image}, whole, torch.Generator().manual_seed(0))
    assert error(moved, truth) > 0.008
    assert error(found, truth) < 0.2 * error(moved, truth)
    torch.testing.assert_close(start.camera_to_worlds[0], moved)  # what came in is as it was
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
