"""gsplat's own pure-torch rasteriser, completed by the two functions for which it needs CUDA and nerfacc."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from unittest import mock

import torch
from gsplat.cuda import _torch_impl, _wrapper
from torch import Tensor

ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN = 1 / 255, 0.999, 1e-4


def alphas_at(x, y, means2d, conics, opacities) -> Tensor:
    """Alpha of Gaussians at pixels, 0 where gsplat skips it; everything broadcasts."""
    dx, dy = means2d[..., 0] - x - 0.5, means2d[..., 1] - y - 0.5
    sigma = 0.5 * (conics[..., 0] * dx**2 + conics[..., 2] * dy**2) + conics[..., 1] * dx * dy
    alpha = (opacities * torch.exp(-sigma)).clamp(max=ALPHA_MAX)
    return torch.where((sigma < 0) | (alpha < ALPHA_MIN), 0.0, alpha)


def rasterize_to_indices_in_range(
    start, end, transmittances, means2d, conics, opacities, width, height, tile_size, offsets, flatten_ids
) -> tuple[Tensor, Tensor, Tensor]:
    """Which Gaussian contributes to which pixel of which camera, pixel by pixel, front to back; slow and plain."""
    cameras, down, across = offsets.shape
    count, block = means2d.shape[1], tile_size**2
    ends = [*offsets.flatten().tolist(), len(flatten_ids)]
    found = []
    for tile in range(cameras * down * across):
        camera, row, column = tile // (down * across), tile // across % down, tile % across
        first, last = (min(ends[tile] + step * block, ends[tile + 1]) for step in (start, end))
        ids = flatten_ids[first:last].long() - camera * count
        y, x = torch.meshgrid(
            torch.arange(row * tile_size, min((row + 1) * tile_size, height)),
            torch.arange(column * tile_size, min((column + 1) * tile_size, width)),
            indexing="ij",
        )
        y, x = y.reshape(-1, 1), x.reshape(-1, 1)
        alpha = alphas_at(x, y, means2d[camera, ids], conics[camera, ids], opacities[camera, ids])
        after = transmittances[camera, y, x] * torch.cumprod(1 - alpha, dim=1)
        pixel, which = ((alpha > 0) & (after > TRANSMITTANCE_MIN)).nonzero(as_tuple=True)
        found.append((ids[which], (y * width + x)[pixel, 0], torch.full_like(which, camera)))
    gaussians, pixels, camera_ids = (torch.cat(parts) for parts in zip(*found, strict=True))
    return gaussians, pixels, camera_ids


def accumulate(
    means2d, conics, opacities, colors, gaussian_ids, pixel_ids, camera_ids, width, height
) -> tuple[Tensor, Tensor]:
    """Alpha compositing of those pairs in plain torch, differentiable by autograd."""
    cameras, channels = len(means2d), colors.shape[-1]
    picked = (camera_ids, gaussian_ids)
    alpha = alphas_at(pixel_ids % width, pixel_ids // width, means2d[picked], conics[picked], opacities[picked])
    rays = camera_ids * width * height + pixel_ids
    # transmittance before each pair: running sum of log(1 - alpha), less its value where the pixel's run begins
    logs = torch.log1p(-alpha.double())
    before = torch.cumsum(logs, 0) - logs
    begins = torch.ones_like(rays, dtype=torch.bool)
    begins[1:] = rays[1:] != rays[:-1]
    begin = torch.where(begins, torch.arange(len(rays)), 0).cummax(0).values
    weight = (alpha * torch.exp(before - before[begin])).to(colors.dtype)[:, None]
    shape = (cameras, height, width)
    summed = torch.zeros(math.prod(shape), channels + 1).index_add(
        0, rays, torch.cat([weight * colors[picked], weight], dim=-1)
    )
    return summed[:, :-1].reshape(*shape, channels), summed[:, -1:].reshape(*shape, 1)


@contextmanager
def completed() -> Iterator[None]:
    """gsplat with the two pieces in place."""
    with (
        mock.patch.object(_wrapper, "rasterize_to_indices_in_range", rasterize_to_indices_in_range),
        mock.patch.object(_torch_impl, "accumulate", accumulate),
    ):
        yield


def rasterization(
    means, quats, scales, opacities, colors, viewmats, intrinsics, width, height, *,
    sh_degree=None, backgrounds=None, render_mode="RGB", rasterize_mode="classic",
):  # fmt: skip
    """What `gsplat.rendering.rasterization` computes, from gsplat's torch functions alone."""
    covars, _ = _torch_impl._quat_scale_to_covar_preci(quats, scales, True, False)
    radii, means2d, depths, conics, compensations = _torch_impl._fully_fused_projection(
        means, covars, viewmats, intrinsics, width, height, calc_compensations=rasterize_mode == "antialiased"
    )
    cameras = len(viewmats)
    opacities = opacities.expand(cameras, -1)
    if compensations is not None:
        opacities = opacities * compensations
    if sh_degree is None:
        colors = colors.expand(cameras, -1, -1)
    else:
        directions = means - torch.inverse(viewmats)[:, None, :3, 3]
        colors = _torch_impl._spherical_harmonics(sh_degree, directions, colors.expand(cameras, -1, -1, -1))
        colors = (colors + 0.5).clamp(min=0)
    if "D" in render_mode:
        colors = torch.cat([colors, depths[..., None]], dim=-1)
        backgrounds = None if backgrounds is None else torch.cat([backgrounds, torch.zeros(cameras, 1)], dim=-1)
    across, down = math.ceil(width / 16), math.ceil(height / 16)
    _, keys, ids = _torch_impl._isect_tiles(means2d, radii, depths, 16, across, down)
    offsets = _torch_impl._isect_offset_encode(keys, cameras, across, down)
    with completed():
        render, alphas = _torch_impl._rasterize_to_pixels(
            means2d, conics, colors, opacities, width, height, 16, offsets, ids, backgrounds
        )
    if render_mode.endswith("ED"):
        render = torch.cat([render[..., :-1], render[..., -1:] / alphas.clamp(min=1e-10)], dim=-1)
    return render, alphas, means2d
