"""Gaussians on the image plane to pixels, with gradients."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from kronc_ns.plugin.splat_cpu.tiles import TileLists

_SHARES = 4  # per thread: a thread that something else on the machine holds up leaves work to the others


class RasterizeToPixels(torch.autograd.Function):
    """Alpha compositing of 2D Gaussians, differentiable in everything but the lists of tiles."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Float[Tensor, "c n 2"],
        conics: Float[Tensor, "c n 3"],
        colors: Float[Tensor, "c n d"],
        opacities: Float[Tensor, "c n"],
        backgrounds: Float[Tensor, "c d"],
        tiles: TileLists,
        width: int,
        height: int,
        absgrad: bool,
    ) -> tuple[Float[Tensor, "c h w d"], Float[Tensor, "c h w 1"]]:
        """The colours, background included, and the accumulated alphas; ``absgrad``: see `rasterize_to_pixels`."""
        from kronc_ns.plugin.splat_cpu import kernels

        inputs = [_array(t.flatten(0, 1)) for t in (means2d, conics, colors, opacities)]
        cameras, _, channels = colors.shape
        render = np.empty((cameras, height, width, channels), inputs[0].dtype)
        transmittance = np.empty((cameras, height, width), inputs[0].dtype)
        lists = (tiles.gaussians, tiles.offsets, tiles.across)
        _over_tiles(kernels.rasterize_forward, tiles, *inputs, _array(backgrounds), *lists, render, transmittance)
        ctx.save_for_backward(means2d)
        ctx.kept = (inputs, tiles, render, transmittance, absgrad)
        return torch.from_numpy(render), torch.from_numpy(1 - transmittance[..., None])

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of the five tensors."""
        from kronc_ns.plugin.splat_cpu import kernels

        (means2d,) = ctx.saved_tensors
        inputs, tiles, render, transmittance, absgrad = ctx.kept
        v_render = gradients[0].contiguous().numpy()
        v_alpha = gradients[1][..., 0].contiguous().numpy()
        v_pairs = np.zeros((len(tiles.gaussians), 8 + render.shape[-1]), render.dtype)
        v_gaussians = np.zeros((len(tiles.order), 8 + render.shape[-1]), render.dtype)
        lists = (tiles.gaussians, tiles.offsets, tiles.numbers, tiles.across)
        images = (render, transmittance, v_render, v_alpha)
        _over_tiles(kernels.rasterize_backward, tiles, *inputs, *lists, *images, v_pairs)
        kernels.sum_over_tiles(v_pairs, tiles.starts, tiles.order, v_gaussians)
        v = torch.from_numpy(v_gaussians).reshape(*means2d.shape[:2], 8 + render.shape[-1])
        if absgrad:
            means2d.absgrad = v[..., 2:4]
        v_backgrounds = np.einsum("chw,chwd->cd", transmittance, v_render)
        return (
            v[..., 0:2],
            v[..., 4:7],
            v[..., 8:],
            v[..., 7],
            torch.from_numpy(v_backgrounds),
            *(None,) * 4,
        )


def rasterize_to_pixels(
    means2d: Float[Tensor, "c n 2"],
    conics: Float[Tensor, "c n 3"],
    colors: Float[Tensor, "c n d"],
    opacities: Float[Tensor, "c n"],
    tiles: TileLists,
    width: int,
    height: int,
    backgrounds: Float[Tensor, "c d"] | None = None,
    absgrad: bool = False,
) -> tuple[Float[Tensor, "c h w d"], Float[Tensor, "c h w 1"]]:
    """Colours and alphas of the pixels (Kerbl et al. 2023, equation 3); ``backgrounds`` None is black.

    With ``absgrad``, backward leaves the sum over pixels of the absolute gradients in ``means2d.absgrad``, as gsplat
    does for its densification (AbsGS).
    """
    if backgrounds is None:
        backgrounds = colors.new_zeros(colors.shape[0], colors.shape[-1])
    return RasterizeToPixels.apply(means2d, conics, colors, opacities, backgrounds, tiles, width, height, absgrad)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def _over_tiles(kernel: Callable[..., None], tiles: TileLists, *arguments: Any) -> None:
    """Run ``kernel`` on all tiles, on as many threads as torch uses."""
    threads = torch.get_num_threads()
    if threads == 1:
        kernel(tiles.shares(1)[0], *arguments)
        return
    # threads of this call only: a pool kept for the next would not survive a fork
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(kernel, share, *arguments) for share in tiles.shares(_SHARES * threads)]:
            done.result()
