"""The CPU rasteriser against gsplat's reference, finite differences and its own definition; splatfacto on top."""

import pytest
import torch
from torch import Tensor

pytest.importorskip("nerfstudio")

from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.models import splatfacto

from kronc_ns.benchmark.training import train, write_variant
from kronc_ns.files.presets import load_config
from kronc_ns.plugin.compatibility import allow_numpy_in_checkpoints, train_without_lpips_weights
from kronc_ns.plugin.dataparser import KroncDataParserConfig
from kronc_ns.plugin.splat_cpu import kernels
from kronc_ns.plugin.splat_cpu.harmonics import harmonic_colors
from kronc_ns.plugin.splat_cpu.model import SplatfactoCpuModelConfig
from kronc_ns.plugin.splat_cpu.rasterize import rasterize_to_pixels
from kronc_ns.plugin.splat_cpu.rendering import rasterization
from kronc_ns.plugin.splat_cpu.tiles import tile_lists
from kronc_ns.synthetic.folder import write_capture
from kronc_ns.synthetic.scenes import default_camera, make_capture
from tests.plugin.commands import InProcess, add_half_size, evaluate

from . import splat_reference

pytestmark = pytest.mark.nerfstudio
WIDTH, HEIGHT = 50, 37  # not whole tiles
METHOD, HALF = "kronc-splatfacto-cpu", ["--downscale-factor", "2"]
NAMES = ("means", "quats", "scales", "opacities", "colors", "backgrounds")


def random_scene(count: int, cameras: int = 1, size: float = -2.5, bands: int | None = 4, seed: int = 0):
    """Gaussians about the origin, some outside the image, some opaque; cameras side by side; random backgrounds."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    colors = draw(count, bands**2, 3) * 0.4 if bands else draw(count, 3).sigmoid()
    tensors = [draw(count, 3) * 0.6, draw(count, 4), (draw(count, 3) * 0.5 + size).exp(), (2 * draw(count)).sigmoid()]
    tensors += [colors, draw(cameras, 3).sigmoid()]
    viewmats = torch.eye(4).repeat(cameras, 1, 1)
    viewmats[:, 0, 3], viewmats[:, 2, 3] = 0.2 * torch.arange(cameras), 3.0
    focal = 1.1 * WIDTH
    intrinsics = torch.tensor([[focal, 0, WIDTH / 2], [0, 0.8 * focal, HEIGHT / 2], [0, 0, 1.0]]).repeat(cameras, 1, 1)
    return tensors, (viewmats, intrinsics, WIDTH, HEIGHT)


@pytest.fixture
def two_threads():
    """Between which the tiles are shared out."""
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(1)


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize(
    ("count", "size", "bands", "cameras", "options"),
    [
        (300, -2.5, 4, 2, {"sh_degree": 3}),
        (1500, -2.0, 2, 1, {"sh_degree": 0, "render_mode": "RGB+D"}),  # nearly all pixels fill up
        (500, -3.5, None, 3, {"render_mode": "RGB+ED", "rasterize_mode": "antialiased"}),
    ],
)
def test_images_and_gradients_are_those_of_gsplats_reference(count, size, bands, cameras, options):
    results = []
    for render in (rasterization, splat_reference.rasterization):
        tensors, view = random_scene(count, cameras, size, bands)
        *shapes, backgrounds = (t.requires_grad_() for t in tensors)
        image, alphas, info = render(*shapes, *view, backgrounds=backgrounds, **options)
        generator = torch.Generator().manual_seed(1)
        loss = (image * torch.randn(image.shape, generator=generator)).sum()
        loss = loss + (alphas * torch.randn(alphas.shape, generator=generator)).sum()
        means2d = info["means2d"] if isinstance(info, dict) else info
        means2d.retain_grad()
        loss.backward()
        results.append((image, alphas, [means2d.grad, *(t.grad for t in tensors)]))
    (image, alphas, gradients), (image_0, alphas_0, gradients_0) = results
    assert 0.1 < alphas_0.mean() < 0.999
    torch.testing.assert_close(image, image_0, atol=1e-4, rtol=1e-5)
    torch.testing.assert_close(alphas, alphas_0, atol=1e-4, rtol=0)
    for name, ours, theirs in zip(("means2d", *NAMES), gradients, gradients_0, strict=True):
        assert theirs.norm() > 0, name
        assert (ours - theirs).norm() < 1e-4 * theirs.norm(), name


def flat_scene(count: int = 5, dtype: torch.dtype = torch.float32):
    """A few overlapping Gaussians on a small image, one of them clamped at the largest alpha."""
    generator = torch.Generator().manual_seed(4)
    means2d = torch.rand(1, count, 2, dtype=dtype, generator=generator) * 6 + 1
    factor = torch.randn(1, count, 2, 2, dtype=dtype, generator=generator)
    covar = factor @ factor.transpose(-1, -2) + 2 * torch.eye(2, dtype=dtype)
    inverse = torch.linalg.inv(covar)
    conics = torch.stack([inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 1, 1]], dim=-1)
    opacities = torch.linspace(0.3, 1.0, count, dtype=dtype)[None]
    colors = torch.rand(1, count, 2, dtype=dtype, generator=generator)
    tiles = tile_lists(means2d, torch.full((1, count), 20), torch.arange(count)[None].float(), 9, 8)
    return [means2d, conics, colors, opacities], tiles, torch.rand(1, 2, dtype=dtype, generator=generator)


def test_gradients_are_those_of_finite_differences(monkeypatch):
    """In double precision, for which nothing is compiled: the same loops run as Python."""
    for name in ("_falloff", "_rows", "_workspace", "_any_open", "_composite_tile", "_differentiate_tile"):
        monkeypatch.setattr(kernels, name, getattr(kernels, name).py_func)
    for name in ("rasterize_forward", "rasterize_backward", "sum_over_tiles"):
        monkeypatch.setattr(kernels, name, getattr(kernels, name).py_func)
    tensors, tiles, background = flat_scene(3, torch.float64)
    weights = torch.randn(1, 8, 9, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))

    def loss(means2d, conics, colors, opacities, background):
        image = rasterize_to_pixels(means2d, conics, colors, opacities, tiles, 9, 8, background)
        return (torch.cat(image, dim=-1) * weights).sum()

    inputs = [t.requires_grad_() for t in (*tensors, background)]
    assert torch.autograd.gradcheck(loss, inputs, eps=1e-5, atol=1e-5, rtol=1e-4)


def test_absolute_gradients_are_summed_over_pixels():
    tensors, tiles, background = flat_scene()
    means2d = tensors[0].requires_grad_()
    image, _ = rasterize_to_pixels(*tensors, tiles, 9, 8, background, absgrad=True)
    pixels = (image**2).sum(-1).flatten()
    expected = sum(torch.autograd.grad(pixel, means2d, retain_graph=True)[0].abs() for pixel in pixels)
    pixels.sum().backward()
    torch.testing.assert_close(means2d.absgrad, expected)
    assert (means2d.absgrad >= means2d.grad.abs()).all()


@pytest.mark.parametrize("degree", range(5))
def test_harmonics_are_gsplats(degree):
    from gsplat.cuda._torch_impl import _spherical_harmonics

    generator = torch.Generator().manual_seed(0)
    directions, coefficients = torch.randn(2, 40, 3, generator=generator), torch.randn(40, 25, 3, generator=generator)
    expected = (_spherical_harmonics(degree, directions, coefficients.expand(2, -1, -1, -1)) + 0.5).clamp(min=0)
    torch.testing.assert_close(harmonic_colors(degree, directions, coefficients), expected, atol=1e-5, rtol=1e-5)


def test_covariances_stand_for_quaternions_and_scales():
    tensors, view = random_scene(100, bands=None)
    means, quats, scales, opacities, colors, _ = tensors
    rotation = splatfacto.quat_to_rotmat(torch.nn.functional.normalize(quats, dim=-1))
    covars = rotation @ torch.diag_embed(scales**2) @ rotation.transpose(1, 2)
    image, *_ = rasterization(means, None, None, opacities, colors, *view, covars=covars)
    expected, *_ = rasterization(means, quats, scales, opacities, colors, *view)
    torch.testing.assert_close(image, expected, atol=1e-4, rtol=0)


def test_depths_are_expected_depths():
    tensors, view = random_scene(200, bands=None)
    image, _, info = rasterization(*tensors[:-1], *view, render_mode="RGB+ED")
    both, alphas, _ = rasterization(*tensors[:-1], *view, render_mode="ED", backgrounds=tensors[-1])
    torch.testing.assert_close(both, image[..., 3:])
    seen = info["depths"][info["radii"] > 0]
    assert (both[alphas > 0.1] > seen.min()).all()
    assert (both[alphas > 0.1] < seen.max()).all()


def test_unseen_and_broken_gaussians_leave_the_others_alone():
    tensors, view = random_scene(60, bands=None)
    expected, *_ = rasterization(*tensors[:-1], *view)
    strays = [torch.cat([t, t[:4]]) for t in tensors[:-1]]
    strays[0][60], strays[0][61] = torch.tensor([0.0, 0.0, -3.0]), torch.tensor([0.0, 0.0, -9.0])  # at and behind
    strays[0][62], strays[2][63] = torch.nan, torch.nan
    for t in strays:
        t.requires_grad_()
    image, _, info = rasterization(*strays, *view, absgrad=True)
    assert (info["radii"][0, 60:] == 0).all()
    torch.testing.assert_close(image, expected)
    image.sum().backward()
    assert all(t.grad[:62].isfinite().all() for t in strays)


def test_a_scene_that_lost_all_its_gaussians_still_trains_its_background():
    tensors, tiles, background = flat_scene(0)
    inputs = [t.requires_grad_() for t in (*tensors, background)]
    image, _ = rasterize_to_pixels(*inputs[:-1], tiles, 9, 8, inputs[-1], absgrad=True)
    image.sum().backward()
    assert (inputs[-1].grad == 9 * 8).all()
    assert inputs[0].grad.shape == inputs[0].absgrad.shape == (1, 0, 2)


def test_an_empty_view_is_background():
    tensors, view = random_scene(5, bands=None)
    tensors[0][:, 2] = -10
    for t in tensors:
        t.requires_grad_()
    image, alphas, _ = rasterization(*tensors[:-1], *view, backgrounds=tensors[-1])
    assert (image == tensors[-1]).all()
    assert (alphas == 0).all()
    image.sum().backward()
    assert (tensors[-1].grad == WIDTH * HEIGHT).all()
    assert (tensors[0].grad == 0).all()


@pytest.mark.parametrize("wrong", [{"packed": True}, {"render_mode": "BGR"}, {"quats": None}])
def test_what_is_not_offered_is_refused(wrong):
    tensors, view = random_scene(5, bands=None)
    arguments = dict(zip(NAMES[:-1], tensors[:-1], strict=True)) | wrong
    with pytest.raises(ValueError, match="expected"):
        rasterization(**arguments, viewmats=view[0], Ks=view[1], width=WIDTH, height=HEIGHT)


@pytest.fixture
def model():
    """Splatfacto on the CPU with 200 coloured seed points, as nerfstudio sets it up."""
    train_without_lpips_weights()
    generator = torch.Generator().manual_seed(0)
    seeds = torch.randn(200, 3, generator=generator) * 0.3, torch.randint(0, 256, (200, 3), generator=generator)
    config = SplatfactoCpuModelConfig(background_color="white", num_downscales=0, warmup_length=0, refine_every=2)
    return config.setup(scene_box=SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])), num_train_data=1, seed_points=seeds)


@pytest.fixture
def camera() -> Cameras:
    c2w = torch.eye(4)[None, :3].clone()
    c2w[0, 2, 3] = 3.0
    return Cameras(c2w, fx=40.0, fy=40.0, cx=16.0, cy=12.0, width=32, height=24)


def test_splatfacto_trains_and_densifies_on_the_cpu(model, camera):
    original = splatfacto.rasterization
    torch.testing.assert_close(model.colors, model.seed_points[1] / 255)
    model.train()
    optimizers = {name: torch.optim.Adam(ps, lr=0.02) for name, ps in model.get_gaussian_param_groups().items()}
    model.optimizers = optimizers
    model.strategy.grow_grad2d, model.strategy.pause_refine_after_reset = 1e-3, 0
    target = {"image": torch.rand(24, 32, 3, generator=torch.Generator().manual_seed(1))}
    losses, counts = [], []
    for step in range(1, 12):
        model.step = step
        outputs = model.get_outputs(camera)
        loss = model.get_loss_dict(outputs, target)["main_loss"]
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        model.step_post_backward(step)
        losses.append(loss.item())
        counts.append(model.num_points)
    assert losses[-1] < losses[0]
    assert counts[-1] != counts[0]
    assert splatfacto.rasterization is original
    model.eval()
    outputs = model.get_outputs_for_camera(camera)
    assert outputs["rgb"].shape == (24, 32, 3)
    assert outputs["depth"].isfinite().all()


def test_random_starts_need_no_seed_points(camera):
    train_without_lpips_weights()
    config = SplatfactoCpuModelConfig(random_init=True, num_random=100, random_scale=1.0)
    model = config.setup(scene_box=SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3])), num_train_data=1)
    model.eval()
    assert model.get_outputs_for_camera(camera)["accumulation"].max() > 0


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A short training on a rendered walk that densifies, half of it at half size; its config and its data."""
    root = tmp_path_factory.mktemp("splat")
    capture = make_capture("walk", views=24, seed=3, camera=default_camera("walk", 256))
    write_capture(root / "capture", capture, render=True)
    add_half_size(root / "capture")
    write_variant(root / "exact", root / "capture", "exact", load_config("phone_walk"), capture.car.keypoints)
    settings = {"warmup-length": 100, "resolution-schedule": 200, "stop-split-at": 300, "sh-degree-interval": 100}
    options = [text for name, value in settings.items() for text in (f"--pipeline.model.{name}", str(value))]
    options += ["--max-num-iterations", "400"]
    return train(root / "exact", METHOD, root / "runs", options, HALF, InProcess()), root / "exact"


@pytest.mark.slow
def test_training_without_cuda_densifies_and_renders_the_car(trained, tmp_path):
    config, data = trained
    seeds = KroncDataParserConfig(data=data).setup().get_dataparser_outputs(split="train").metadata["points3D_xyz"]
    allow_numpy_in_checkpoints()
    state = torch.load(config.parent / "nerfstudio_models" / "step-000000399.ckpt")["pipeline"]
    count = len(state["_model.gauss_params.means"])
    assert count != len(seeds)
    assert 500 < count < 20_000
    results = evaluate(config, tmp_path / "renders")
    print(count, results)
    assert results["psnr"] > 22
    assert len(list((tmp_path / "renders").glob("*.png"))) == 3


@pytest.mark.slow
def test_a_training_without_cuda_is_resumed_exported_and_rendered(trained, tmp_path):
    (config, data), commands = trained, InProcess()
    more = ["--load-dir", str(config.parent / "nerfstudio_models"), "--max-num-iterations", "10"]
    resumed = train(data, METHOD, tmp_path, more, HALF, commands)
    assert (resumed.parent / "nerfstudio_models" / "step-000000409.ckpt").exists()
    commands.run("ns-export", "gaussian-splat", "--load-config", str(config), "--output-dir", str(tmp_path / "ply"))
    assert (tmp_path / "ply" / "splat.ply").read_bytes().startswith(b"ply")
    frame = ["--load-config", str(config), "--output-path", str(tmp_path / "frames"), "--output-format", "images"]
    commands.run("ns-render", "interpolate", *frame, "--interpolation-steps", "1", "--downscale-factor", "2")
    assert len(list((tmp_path / "frames").rglob("*.jpg"))) > 1
