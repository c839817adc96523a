"""nerfstudio's TensoRF whose factor grids can tell where a sample should move, so that its poses can be refined."""

from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from jaxtyping import Float
from nerfstudio.field_components.encodings import TensorVMEncoding
from nerfstudio.models.tensorf import TensoRFModel, TensoRFModelConfig
from torch import Tensor

from kronc_ns.plugin.transparency import rgba


@dataclass
class PosableTensoRFModelConfig(TensoRFModelConfig):
    """TensoRF's own options."""

    _target: type = field(default_factory=lambda: PosableTensoRFModel)


class PosableVMEncoding(TensorVMEncoding):
    """nerfstudio's, which stops all gradients at the positions, without that stop."""

    def forward(self, in_tensor: Float[Tensor, "*bs 3"]) -> Float[Tensor, "*bs c"]:
        """Products of plane and line factors (TensoRF, equation 4) at positions in [-1, 1]."""
        x, y, z = in_tensor.reshape(-1, 3).unbind(-1)
        on_planes = torch.stack([torch.stack([x, y], -1), torch.stack([x, z], -1), torch.stack([y, z], -1)])
        along = torch.stack([z, y, x])
        on_lines = torch.stack([torch.zeros_like(along), along], dim=-1)
        planes = F.grid_sample(self.plane_coef, on_planes[:, :, None], align_corners=True)
        lines = F.grid_sample(self.line_coef, on_lines[:, :, None], align_corners=True)
        return (planes * lines)[..., 0].flatten(0, 1).T.reshape(*in_tensor.shape[:-1], -1)


class PosableTensoRFModel(TensoRFModel):
    """TensoRF; nerfstudio's camera optimiser moves its cameras, of which otherwise only the viewing directions turn."""

    config: PosableTensoRFModelConfig

    def populate_modules(self) -> None:
        """TensoRF, with the other encodings where poses are refined and factors are planes and lines."""
        super().populate_modules()
        if self.config.camera_optimizer.mode != "off" and self.config.tensorf_encoding == "vm":
            self.field.density_encoding = PosableVMEncoding(self.init_resolution, self.num_den_components)
            self.field.color_encoding = PosableVMEncoding(self.init_resolution, self.num_color_components)

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Float[Tensor, "*n 4"]:
        """Colour and opacity of a rendering; opaque where its background is what the ray's last sample shows."""
        background = self.config.background_color
        if background == "last_sample":
            return super().get_rgba_image(outputs, output_name)
        return rgba(outputs[output_name], outputs["accumulation"], background)
