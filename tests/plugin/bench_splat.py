"""Seconds for an image and its gradients: the CPU rasteriser beside gsplat's pure-torch reference.

python -m tests.plugin.bench_splat [--gaussians 10000] [--edge 200] [--repeats 5]
"""

import argparse
import statistics
import time

import torch

from kronc_ns.plugin.splat_cpu.rendering import rasterization

from . import splat_reference


def seconds(render, gaussians: int, edge: int) -> tuple[float, float]:
    """Seconds forward and backward for a ball of Gaussians of a few pixels that half fills the image."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    tensors = [draw(gaussians, 3) * 0.4, draw(gaussians, 4), (draw(gaussians, 3) * 0.4 - 4.0).exp()]
    tensors += [(2 * draw(gaussians)).sigmoid(), draw(gaussians, 16, 3) * 0.4]
    viewmats = torch.eye(4)[None].clone()
    viewmats[:, 2, 3] = 3.0
    intrinsics = torch.tensor([[[1.1 * edge, 0, edge / 2], [0, 1.1 * edge, edge / 2], [0, 0, 1.0]]])
    for tensor in tensors:
        tensor.requires_grad_()
    begin = time.perf_counter()
    image, alphas, _ = render(*tensors, viewmats, intrinsics, edge, edge, sh_degree=3)
    middle = time.perf_counter()
    (image.square().sum() + alphas.sum()).backward()
    return middle - begin, time.perf_counter() - middle


def main() -> None:
    """Print both, and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gaussians", type=int, default=10_000)
    parser.add_argument("--edge", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    first = sum(seconds(rasterization, options.gaussians, options.edge))
    print(f"{torch.get_num_threads()} threads; first call, with loading or compiling, {first:.1f} s")
    totals = []
    for name, render, repeats in (
        ("ours", rasterization, 4 * options.repeats),
        ("gsplat's reference", splat_reference.rasterization, options.repeats),
    ):
        runs = [seconds(render, options.gaussians, options.edge) for _ in range(repeats)]
        forward, backward = (statistics.median(parts) for parts in zip(*runs, strict=True))
        totals.append(forward + backward)
        print(f"{name:20s} forward {forward * 1e3:8.1f} ms, backward {backward * 1e3:8.1f} ms (median of {repeats})")
    print(f"ratio {totals[1] / totals[0]:.0f}")


if __name__ == "__main__":
    main()
