"""`rasterization`: gsplat's call for splatfacto, on the CPU."""

from typing import Any, Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from kronc_ns.plugin.splat_cpu.harmonics import harmonic_colors
from kronc_ns.plugin.splat_cpu.projection import covariances, project
from kronc_ns.plugin.splat_cpu.rasterize import rasterize_to_pixels
from kronc_ns.plugin.splat_cpu.tiles import TILE, tile_lists

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]


def rasterization(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"] | None,
    scales: Float[Tensor, "n 3"] | None,
    opacities: Float[Tensor, " n"],
    colors: Float[Tensor, "..."],
    viewmats: Float[Tensor, "c 4 4"],
    Ks: Float[Tensor, "c 3 3"],  # gsplat's name
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = False,
    backgrounds: Float[Tensor, "c d"] | None = None,
    render_mode: RenderMode | str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    covars: Float[Tensor, "n 3 3"] | None = None,
) -> tuple[Float[Tensor, "c h w x"], Float[Tensor, "c h w 1"], dict[str, Any]]:
    """Render 3D Gaussians (Kerbl et al. 2023) with the arguments and results of ``gsplat.rendering.rasterization``.

    ``colors`` are [(c) n d], or spherical harmonics [(c) n k 3] when ``sh_degree`` is given; ``viewmats`` w2c,
    OpenCV axes; ``Ks`` in px. Returns colours, alphas and gsplat's dictionary of intermediate results without
    ``isect_ids``. Sparse gradients, packed results, several machines and cameras other than pinholes are gsplat's
    alone; one tile holds any number of channels.
    """
    if packed or sparse_grad:
        raise ValueError("packed results and sparse gradients need CUDA: expected packed=False, sparse_grad=False")
    if render_mode not in get_args(RenderMode):
        raise ValueError(f"render_mode is {render_mode!r}: expected one of {', '.join(get_args(RenderMode))}")
    cameras, count = len(viewmats), len(means)
    if covars is None:
        if quats is None or scales is None:
            raise ValueError("the Gaussians have no shape: expected quats and scales, or covars")
        covars = covariances(quats, scales)
    radii, means2d, depths, conics, compensations = project(
        means, covars, viewmats, Ks, width, height, eps2d, near_plane, far_plane, radius_clip
    )
    opacities = opacities.expand(cameras, count)
    if rasterize_mode == "antialiased":
        opacities = opacities * compensations
    if sh_degree is None:
        colors = colors.expand(cameras, count, -1)
    else:
        eyes = -(viewmats[:, :3, :3].transpose(1, 2) @ viewmats[:, :3, 3:])[..., 0]
        colors = harmonic_colors(sh_degree, means - eyes[:, None], colors)
    if render_mode in ("D", "ED"):
        colors = depths[..., None]
        backgrounds = None
    elif render_mode in ("RGB+D", "RGB+ED"):
        colors = torch.cat([colors, depths[..., None]], dim=-1)
        if backgrounds is not None:
            backgrounds = torch.cat([backgrounds, backgrounds.new_zeros(cameras, 1)], dim=-1)

    tiles = tile_lists(means2d, radii, depths, width, height)
    render, alphas = rasterize_to_pixels(means2d, conics, colors, opacities, tiles, width, height, backgrounds, absgrad)
    if render_mode in ("ED", "RGB+ED"):
        render = torch.cat([render[..., :-1], render[..., -1:] / alphas.clamp(min=1e-10)], dim=-1)
    info = {
        "camera_ids": None,
        "gaussian_ids": None,
        "radii": radii,
        "means2d": means2d,
        "depths": depths,
        "conics": conics,
        "opacities": opacities,
        "tile_width": tiles.across,
        "tile_height": -(-height // TILE),
        "flatten_ids": torch.from_numpy(tiles.gaussians),
        "isect_offsets": torch.from_numpy(tiles.offsets[:-1]).reshape(cameras, -1, tiles.across),
        "width": width,
        "height": height,
        "tile_size": TILE,
        "n_cameras": cameras,
    }
    return render, alphas, info
