"""Method presets, each a documented difference from nerfstudio's own default."""

from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.configs.base_config import MachineConfig, ViewerConfig
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.models.tensorf import TensoRFModelConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from kronc_ns.plugin.compatibility import allow_numpy_in_checkpoints, train_without_lpips_weights
from kronc_ns.plugin.dataparser import KroncDataParserConfig

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
    # rates for fewer steps, no viewer.
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
                dataparser=KroncDataParserConfig(),
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
