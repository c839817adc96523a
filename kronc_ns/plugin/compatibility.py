"""What nerfstudio 1.1.5 needs on current torch and without internet; applied where the plugin registers.

Both mends are as narrow as they can be and leave everything alone where they are not needed.
"""

import functools
import warnings
from typing import Any

import numpy as np
import torch
from torch import Tensor


def allow_numpy_in_checkpoints() -> None:
    """Let ``torch.load(weights_only=True)`` read the NumPy scalars that nerfstudio's checkpoints hold.

    nerfstudio 1.1.5 does not say ``weights_only=False`` (its issue 3683), which is the default since torch 2.6; the
    learning rates its schedulers save are NumPy floats. Nothing but these types is allowed.
    """
    if torch.__version__ < "2.6":  # loads everything
        return
    multiarray = np.core.multiarray if np.__version__ < "2" else np._core.multiarray  # pyright: ignore[reportAttributeAccessIssue]
    names = ("numpy.core.multiarray.scalar", "numpy._core.multiarray.scalar")
    float_types = [type(np.dtype(kind)) for kind in (np.float64, np.float32, np.int64)]
    torch.serialization.add_safe_globals([np.dtype, *float_types, *((multiarray.scalar, name) for name in names)])


def lpips_remedy() -> str:
    """Which weights LPIPS needs and where it looks for them."""
    return f"put torchvision's alexnet-owt-7be5be79.pth into {torch.hub.get_dir()}/checkpoints to have it"


class UnavailableLpips(torch.nn.Module):
    """Stands where LPIPS cannot be computed for want of weights: every value is NaN, never a number."""

    def forward(self, *_: Tensor) -> Tensor:
        """NaN."""
        return torch.tensor(float("nan"))


def train_without_lpips_weights() -> None:
    """Make nerfstudio's models build where LPIPS's weights are neither on disk nor to be had.

    All of them create ``torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity``, which downloads AlexNet, when
    they are built; without internet ``ns-train`` dies there. With weights nothing changes.
    """
    from torchmetrics.image import lpip

    genuine = lpip.LearnedPerceptualImagePatchSimilarity

    @functools.wraps(genuine, updated=())
    def build(*args: Any, **kwargs: Any) -> torch.nn.Module:
        try:
            return genuine(*args, **kwargs)
        except OSError as error:
            warnings.warn(
                f"LPIPS is unavailable and reported as nan: its weights cannot be loaded ({error}); {lpips_remedy()}",
                stacklevel=2,
            )
            return UnavailableLpips()

    if getattr(genuine, "__wrapped__", None) is None:
        lpip.LearnedPerceptualImagePatchSimilarity = build  # pyright: ignore[reportAttributeAccessIssue]
