"""Colour and opacity of renderings, as nerfstudio's exporters ask for them."""

from typing import Literal

import torch
from jaxtyping import Float
from nerfstudio.model_components.renderers import RGBRenderer
from torch import Tensor


def rgba(
    rgb: Float[Tensor, "*n 3"],
    accumulation: Float[Tensor, "*n 1"],
    background: Float[Tensor, "*n 3"] | Literal["random", "black", "white"],
) -> Float[Tensor, "*n 4"]:
    """What was rendered before a ``background`` of one colour, without it; alpha is the ``accumulation``.

    nerfstudio calls every ray before such a background opaque. Its point clouds and Poisson meshes leave out what is
    less than half opaque: rays past the car would all end in points of the background's colour.
    """
    if isinstance(background, str):
        if background == "random":  # which is laid under a rendering in training only
            background = torch.zeros_like(rgb)
        else:
            background = RGBRenderer.get_background_color(background, rgb.shape, rgb.device)
    own = (rgb - (1 - accumulation) * background) / accumulation.clamp(min=1e-6)
    return torch.cat([own.clamp(0, 1), accumulation], dim=-1)
