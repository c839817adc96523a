"""nerfstudio's splatfacto where there is no CUDA."""
# shapes unchecked: hundreds of calls of torch a step pass through `StayOnCpu`, and no shapes are declared here

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import FunctionType
from typing import Any

from nerfstudio.cameras.cameras import Cameras
from nerfstudio.models import splatfacto
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig
from torch import Tensor
from torch.overrides import TorchFunctionMode

from kronc_ns.plugin.splat_cpu.rendering import rasterization
from kronc_ns.plugin.transparency import rgba


@dataclass
class SplatfactoCpuModelConfig(SplatfactoModelConfig):
    """Splatfacto's own options; on a CUDA device this is splatfacto."""

    _target: type = field(default_factory=lambda: SplatfactoCpuModel)


class StayOnCpu(TorchFunctionMode):
    """While entered, and in this thread only, ``tensor.cuda()`` leaves the tensor where it is."""

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        """Everything but `cuda` as ever."""
        return args[0] if func is Tensor.cuda else func(*args, **(kwargs or {}))


def _rebound(method: Any, **names: Any) -> Any:
    """``method`` with some of the global names it uses bound to other things; the original is not touched.

    splatfacto calls `rasterization` by a name of its module: there is nothing to override, and to swap that name for
    the duration of a call would reach into every other splatfacto of the process and every other thread.
    """
    function = FunctionType(
        method.__code__, {**method.__globals__, **names}, method.__name__, method.__defaults__, method.__closure__
    )
    function.__kwdefaults__ = method.__kwdefaults__
    return function


class SplatfactoCpuModel(SplatfactoModel):
    """Splatfacto with our rasteriser on the CPU; nothing else differs, and on CUDA nothing at all."""

    config: SplatfactoCpuModelConfig

    # get_viewmat is wrapped in torch.compile, which on a CPU wants a C++ compiler and saves nothing
    _get_outputs_on_cpu = _rebound(
        SplatfactoModel.get_outputs, rasterization=rasterization, get_viewmat=inspect.unwrap(splatfacto.get_viewmat)
    )

    def populate_modules(self) -> None:
        """Splatfacto puts the colours of seed points on the GPU; here all parameters start on the CPU."""
        with StayOnCpu():
            super().populate_modules()

    def get_outputs(self, camera: Cameras) -> dict[str, Tensor | list]:
        """Render ``camera``, on the CPU with our rasteriser, on CUDA with gsplat's."""
        if self.device.type != "cpu":
            return super().get_outputs(camera)
        with StayOnCpu():
            return self._get_outputs_on_cpu(camera)

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Colour and opacity of a rendering, which nerfstudio looks for in a renderer that splatfacto has not."""
        rgb = outputs[output_name]
        return rgba(rgb, outputs["accumulation"], outputs["background"].expand(rgb.shape))
