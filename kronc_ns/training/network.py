"""The network: a small ResNet with a light decoder; a probability map, a visibility and a car mask come out.

Plain convolutions, since matrix units of CPUs run those fastest. He et al.: Deep residual learning, CVPR 2016;
Lin et al.: Feature pyramid networks, CVPR 2017.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, UInt8
from torch import Tensor, nn
from torch.nn import functional as F

INPUT_SIZE = (320, 224)
"""(width, height) of what the network sees."""
STRIDE = 4
"""Input pixels per cell of the maps."""
POINTS = 66
_WIDTHS = (48, 96, 192, 320)  # channels at strides 4, 8, 16, 32
_DECODER = 96
_HEAD = 64
_MAPS = 96  # 66 points, the mask and nothing: matrix units want multiples of 32, else this layer takes longest


class Answer(NamedTuple):
    """What the network says of a batch, as logarithms and logits."""

    heat: Float[Tensor, "b 66 h w"]
    """Log probability over the cells: where the point is, if it is visible."""
    visible: Float[Tensor, "b 66"]
    """Logit that the point is visible."""
    mask: Float[Tensor, "b h w"]
    """Logit that a cell shows the main car."""


class _ConvNorm(nn.Sequential):
    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__(nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False), nn.BatchNorm2d(outputs))


class _Block(nn.Module):
    """Two 3x3 convolutions and a shortcut."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.first = _ConvNorm(inputs, outputs, stride=stride)
        self.second = _ConvNorm(outputs, outputs)
        nn.init.zeros_(self.second[1].weight)  # pyright: ignore[reportArgumentType]
        same = inputs == outputs and stride == 1
        self.shortcut = nn.Identity() if same else _ConvNorm(inputs, outputs, 1, stride)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.second(F.relu(self.first(x), inplace=True)) + self.shortcut(x), inplace=True)


class KeypointNetwork(nn.Module):
    """RGB pictures of `INPUT_SIZE` in, maps at `STRIDE` out."""

    def __init__(self) -> None:
        super().__init__()
        a, b, c, d = _WIDTHS
        # one convolution down to stride 4: maps at stride 2 would cost more memory traffic than all others together
        self.stem = nn.Sequential(nn.Conv2d(3, a, 8, 4, 2, bias=False), nn.BatchNorm2d(a), nn.ReLU(inplace=True))
        self.stride4 = _Block(a, a)
        self.stride8 = nn.Sequential(_Block(a, b, 2), _Block(b, b))
        self.stride16 = nn.Sequential(_Block(b, c, 2), _Block(c, c))
        self.stride32 = nn.Sequential(_Block(c, d, 2), _Block(d, d))
        self.context = nn.Linear(d, d)
        self.lateral = nn.ModuleList([nn.Conv2d(n, _DECODER, 1) for n in (d, c, b)])
        self.smooth = nn.ModuleList([_ConvNorm(_DECODER, _DECODER) for _ in range(3)])
        self.to_fine = nn.ModuleList([nn.Conv2d(n, _HEAD, 1) for n in (a, _DECODER)])
        self.fine = _ConvNorm(_HEAD, _HEAD)
        self.maps = nn.Conv2d(_HEAD, _MAPS, 1)
        self.seen_at = nn.Parameter(torch.randn(POINTS, _HEAD) / _HEAD**0.5)
        self.seen = nn.Linear(d, POINTS)

    def forward(self, rgb: UInt8[Tensor, "b 3 h w"]) -> Answer:
        """Maps of all points, their visibility, the car."""
        x = (rgb.float() - 118.0) / 60.0
        x = x.contiguous(memory_format=torch.channels_last)
        at4 = self.stride4(self.stem(x))
        at8 = self.stride8(at4)
        at16 = self.stride16(at8)
        at32 = self.stride32(at16)
        whole = at32.mean((2, 3))
        # what the picture as a whole says: which way the car points decides which side is left
        at32 = at32 + self.context(whole)[..., None, None]
        up = F.relu(self.smooth[0](self.lateral[0](at32)), inplace=True)
        for lateral, smooth, skip in zip(self.lateral[1:], self.smooth[1:], (at16, at8), strict=True):
            up = F.relu(smooth(_twice(up) + lateral(skip)), inplace=True)
        fine = F.relu(self.fine(_twice(self.to_fine[1](up)) + self.to_fine[0](at4)), inplace=True)
        maps = self.maps(fine)
        heat = maps[:, :POINTS].float()
        logarithms = heat.flatten(2).log_softmax(-1)
        # whether a point is visible shows in what the picture looks like where the point is thought to be
        local = torch.einsum("bjs,bcs->bjc", logarithms.exp().to(fine.dtype), fine.flatten(2))
        visible = (local * self.seen_at).sum(-1).float() + self.seen(whole).float()
        return Answer(logarithms.view_as(heat), visible, maps[:, POINTS].float())


def _twice(x: Tensor) -> Tensor:
    return F.interpolate(x, scale_factor=2.0, mode="nearest")
