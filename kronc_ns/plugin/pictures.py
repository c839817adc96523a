"""What nerfstudio shows and measures of a picture that a field of ours rendered."""

from typing import Any

import torch
from jaxtyping import Float
from nerfstudio.utils import colormaps
from torch import Tensor


def compare(
    truth: Float[Tensor, "h w 3"], outputs: dict[str, Tensor], measures: dict[str, Any]
) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Each measure of the rendering; truth beside it, accumulation and depth as pictures."""
    images = {
        "img": torch.cat([truth, outputs["rgb"]], dim=1),
        "accumulation": colormaps.apply_colormap(outputs["accumulation"]),
        "depth": colormaps.apply_depth_colormap(outputs["depth"], accumulation=outputs["accumulation"]),
    }
    expected, rendered = (x.movedim(-1, 0)[None] for x in (truth, outputs["rgb"]))
    return {name: float(measure(rendered, expected)) for name, measure in measures.items()}, images
