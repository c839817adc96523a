"""Positional encoding whose frequencies are switched on from coarse to fine (BARF, section 3.3)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor


def schedule(step: int, begin: int, end: int, frequencies: int) -> float:
    """BARF's alpha at a ``step``: 0 up to ``begin``, rising evenly to all ``frequencies`` from ``end`` on."""
    if step >= end:
        return float(frequencies)
    return frequencies * max(step - begin, 0.0) / (end - begin)


def frequency_weights(alpha: float, frequencies: int) -> Float[Tensor, "l"]:
    """BARF's weights w_k: (1 - cos(pi clamp(alpha - k, 0, 1))) / 2 of the frequency 2^k, k from 0 on."""
    switched_on = (alpha - torch.arange(frequencies)).clamp(0, 1)
    return (1 - torch.cos(math.pi * switched_on)) / 2


def encode(x: Float[Tensor, "*n d"], weights: Float[Tensor, "l"]) -> Float[Tensor, "*n e"]:
    """BARF's gamma(x; alpha): x, w_k sin(2^k pi x) and w_k cos(2^k pi x) for all k, e = d (1 + 2 l)."""
    octaves = math.pi * 2.0 ** torch.arange(len(weights), device=x.device).repeat(2)
    # cosines as sines a quarter of a wave ahead, and all phases by one product of matrices: few passes over memory,
    # there and, above all, back, where points are given a gradient
    quarter = (torch.arange(len(octaves), device=x.device) >= len(weights)) * (math.pi / 2)
    one = torch.eye(x.shape[-1], device=x.device)
    every = torch.kron(octaves[None], one).to(x)
    phase = torch.addmm(quarter.repeat_interleave(x.shape[-1]).to(x), x.reshape(-1, x.shape[-1]), every)
    waves = phase.sin() * weights.repeat(2).repeat_interleave(x.shape[-1])
    return torch.cat([x, waves.reshape(*x.shape[:-1], phase.shape[-1])], dim=-1)


def encoded_size(dimensions: int, frequencies: int) -> int:
    """Length of what `encode` returns."""
    return dimensions * (1 + 2 * frequencies)
