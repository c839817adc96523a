"""DVGO: the paper's equations, grids that change their resolution, checkpoints across the stages, and training."""

import math
from types import SimpleNamespace

import pytest
import torch

pytest.importorskip("nerfstudio")

from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.engine.optimizers import Optimizers

from kronc_ns.benchmark.training import train, write_variant
from kronc_ns.fit.options import KroncConfig
from kronc_ns.plugin.dvgo import equations
from kronc_ns.plugin.dvgo.field import view_rates
from kronc_ns.plugin.dvgo.grid import RatedVoxelGrid, UnknownSpace, VoxelGrid, sample_corners, sample_fused
from kronc_ns.plugin.dvgo.losses import StageLosses
from kronc_ns.plugin.dvgo.model import DVGOModel, DVGOModelConfig
from kronc_ns.plugin.dvgo.sampling import ray_box, sample_rays
from kronc_ns.plugin.methods import kronc_dvgo_cpu
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import default_camera, make_capture
from tests.plugin.commands import InProcess, evaluate

pytestmark = [pytest.mark.nerfstudio, pytest.mark.usefixtures("without_lpips")]
BOX = torch.tensor([[-1.0, -0.8, -0.6], [1.0, 0.8, 0.6]])
RADIUS = 0.4


def test_alpha_is_the_paper_s_formula():
    raw = torch.linspace(-30, 30, 61, dtype=torch.float64)
    expected = 1 - torch.exp(-torch.log(1 + torch.exp(raw + 2.5)) * 0.3)
    torch.testing.assert_close(equations.alpha(equations.density(raw, 2.5), 0.3), expected)


@pytest.mark.parametrize("alpha_init", [1e-6, 1e-2, 0.3])
def test_bias_gives_the_initial_alpha_over_a_voxel(alpha_init):
    bias = equations.density_bias(alpha_init)
    assert bias == pytest.approx(math.log((1 - alpha_init) ** -1.0 - 1), rel=1e-9)
    found = equations.alpha(equations.density(torch.zeros(1), bias), 1.0)
    assert found.item() == pytest.approx(alpha_init, rel=1e-4)


def test_weights_are_the_paper_s_products():
    optical = torch.rand(4, 7, dtype=torch.float64) * 3
    optical[0, 3] = 800.0  # an alpha of exactly 1
    optical.requires_grad_()
    weights, background = equations.render_weights(optical)
    alphas = 1 - torch.exp(-optical.detach())
    before = torch.cumprod(torch.cat([torch.ones(4, 1), 1 - alphas], dim=1), dim=1)
    torch.testing.assert_close(weights, before[:, :-1] * alphas)
    torch.testing.assert_close(background, before[:, -1])
    torch.testing.assert_close(weights.sum(1) + background, torch.ones(4, dtype=torch.float64))
    (weights.square().sum() + background.sum()).backward()
    assert torch.isfinite(optical.grad).all()


def test_entropy_is_least_where_rays_are_decided():
    decided, halfway = torch.tensor([0.0, 1.0]), torch.tensor([0.5, 0.5])
    assert equations.background_entropy(decided) < 1e-4
    assert equations.background_entropy(halfway).item() == pytest.approx(math.log(2))


def test_a_grid_interpolates_trilinear_functions_exactly():
    grid = VoxelGrid(2, BOX, (5, 4, 3))
    x, y, z = grid.nodes().unbind(-1)
    grid.values.data = torch.stack([1 + x - 2 * y + 3 * z, x * y * z], dim=-1)
    points = BOX[0] + torch.rand(50, 3) * (BOX[1] - BOX[0])
    px, py, pz = points.unbind(-1)
    torch.testing.assert_close(grid(points)[:, 0], 1 + px - 2 * py + 3 * pz, atol=1e-5, rtol=0)
    at_nodes = grid(grid.nodes().reshape(-1, 3)).reshape(5, 4, 3, 2)
    torch.testing.assert_close(at_nodes, grid.values, atol=1e-5, rtol=0)


def test_both_ways_to_interpolate_agree_with_their_gradients():
    values = torch.randn(5, 4, 3, 6, dtype=torch.float64, requires_grad=True)
    points = (torch.rand(40, 3, dtype=torch.float64) * 1.2 - 0.1).requires_grad_()
    found = [sample(values, points) for sample in (sample_corners, sample_fused)]
    torch.testing.assert_close(*found)
    weights = torch.randn(40, 6, dtype=torch.float64)
    gradients = [torch.autograd.grad((f * weights).sum(), (values, points)) for f in found]
    for corners, fused in zip(*gradients, strict=True):
        torch.testing.assert_close(corners, fused)


def test_no_points_are_fine():
    grid = VoxelGrid(2, BOX, (5, 4, 3))
    found = grid(torch.zeros(0, 3))
    assert found.shape == (0, 2)
    found.sum().backward()


def test_shape_follows_the_number_of_voxels_and_the_box():
    assert equations.grid_shape(torch.tensor([[0.0, 0, 0], [4.0, 2.0, 1.0]]), 8000) == (40, 20, 10)
    assert equations.grid_shape(torch.tensor([[0.0, 0, 0], [1.0, 1.0, 1e-6]]), 1000)[2] == 2


def test_growing_keeps_a_linear_field_exactly():
    grid = VoxelGrid(1, BOX, (6, 5, 4))
    nodes = grid.nodes().reshape(-1, 3)
    values = nodes @ torch.tensor([1.0, -2.0, 3.0])
    grid.values.data = values.reshape(6, 5, 4, 1)
    assert grid.grow(1500)
    torch.testing.assert_close(grid(nodes).detach()[:, 0], values, atol=1e-5, rtol=0)


def test_growing_keeps_the_field():
    shape, grown = (20, 16, 12), (40, 32, 24)
    grid = VoxelGrid(1, BOX, shape)
    grid.values.data = torch.sin(4 * grid.nodes()).sum(-1, keepdim=True)
    points = BOX[0] + torch.rand(200, 3) * (BOX[1] - BOX[0])
    before = grid(points).detach()
    assert grid.grow(8 * 20 * 16 * 12)
    assert not grid.grow(8 * 20 * 16 * 12)
    assert grid.shape == grown
    # along each axis the slope changes by at most h max|f''| at an old node, in the middle of a new voxel at worst
    coarse, fine = ((BOX[1] - BOX[0]) / (torch.tensor(n) - 1) for n in (shape, grown))
    bound = (4**2 * coarse * fine / 4).sum().item()
    torch.testing.assert_close(grid(points).detach(), before, atol=bound, rtol=0)


def test_the_box_encloses_a_blob_with_one_voxel_to_spare():
    grid = VoxelGrid(1, BOX, (41, 33, 25))
    centre, half = torch.tensor([0.3, -0.2, 0.1]), torch.tensor([0.3, 0.2, 0.2])
    occupied = ((grid.nodes() - centre).abs() <= half + 1e-6).all(-1)
    box = equations.occupied_box(occupied, BOX)
    torch.testing.assert_close(box, torch.stack([centre - half - 0.05, centre + half + 0.05]), atol=1e-6, rtol=0)
    assert equations.occupied_box(torch.zeros_like(occupied), BOX) is None


def test_unknown_space_holds_all_that_is_occupied():
    grid = VoxelGrid(1, BOX, (21, 17, 13))
    occupied = grid.nodes().norm(dim=-1) < RADIUS
    space = UnknownSpace(BOX)
    points = BOX[0] + torch.rand(2000, 3) * (BOX[1] - BOX[0])
    assert space(points).all()  # before the coarse stage
    space.mark(occupied)
    assert space(points)[points.norm(dim=-1) < RADIUS].all()
    assert not space(points)[points.norm(dim=-1) > RADIUS + 0.4].any()


def ring(views: int, size: int = 24, focal: float = 24.0) -> Cameras:
    """Cameras 3 from the origin that look at it, in turn from a little and from far above."""
    c2w = []
    for angle in torch.linspace(0, 2 * math.pi, views + 1)[:-1]:
        back = torch.stack([angle.cos(), angle.sin(), torch.tensor(0.3 if len(c2w) % 2 else 1.2)])
        centre, back = 3 * back / back.norm(), back / back.norm()
        right = torch.linalg.cross(torch.tensor([0.0, 0, 1]), back)
        right = right / right.norm()
        c2w.append(torch.stack([right, torch.linalg.cross(back, right), back, centre], dim=1))
    return Cameras(torch.stack(c2w), focal, focal, size / 2, size / 2, size, size)


def test_rates_are_the_share_of_views_that_see_a_point():
    cameras = ring(8)
    nodes = torch.tensor([[0.0, 0, 0], [0.0, 0, 2.5], [0.0, 0, 100.0]])
    rates = view_rates(nodes, cameras)
    assert rates[0] == 1
    assert rates[2] == 0
    one_sided = view_rates(torch.tensor([[0.0, 0, 0], [3.5, 0, 1.0]]), cameras)
    assert 0 < one_sided[1] < 1  # behind or outside the nearest cameras
    seen = 0
    for i in range(len(cameras)):  # project by hand
        x, y, z = cameras.camera_to_worlds[i, :, :3].T @ (
            torch.tensor([3.5, 0, 1.0]) - cameras.camera_to_worlds[i, :, 3]
        )
        seen += bool(z < 0 and abs(24 * x / z) <= 12 and abs(24 * y / z) <= 12)
    assert one_sided[1].item() == pytest.approx(seen / 8)


def test_a_rated_point_steps_by_its_rate():
    grid = RatedVoxelGrid(1, BOX, (2, 2, 2))
    grid.rate.copy_(torch.linspace(0.1, 1, 8).reshape(2, 2, 2, 1))
    optimizer = torch.optim.Adam([grid.values], lr=0.1, eps=1e-15)
    (grid.at_nodes() * torch.randn(2, 2, 2, 1)).sum().backward()
    optimizer.step()
    torch.testing.assert_close(grid.at_nodes().detach().abs(), 0.1 * grid.rate, atol=1e-6, rtol=1e-5)


def test_rays_are_cut_to_the_box():
    origins = torch.tensor([[-5.0, 0, 0], [0.0, 0, 0], [-5.0, 2, 0]])
    directions = torch.tensor([[1.0, 0, 0]]).expand(3, 3)
    near, far = ray_box(origins, directions, BOX)
    torch.testing.assert_close(near[:2], torch.tensor([4.0, -1.0]))
    torch.testing.assert_close(far[:2], torch.tensor([6.0, 1.0]))
    assert far[2] < near[2]
    rays = RayBundle(origins, directions, pixel_area=torch.ones(3, 1))
    packed = sample_rays(rays, BOX, 0.1, None, jitter=False)
    assert torch.bincount(packed.rays, minlength=3).tolist() == [20, 10, 0]
    positions = packed.samples.frustums.get_positions()
    assert ((positions >= BOX[0]) & (positions <= BOX[1])).all()


def tiny_model(**changes) -> DVGOModel:
    options = {
        "coarse_iterations": 60,
        "coarse_voxels": 16**3,
        "fine_voxels": 24**3,
        "growth_steps": (20, 40),
        "mlp_width": 16,
        "feature_channels": 4,
    }
    config = DVGOModelConfig(**(options | changes))
    return config.setup(scene_box=SceneBox(aabb=BOX), num_train_data=8, metadata={})


def ball(rays: RayBundle) -> torch.Tensor:
    """The image of a ball coloured by its normals before white, [r 3]."""
    along = (rays.origins * rays.directions).sum(-1, keepdim=True)
    discriminant = along.square() - rays.origins.square().sum(-1, keepdim=True) + RADIUS**2
    hit = rays.origins + rays.directions * (-along - discriminant.clamp(min=0).sqrt())
    return torch.where(discriminant > 0, 0.5 + 0.5 * hit / RADIUS, torch.ones(3))


class Run:
    """A model with its optimisers, trained on the ball as nerfstudio's trainer does."""

    def __init__(self, model: DVGOModel) -> None:
        self.model, self.cameras = model, ring(8)
        groups = kronc_dvgo_cpu.config.optimizers
        self.optimizers = Optimizers(dict(groups), model.get_param_groups())
        dataset = SimpleNamespace(cameras=self.cameras)
        pipeline = SimpleNamespace(datamanager=SimpleNamespace(train_dataset=dataset))
        attributes = TrainingCallbackAttributes(self.optimizers, None, pipeline, None)
        self.callbacks = model.get_training_callbacks(attributes)
        self.generator = torch.Generator().manual_seed(0)

    def rays(self, count: int = 256) -> RayBundle:
        view = torch.randint(8, (count, 1), generator=self.generator)
        return self.cameras.generate_rays(view, coords=torch.rand(count, 2, generator=self.generator) * 24)

    def step(self, step: int) -> float:
        self.model.train()
        for callback in self.callbacks:
            callback.run_callback(step)
        self.optimizers.zero_grad_all()
        rays = self.rays()
        outputs = self.model(rays)
        self.losses = self.model.get_loss_dict(outputs, {"image": ball(rays)})
        sum(self.losses.values()).backward()
        assert all(p.grad is None or torch.isfinite(p.grad).all() for p in self.model.parameters())
        for group, optimizer in self.optimizers.optimizers.items():
            if any(p.grad is not None for p in optimizer.param_groups[0]["params"]):
                self.optimizers.optimizer_step(group)
        return float(self.losses["rgb_loss"].detach())


@pytest.fixture(scope="module")
def trained() -> tuple[Run, list[float], dict[int, dict]]:
    """A run through both stages: the losses, and checkpoints within each and after each growth."""
    torch.manual_seed(0)
    run, losses, checkpoints = Run(tiny_model()), [], {}
    for step in range(150):
        losses.append(run.step(step))
        if step in (30, 59, 70, 90, 149):
            state = {name: value.clone() for name, value in run.model.state_dict().items()}
            states = {name: optimizer.state_dict() for name, optimizer in run.optimizers.optimizers.items()}
            checkpoints[step] = {"model": state, "optimizers": states}
    return run, losses, checkpoints


def test_both_stages_learn(trained):
    run, losses, _ = trained
    assert run.model.is_fine
    assert sum(losses[-10:]) < 0.15 * sum(losses[:10])
    assert sum(losses[-10:]) < 0.3 * sum(losses[50:60])


def test_the_fine_box_is_around_what_the_coarse_stage_found():
    model = tiny_model(coarse_voxels=40**3)
    grid = model.coarse.density_grid
    inside = grid.nodes().norm(dim=-1) < RADIUS
    grid.values.data[inside] = 20.0
    model.begin_fine(voxels=500)
    low, high = model.fine.density_grid.aabb
    assert ((low < -RADIUS + 0.05) & (low > -RADIUS - 0.15)).all()
    assert ((high > RADIUS - 0.05) & (high < RADIUS + 0.15)).all()
    alpha = equations.alpha(model.fine.density_fn(torch.zeros(1, 3)), float(model.fine.unit))
    assert alpha.item() == pytest.approx(model.config.fine_alpha_init, rel=1e-3)


def test_the_grid_has_grown_and_the_coarse_one_is_gone(trained):
    model = trained[0].model
    assert model.fine.density_grid.shape == equations.grid_shape(model.fine.density_grid.aabb, 24**3)
    assert model.fine.feature_grid.shape == model.fine.density_grid.shape
    assert model.coarse.density_grid.values.numel() == 0


def test_the_optimisers_hold_the_tensors_in_use(trained):
    run = trained[0]
    for name, parameters in run.model.get_param_groups().items():
        held = run.optimizers.optimizers[name].param_groups[0]["params"]
        assert [id(p) for p in held] == [id(p) for p in parameters]
        for parameter in parameters:
            state = run.optimizers.optimizers[name].state.get(parameter, {})
            assert all(v.shape == parameter.shape for k, v in state.items() if k != "step")
    fine = run.optimizers.optimizers["fine"]
    assert fine.state[run.model.fine.density_grid.values]["step"] == 50  # since the last growth, at 60 + 40


@pytest.mark.parametrize("step", [30, 59, 70, 90, 149])
def test_checkpoints_load_at_any_stage_and_resolution(trained, step):
    saved = trained[2][step]
    model = tiny_model()
    optimizers = Optimizers(dict(kronc_dvgo_cpu.config.optimizers), model.get_param_groups())
    model.load_state_dict(saved["model"], strict=True)
    optimizers.load_optimizers(saved["optimizers"])
    for name, value in model.state_dict().items():
        torch.testing.assert_close(value, saved["model"][name])
    assert model.is_fine == (step >= 60)
    for name, parameters in model.get_param_groups().items():
        held = optimizers.optimizers[name].param_groups[0]["params"]
        assert [id(p) for p in held] == [id(p) for p in parameters]


@pytest.mark.parametrize("step", [59, 90])
def test_training_goes_on_from_a_checkpoint_as_without_one(trained, step):
    saved = trained[2][step]
    torch.manual_seed(1)
    run = Run(tiny_model())
    run.model.load_state_dict(saved["model"])
    run.optimizers.load_optimizers(saved["optimizers"])
    for later in range(step + 1, step + 30):
        loss = run.step(later)
    assert loss < 3 * max(trained[1][step - 5 : step + 30])
    assert run.model.fine.density_grid.shape == equations.grid_shape(
        run.model.fine.density_grid.aabb, run.model.voxels_at(step + 29 - 60)
    )


def test_rendering_is_the_same_before_and_after_loading(trained):
    run, other = trained[0], tiny_model()
    other.load_state_dict(run.model.state_dict())
    camera = run.cameras[:1]
    expected = run.model.eval().get_outputs_for_camera(camera)
    found = other.eval().get_outputs_for_camera(camera)
    assert found["rgb"].shape == (24, 24, 3)
    for name in ("rgb", "accumulation", "depth"):
        torch.testing.assert_close(found[name], expected[name])
    centre = found["depth"][12, 12].item()
    assert centre == pytest.approx(3 - RADIUS, abs=0.2)
    assert found["accumulation"][12, 12] > 0.9
    torch.testing.assert_close(found["rgb"][0, 0], torch.ones(3))  # white where there is nothing
    rgba = other.get_rgba_image(found)
    assert rgba[0, 0, 3] < 0.1
    assert rgba[12, 12, 3] > 0.9


def test_rays_that_are_hardly_held_up_end_behind_the_box():
    model = tiny_model().eval()
    model.coarse.density_grid.values.data += 5
    aabb = model.coarse.density_grid.aabb
    rays = RayBundle(torch.tensor([[0.1, 0.1, 9.0]]), torch.tensor([[0.0, 0, -1]]), pixel_area=torch.ones(1, 1))
    outputs = model(rays)
    assert 0 < outputs["accumulation"] < 0.5
    assert outputs["depth"].item() == pytest.approx(9 - aabb[0, 2].item(), abs=1e-4)


@pytest.mark.parametrize("fine", [False, True])
def test_rays_that_miss_everything_are_background_and_have_gradients(fine):
    model = tiny_model()
    if fine:
        model.coarse.density_grid.values.data += 20
        model.begin_fine(voxels=500)
    rays = RayBundle(torch.full((5, 3), 9.0), torch.tensor([[0.0, 0, 1]]).expand(5, 3), pixel_area=torch.ones(5, 1))
    outputs = model.train()(rays)
    torch.testing.assert_close(outputs["rgb"], torch.ones(5, 3))
    sum(model.get_loss_dict(outputs, {"image": torch.zeros(5, 3)}).values()).backward()
    assert not model.field.density_grid.values.grad.any()


def test_background_of_images_with_alpha_is_blended():
    model = tiny_model(background_color="black")
    rays = RayBundle(torch.full((5, 3), 9.0), torch.tensor([[0.0, 0, 1]]).expand(5, 3), pixel_area=torch.ones(5, 1))
    losses = model.train().get_loss_dict(model(rays), {"image": torch.tensor([[1.0, 1, 1, 0]]).expand(5, 4)})
    assert losses["rgb_loss"] == 0


def test_an_empty_coarse_stage_ends_with_its_reason(capsys):
    run = Run(tiny_model(coarse_iterations=0))
    with pytest.raises(SystemExit) as ended:
        run.step(0)
    assert ended.value.code == 2
    assert "found nothing in the scene box" in capsys.readouterr().err


@pytest.mark.parametrize("fine", [False, True])
def test_poses_can_be_refined(fine):
    model = tiny_model(camera_optimizer=CameraOptimizerConfig(mode="SO3xR3"))
    grid = model.coarse.density_grid
    grid.values.data = 14 * (2 - grid.nodes().norm(dim=-1, keepdim=True) / RADIUS)
    if fine:
        model.begin_fine(voxels=2000)
    view = torch.arange(8).repeat_interleave(64)[:, None]
    rays = ring(8).generate_rays(view, coords=12 + 8 * torch.rand(512, 2) - 4)
    losses = model.train().get_loss_dict(model(rays), {"image": torch.zeros(512, 3)})
    sum(losses.values()).backward()
    gradient = model.camera_optimizer.pose_adjustment.grad
    assert torch.isfinite(gradient).all()
    assert gradient.norm(dim=-1).min() > 0


def test_total_variation_is_an_option():
    run = Run(tiny_model(coarse_losses=StageLosses(0.1, 0.01, total_variation=1.0)))
    run.step(0)
    assert run.losses["total_variation"] == 0  # all of the grid is the same
    run.step(1)
    assert run.losses["total_variation"] > 0


@pytest.mark.slow
def test_nerfstudio_trains_resumes_evaluates_and_renders_across_the_stages(tmp_path):
    capture = make_capture("carpatch", views=24, seed=3, camera=default_camera("carpatch", 80))
    write_capture(tmp_path / "capture", capture, render=True)
    write_variant(tmp_path / "exact", tmp_path / "capture", "exact", KroncConfig(), capture.car.keypoints)
    options = ["--pipeline.model.coarse-iterations", "150", "--pipeline.model.growth-steps", "60", "120"]
    options += ["--pipeline.model.coarse-voxels", "13824", "--pipeline.model.fine-voxels", "64000"]
    commands, checkpoints = InProcess(), None
    for iterations in (140, 40, 220):  # within the coarse stage, across its end, and to the end of growth
        resume = [] if checkpoints is None else ["--load-dir", str(checkpoints)]
        steps = ["--max-num-iterations", str(iterations)]
        name = tmp_path / f"runs_{iterations}"
        config = train(tmp_path / "exact", "kronc-dvgo-cpu", name, [*options, *steps, *resume], commands=commands)
        checkpoints = config.parent / "nerfstudio_models"
    assert [path.stem for path in checkpoints.glob("*.ckpt")] == ["step-000000399"]
    assert evaluate(config)["psnr"] > 20
    output = tmp_path / "orbit.mp4"
    arguments = ["--load-config", str(config), "--output-path", str(output)]
    commands.run("ns-render", "interpolate", *arguments, "--interpolation-steps", "2", "--downscale-factor", "2")
    assert output.stat().st_size > 1000
