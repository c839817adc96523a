"""TensoRF with gradients at the positions: the same values as nerfstudio's, and poses that can be refined."""

import pytest
import torch

pytest.importorskip("nerfstudio")

from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.field_components.encodings import TensorVMEncoding

from kronc_ns.plugin.tensorf import PosableTensoRFModelConfig, PosableVMEncoding

pytestmark = pytest.mark.nerfstudio


def test_values_are_nerfstudios():
    torch.manual_seed(0)
    encoding = PosableVMEncoding(resolution=7, num_components=4)
    points = 2.2 * torch.rand(5, 6, 3) - 1.1  # some outside
    torch.testing.assert_close(encoding(points), TensorVMEncoding.forward(encoding, points), rtol=0, atol=1e-6)


def test_gradients_at_positions_are_those_of_finite_differences():
    torch.manual_seed(0)
    encoding = PosableVMEncoding(resolution=5, num_components=2).double()
    # between the grid's points (at multiples of 1/2), where the factors are smooth
    points = torch.tensor([[0.2, -0.7, 0.3], [-0.3, 0.6, -0.85]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(encoding, (points,))


@pytest.mark.parametrize("mode", ["off", "SO3xR3"])
@pytest.mark.usefixtures("without_lpips")
def test_the_camera_optimiser_feels_where_cameras_are(mode):
    torch.manual_seed(0)
    config = PosableTensoRFModelConfig(
        camera_optimizer=CameraOptimizerConfig(mode=mode), init_resolution=8, num_uniform_samples=24, num_samples=12
    )
    box = SceneBox(torch.tensor([[-1.0] * 3, [1.0] * 3]))
    model = config.setup(scene_box=box, num_train_data=2).train()
    assert isinstance(model.field.density_encoding, PosableVMEncoding) == (mode != "off")
    c2w = torch.eye(4)[:3].repeat(2, 1, 1)
    c2w[:, 2, 3] = 3.0
    cameras = Cameras(c2w, fx=30.0, fy=30.0, cx=12.0, cy=12.0, width=24, height=24)
    rays = cameras.generate_rays(torch.tensor([[0], [1]]).repeat(100, 1), coords=24 * torch.rand(200, 2))
    losses = model.get_loss_dict(model(rays), {"image": torch.zeros(200, 3)})
    sum(losses.values()).backward()
    if mode != "off":
        gradient = model.camera_optimizer.pose_adjustment.grad
        assert gradient.isfinite().all()
        assert (gradient[:, :3].norm(dim=-1) > 1e-6).all()  # of translations, which nerfstudio's encoding leaves at 0
