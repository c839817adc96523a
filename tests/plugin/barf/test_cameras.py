"""Poses that are found in training: where they begin, that rays and cameras move alike, and that local motions fit."""

import pytest
import torch

pytest.importorskip("nerfstudio")

from nerfstudio.cameras.cameras import Cameras

from kronc_ns.geometry.poses import flip_camera_axes
from kronc_ns.plugin.barf.cameras import GlobalPosesConfig, LocalToGlobalPosesConfig
from kronc_ns.plugin.barf.rigid import se3_exp, transform
from kronc_ns.plugin.pipeline import carried_along
from kronc_ns.synthetic.scenes import make_capture

pytestmark = pytest.mark.nerfstudio
GLOBAL = GlobalPosesConfig(mode="SE3")
LOCAL = LocalToGlobalPosesConfig(mode="SE3", warp_depth=3, warp_width=16, code_size=4)
UNIT = 2.5


@pytest.fixture(scope="module")
def cameras():
    capture = make_capture("walk", 5, 0)
    c2w = torch.from_numpy(flip_camera_axes(capture.c2w)).float()
    return Cameras(c2w, fx=60.0, fy=60.0, cx=24.0, cy=16.0, width=48, height=32, metadata={})


def optimizer(config, cameras):
    poses = config.setup(num_cameras=len(cameras), device="cpu")
    poses.begin_at(cameras, UNIT)
    return poses


def disturb(poses):
    with torch.no_grad():
        for parameter in poses.parameters():
            parameter += 0.05 * torch.randn_like(parameter)


@pytest.mark.parametrize("config", [GLOBAL, LOCAL])
def test_poses_begin_where_the_cameras_are(config, cameras):
    torch.testing.assert_close(optimizer(config, cameras).poses(), cameras.camera_to_worlds, atol=1e-5, rtol=0)


@pytest.mark.parametrize("config", [GLOBAL, LOCAL])
def test_nerfstudio_sees_the_same_poses(config, cameras):
    poses = optimizer(config, cameras)
    disturb(poses)
    found = poses.poses()
    assert float((found - cameras.camera_to_worlds).abs().max()) > 0.01
    for i in range(len(cameras)):
        camera = cameras[i : i + 1]
        camera.metadata = {"cam_idx": i}
        torch.testing.assert_close(poses.apply_to_camera(camera)[0], found[i], atol=1e-5, rtol=0)
    rotations = found[..., :3]
    torch.testing.assert_close(rotations @ rotations.mT, torch.eye(3).expand(5, 3, 3), atol=1e-5, rtol=0)


def test_rays_move_with_their_camera(cameras):
    poses = optimizer(GLOBAL, cameras)
    disturb(poses)
    index = torch.tensor([[0], [3], [3]])
    coords = torch.tensor([[3.5, 4.5], [10.5, 40.5], [31.5, 0.5]])
    rays = cameras.generate_rays(index, coords)
    poses.apply_to_raybundle(rays)
    moved = Cameras(poses.poses().detach(), fx=60.0, fy=60.0, cx=24.0, cy=16.0, width=48, height=32)
    expected = moved.generate_rays(index, coords)
    torch.testing.assert_close(rays.origins, expected.origins, atol=1e-5, rtol=0)
    torch.testing.assert_close(rays.directions, expected.directions, atol=1e-5, rtol=0)


@pytest.mark.parametrize("alike", [False, True])
def test_other_cameras_are_carried_along_also_with_cameras_in_a_line(alike, cameras):
    start = cameras.camera_to_worlds.clone()
    if alike:
        start[:, :, 3] = torch.tensor([0.0, 0.0, 3.0]) + torch.arange(5.0)[:, None] * torch.tensor([1.0, 0.2, 0.0])
    training, others = (Cameras(c2w, fx=60.0, fy=60.0, cx=24.0, cy=16.0) for c2w in (start, cameras.camera_to_worlds))
    poses = optimizer(GLOBAL, training)
    twist = torch.tensor([0.1, -0.2, 0.05, 0.03, 0.02, -0.04])
    with torch.no_grad():
        poses.pose_adjustment.copy_(twist.expand(5, 6))
    world = se3_exp(twist)
    found = carried_along(poses, training, others)
    torch.testing.assert_close(found[..., :3], world[:, :3] @ cameras.camera_to_worlds[..., :3], atol=1e-4, rtol=0)
    centres = transform(world, cameras.camera_to_worlds[..., 3] / UNIT) * UNIT
    torch.testing.assert_close(found[..., 3], centres, atol=1e-3, rtol=0)


def test_local_motions_that_agree_are_their_camera_s(cameras):
    poses = optimizer(LOCAL, cameras)
    twist = torch.tensor([0.1, -0.2, 0.05, 0.03, 0.02, -0.04])
    with torch.no_grad():
        poses.warp.last.bias.copy_(twist)
    torch.testing.assert_close(poses.motions(), se3_exp(twist).expand(5, 3, 4), atol=1e-5, rtol=0)
    rays = cameras.generate_rays(torch.tensor([[1]]), torch.tensor([[8.5, 20.5]]))
    poses.apply_to_raybundle(rays)
    losses = {}
    poses.get_loss_dict(losses)
    assert float(losses["alignment_loss"].detach()) < 1e-8
    assert float((rays.origins[0] - poses.poses()[1, :, 3]).norm()) < 1e-4


def test_local_motions_that_differ_cost_and_hold_each_other_back(cameras):
    poses = optimizer(LOCAL, cameras)
    disturb(poses)
    rays = cameras.generate_rays(torch.arange(5)[:, None], torch.rand(5, 2) * 30)
    poses.apply_to_raybundle(rays)
    losses = {}
    poses.get_loss_dict(losses)
    losses["alignment_loss"].backward()
    assert float(losses["alignment_loss"].detach()) > 1e-6
    assert all(p.grad is not None and p.grad.isfinite().all() for p in poses.parameters())


@pytest.mark.parametrize("config", [GlobalPosesConfig(mode="off"), LocalToGlobalPosesConfig(mode="off")])
def test_poses_that_are_not_to_be_found_stay(config, cameras):
    poses = optimizer(config, cameras)
    assert not list(poses.parameters())
    rays = cameras.generate_rays(torch.tensor([[1]]), torch.tensor([[8.5, 20.5]]))
    before = rays.origins.clone()
    poses.apply_to_raybundle(rays)
    torch.testing.assert_close(rays.origins, before)
    torch.testing.assert_close(poses.poses(), cameras.camera_to_worlds)
