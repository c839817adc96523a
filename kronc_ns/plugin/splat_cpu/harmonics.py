"""Colours that depend on the viewing direction."""

import torch
from jaxtyping import Float
from torch import Tensor

MAX_DEGREE = 4


def harmonic_basis(degree: int, directions: Float[Tensor, "... 3"]) -> Float[Tensor, "... k"]:
    """Real spherical harmonics up to ``degree`` at unit ``directions``, k = (degree + 1)^2.

    In the order and with the signs of 3D Gaussian Splatting and gsplat: bands one after the other, m from -l to l,
    Condon-Shortley phase included (Sloan, "Stupid Spherical Harmonics Tricks", 2008, appendix A2).
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"degree of the spherical harmonics is {degree}: expected 0 to {MAX_DEGREE}")
    x, y, z = directions.unbind(-1)
    basis: list[Tensor] = [torch.full_like(x, 0.28209479177387814)]
    if degree >= 1:
        basis += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        # cos and sin of m times the azimuth, times sin(polar angle)^m
        zz, cos_2, sin_2 = z * z, x * x - y * y, 2 * x * y
        basis += [
            0.5462742152960396 * sin_2,
            -1.0925484305920792 * y * z,
            0.9461746957575601 * zz - 0.31539156525252005,
        ]
        basis += [-1.0925484305920792 * x * z, 0.5462742152960396 * cos_2]
    if degree >= 3:
        cos_3, sin_3 = x * cos_2 - y * sin_2, x * sin_2 + y * cos_2
        first = -2.285228997322329 * zz + 0.4570457994644658
        basis += [-0.5900435899266435 * sin_3, 1.445305721320277 * z * sin_2, first * y]
        basis += [z * (1.865881662950577 * zz - 1.1195289977703462)]
        basis += [first * x, 1.445305721320277 * z * cos_2, -0.5900435899266435 * cos_3]
    if degree >= 4:
        cos_4, sin_4 = x * cos_3 - y * sin_3, x * sin_3 + y * cos_3
        first, second = z * (-4.683325804901025 * zz + 2.007139630671868), 3.31161143515146 * zz - 0.47308734787878004
        basis += [0.6258357354491761 * sin_4, -1.7701307697799304 * z * sin_3, second * sin_2, first * y]
        basis += [3.7024941420321507 * torch.square(zz) - 3.1735664074561294 * zz + 0.31735664074561293]
        basis += [first * x, second * cos_2, -1.7701307697799304 * z * cos_3, 0.6258357354491761 * cos_4]
    return torch.stack(basis, dim=-1)


def harmonic_colors(
    degree: int, directions: Float[Tensor, "c n 3"], coefficients: Float[Tensor, "*c n k 3"]
) -> Float[Tensor, "c n 3"]:
    """Colours seen along ``directions`` (any length), raised by a half and cut at zero as in Kerbl et al. 2023."""
    basis = harmonic_basis(degree, torch.nn.functional.normalize(directions, dim=-1))
    return ((basis[..., None] * coefficients[..., : basis.shape[-1], :]).sum(-2) + 0.5).clamp(min=0.0)
