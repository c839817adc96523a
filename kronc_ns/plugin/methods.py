"""Method presets, each a documented difference from nerfstudio's own default."""

from typing import Any

from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.configs.base_config import MachineConfig, ViewerConfig
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.tensorf import TensoRFModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from kronc_ns.plugin.compatibility import allow_numpy_in_checkpoints, train_without_lpips_weights
from kronc_ns.plugin.dataparser import KroncDataParserConfig
from kronc_ns.plugin.dvgo.model import DVGOModelConfig
from kronc_ns.plugin.dvgo.optimizer import FusedAdamConfig
from kronc_ns.plugin.splat_cpu.model import SplatfactoCpuModelConfig

allow_numpy_in_checkpoints()
train_without_lpips_weights()

kronc_tensorf = MethodSpecification(
    # nerfstudio's tensorf with the paper's settings (section 5.1): 10k iterations of 4096 rays, scale 0.5, learning
    # rate 1e-4 with exponential decay for the networks. The factor grids keep nerfstudio's 2e-2: at 1e-4 they would
    # hardly leave their initial values in 10k steps.
    config=TrainerConfig(
        method_name="kronc-tensorf",
        steps_per_eval_batch=500,
        steps_per_eval_image=2000,
        steps_per_eval_all_images=10_000,
        steps_per_save=2000,
        max_num_iterations=10_000,
        mixed_precision=False,
        pipeline=VanillaPipelineConfig(
            datamanager=VanillaDataManagerConfig(
                dataparser=KroncDataParserConfig(scale_factor=0.5),
                train_num_rays_per_batch=4096,
                eval_num_rays_per_batch=4096,
            ),
            model=TensoRFModelConfig(regularization="tv", camera_optimizer=CameraOptimizerConfig(mode="off")),
        ),
        optimizers={
            "fields": {
                "optimizer": AdamOptimizerConfig(lr=1e-4),
                "scheduler": ExponentialDecaySchedulerConfig(lr_final=1e-5, max_steps=10_000),
            },
            "encodings": {
                "optimizer": AdamOptimizerConfig(lr=2e-2),
                "scheduler": ExponentialDecaySchedulerConfig(lr_final=2e-3, max_steps=10_000),
            },
        },
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    ),
    description="TensoRF on KRONC poses, with the paper's settings.",
)

kronc_tensorf_cpu = MethodSpecification(
    # Sized for two CPU cores and images of about 200 px: a coarser grid, fewer samples and rays, larger learning
    # rates for fewer steps, no viewer. In a scene ten times as large, a tenth of the density is opaque: the factors,
    # which start near 0, are there much sooner.
    config=TrainerConfig(
        method_name="kronc-tensorf-cpu",
        steps_per_eval_batch=0,
        steps_per_eval_image=0,
        steps_per_eval_all_images=0,
        steps_per_save=400,
        max_num_iterations=1200,
        mixed_precision=False,
        pipeline=VanillaPipelineConfig(
            datamanager=VanillaDataManagerConfig(
                dataparser=KroncDataParserConfig(scale_factor=10.0),
                train_num_rays_per_batch=1024,
                eval_num_rays_per_batch=1024,
            ),
            model=TensoRFModelConfig(
                regularization="l1",
                camera_optimizer=CameraOptimizerConfig(mode="off"),
                init_resolution=48,
                final_resolution=96,
                upsampling_iters=(250, 500),
                num_uniform_samples=48,
                num_samples=16,
                num_den_components=8,
                num_color_components=16,
                eval_num_rays_per_chunk=4096,
            ),
        ),
        optimizers={
            "fields": {
                "optimizer": AdamOptimizerConfig(lr=2e-3),
                "scheduler": ExponentialDecaySchedulerConfig(lr_final=2e-4, max_steps=1200),
            },
            "encodings": {
                "optimizer": AdamOptimizerConfig(lr=3e-2),
                "scheduler": ExponentialDecaySchedulerConfig(lr_final=3e-3, max_steps=1200),
            },
        },
        viewer=ViewerConfig(quit_on_train_completion=True),
        machine=MachineConfig(device_type="cpu"),
        vis="tensorboard",
    ),
    description="TensoRF on KRONC poses, sized to train in a few minutes on two CPU cores.",
)


def _dvgo_optimizers(
    coarse: int, fine: int, grids: float = 0.1, mlp: float = 1e-3, decay: float = 0.1 ** (1 / 20_000)
) -> dict[str, Any]:
    """Adam for steps of DVGO's two stages, each with its own exponential decay by ``decay`` a step.

    The fine stage's rates wait through the coarse stage, in which nothing of it is trained. eps is far below the
    gradients of voxels at their first alpha of 1e-6, or those would not move.
    """

    def group(lr: float, begin: int, end: int) -> dict[str, Any]:
        schedule = ExponentialDecaySchedulerConfig(
            lr_pre_warmup=lr, warmup_steps=begin, max_steps=end, lr_final=lr * decay ** (end - begin)
        )
        return {"optimizer": FusedAdamConfig(lr=lr, eps=1e-15), "scheduler": schedule}

    return {
        "coarse": group(grids, 0, coarse),
        "fine": group(grids, coarse, coarse + fine),
        "mlp": group(mlp, coarse, coarse + fine),
    }


def _dvgo(name: str, dataparser: DataParserConfig, description: str) -> MethodSpecification:
    """DVGO as in its paper, for as long as in KRONC's (section 5.1): 5k coarse and 10k fine steps of 8192 rays."""
    return MethodSpecification(
        config=TrainerConfig(
            method_name=name,
            steps_per_eval_batch=500,
            steps_per_eval_image=2500,
            steps_per_eval_all_images=15_000,
            steps_per_save=2500,
            max_num_iterations=15_000,
            mixed_precision=False,
            pipeline=VanillaPipelineConfig(
                datamanager=VanillaDataManagerConfig(
                    dataparser=dataparser,
                    train_num_rays_per_batch=8192,
                    eval_num_rays_per_batch=8192,
                ),
                model=DVGOModelConfig(eval_num_rays_per_chunk=8192),
            ),
            optimizers=_dvgo_optimizers(5000, 10_000),
            viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
            vis="viewer",
        ),
        description=description,
    )


dvgo = _dvgo("dvgo", NerfstudioDataParserConfig(), "Direct Voxel Grid Optimization (CVPR 2022), pure torch.")
kronc_dvgo = _dvgo("kronc-dvgo", KroncDataParserConfig(), "DVGO on KRONC poses, with the paper's settings.")

kronc_dvgo_cpu = MethodSpecification(
    # Sized for two CPU cores and images of about 200 px: small grids, fewer rays, and few steps with learning rates
    # three times the paper's that fall to a tenth; a smaller network, no viewer.
    config=TrainerConfig(
        method_name="kronc-dvgo-cpu",
        steps_per_eval_batch=0,
        steps_per_eval_image=0,
        steps_per_eval_all_images=0,
        steps_per_save=400,
        max_num_iterations=1300,
        mixed_precision=False,
        pipeline=VanillaPipelineConfig(
            datamanager=VanillaDataManagerConfig(
                dataparser=KroncDataParserConfig(),
                train_num_rays_per_batch=1024,
                eval_num_rays_per_batch=1024,
            ),
            model=DVGOModelConfig(
                coarse_iterations=200,
                coarse_voxels=32**3,
                fine_voxels=67**3,
                growth_steps=(200, 400),
                mlp_width=64,
                eval_num_rays_per_chunk=4096,
            ),
        ),
        optimizers=_dvgo_optimizers(200, 1100, grids=0.3, mlp=3e-3, decay=0.1 ** (1 / 1100)),
        viewer=ViewerConfig(quit_on_train_completion=True),
        machine=MachineConfig(device_type="cpu"),
        vis="tensorboard",
    ),
    description="DVGO on KRONC poses, sized to train in a few minutes on two CPU cores.",
)


def _splat_optimizers(steps: int, faster: float = 1.0) -> dict[str, Any]:
    """Splatfacto's optimizers for a training of ``steps``, with all rates ``faster`` times nerfstudio's."""

    def group(lr: float, lr_final: float | None = None, warmup: int = 0) -> dict[str, Any]:
        schedule = None
        if lr_final is not None:
            schedule = ExponentialDecaySchedulerConfig(
                lr_final=faster * lr_final, max_steps=steps, warmup_steps=warmup, lr_pre_warmup=0 if warmup else 1e-8
            )
        return {"optimizer": AdamOptimizerConfig(lr=faster * lr, eps=1e-15), "scheduler": schedule}

    return {
        "means": group(1.6e-4, 1.6e-6),
        "features_dc": group(0.0025),
        "features_rest": group(0.0025 / 20),
        "opacities": group(0.05),
        "scales": group(0.005),
        "quats": group(0.001),
        "camera_opt": group(1e-4, 5e-7, warmup=1000),
        "bilateral_grid": group(2e-3, 1e-4, warmup=1000),
    }


kronc_splatfacto = MethodSpecification(
    # nerfstudio's splatfacto, but for the background: `kronc-dataparser` cuts the vehicle out on white by default,
    # and a random background would have to be covered with white Gaussians.
    config=TrainerConfig(
        method_name="kronc-splatfacto",
        steps_per_eval_image=100,
        steps_per_eval_batch=0,
        steps_per_save=2000,
        steps_per_eval_all_images=1000,
        max_num_iterations=30_000,
        mixed_precision=False,
        pipeline=VanillaPipelineConfig(
            datamanager=FullImageDatamanagerConfig(dataparser=KroncDataParserConfig(), cache_images_type="uint8"),
            model=SplatfactoCpuModelConfig(background_color="white"),
        ),
        optimizers=_splat_optimizers(30_000),
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    ),
    description="Splatfacto on KRONC poses (gsplat's kernels, CUDA).",
)

kronc_splatfacto_cpu = MethodSpecification(
    # Sized for two CPU cores and images of about 200 px: a tenth of the steps, so larger rates and a denser schedule,
    # half size for the first third, fewer Gaussians, no resets of the opacities, no viewer.
    config=TrainerConfig(
        method_name="kronc-splatfacto-cpu",
        steps_per_eval_image=0,
        steps_per_eval_batch=0,
        steps_per_save=1000,
        steps_per_eval_all_images=0,
        max_num_iterations=3000,
        mixed_precision=False,
        pipeline=VanillaPipelineConfig(
            datamanager=FullImageDatamanagerConfig(dataparser=KroncDataParserConfig(), cache_images_type="uint8"),
            model=SplatfactoCpuModelConfig(
                background_color="white",
                warmup_length=300,
                num_downscales=1,
                resolution_schedule=1000,
                sh_degree_interval=500,
                densify_grad_thresh=0.002,
                stop_split_at=2000,
                stop_screen_size_at=0,
            ),
        ),
        optimizers=_splat_optimizers(3000, faster=4.0),
        viewer=ViewerConfig(quit_on_train_completion=True),
        machine=MachineConfig(device_type="cpu"),
        vis="tensorboard",
    ),
    description="Splatfacto on KRONC poses without CUDA, sized to train in a few minutes on two CPU cores.",
)
