"""Method presets, each a documented difference from nerfstudio's own default.

``kronc-*`` have the settings of KRONC's experiments, ``kronc-*-cpu`` train in at most five minutes on two CPU cores
with images of about 200 px. Poses are refined during training where ``--pipeline.model.camera-optimizer.mode SO3xR3``
asks for it; ``barf`` and ``l2g-nerf`` always refine them, and ``barf-cpu`` and ``l2g-nerf-cpu`` expect about 100 px.
"""

import dataclasses
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
from nerfstudio.models.base_model import ModelConfig
from nerfstudio.plugins.types import MethodSpecification

from kronc_ns.plugin.barf.cameras import LocalToGlobalPosesConfig
from kronc_ns.plugin.barf.model import BarfModelConfig, L2GModelConfig
from kronc_ns.plugin.compatibility import allow_numpy_in_checkpoints, train_without_lpips_weights
from kronc_ns.plugin.dataparser import KroncDataParserConfig
from kronc_ns.plugin.dvgo.model import DVGOModelConfig
from kronc_ns.plugin.dvgo.optimizer import FusedAdamConfig
from kronc_ns.plugin.pipeline import KroncPipelineConfig
from kronc_ns.plugin.splat_cpu.model import SplatfactoCpuModelConfig
from kronc_ns.plugin.tensorf import PosableTensoRFModelConfig

allow_numpy_in_checkpoints()
train_without_lpips_weights()

Optimizers = dict[str, Any]


# ---- what presets share


def _on_gpu(
    name: str, steps: int, pipeline: KroncPipelineConfig, optimizers: Optimizers, description: str
) -> MethodSpecification:
    """Viewer, and evaluation along the way, as nerfstudio's own methods."""
    return MethodSpecification(
        TrainerConfig(
            method_name=name,
            max_num_iterations=steps,
            steps_per_save=2000,
            steps_per_eval_batch=500,
            steps_per_eval_image=500,
            steps_per_eval_all_images=steps,
            mixed_precision=False,
            pipeline=pipeline,
            optimizers=optimizers,
            viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
            vis="viewer",
        ),
        description,
    )


def _on_cpu(
    name: str, steps: int, pipeline: KroncPipelineConfig, optimizers: Optimizers, description: str
) -> MethodSpecification:
    """No viewer and no evaluation along the way: they would take most of the time."""
    return MethodSpecification(
        TrainerConfig(
            method_name=name,
            max_num_iterations=steps,
            steps_per_save=500,
            steps_per_eval_batch=0,
            steps_per_eval_image=0,
            steps_per_eval_all_images=0,
            mixed_precision=False,
            pipeline=pipeline,
            optimizers=optimizers,
            viewer=ViewerConfig(quit_on_train_completion=True),
            machine=MachineConfig(device_type="cpu"),
            vis="tensorboard",
        ),
        description,
    )


def _on_rays(rays: int, model: ModelConfig, dataparser: DataParserConfig) -> KroncPipelineConfig:
    """A model trained on ``rays`` random rays a step."""
    manager = VanillaDataManagerConfig(
        dataparser=dataparser, train_num_rays_per_batch=rays, eval_num_rays_per_batch=rays
    )
    return KroncPipelineConfig(datamanager=manager, model=model)


def _on_images(model: ModelConfig) -> KroncPipelineConfig:
    """A model trained on one whole image a step."""
    manager = FullImageDatamanagerConfig(dataparser=KroncDataParserConfig(), cache_images_type="uint8")
    return KroncPipelineConfig(datamanager=manager, model=model)


def _adam(lr: float, lr_final: float | None = None, end: int = 0, begin: int = 0, eps: float = 1e-8) -> dict[str, Any]:
    """Adam whose rate falls exponentially from ``lr`` at step ``begin`` to ``lr_final`` at step ``end``.

    Before ``begin`` the rate waits at ``lr``; without ``lr_final`` it stays there.
    """
    schedule = lr_final and ExponentialDecaySchedulerConfig(
        lr_pre_warmup=lr, warmup_steps=begin, max_steps=end, lr_final=lr_final
    )
    return {"optimizer": FusedAdamConfig(lr=lr, eps=eps), "scheduler": schedule or None}


# ---- TensoRF

kronc_tensorf = _on_gpu(
    # nerfstudio's tensorf with the paper's settings (section 5.1): 10k iterations of 4096 rays, scale 0.5, learning
    # rate 1e-4 with exponential decay for the networks. The factor grids keep nerfstudio's 2e-2: at 1e-4 they would
    # hardly leave their initial values in 10k steps.
    "kronc-tensorf",
    10_000,
    _on_rays(
        4096,
        PosableTensoRFModelConfig(regularization="tv", camera_optimizer=CameraOptimizerConfig(mode="off")),
        KroncDataParserConfig(scale_factor=0.5),
    ),
    {
        "fields": _adam(1e-4, 1e-5, 10_000),
        "encodings": _adam(2e-2, 2e-3, 10_000),
        "camera_opt": _adam(1e-4, 1e-5, 5000),
    },
    "TensoRF on KRONC poses, with the paper's settings.",
)

kronc_tensorf_cpu = _on_cpu(
    # A coarser grid, fewer samples and rays, larger learning rates for fewer steps. In a scene twenty times as large
    # as the paper's, a twentieth of the density is opaque: the factors, which start near 0, are there much sooner.
    "kronc-tensorf-cpu",
    1200,
    _on_rays(
        1024,
        PosableTensoRFModelConfig(
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
        KroncDataParserConfig(scale_factor=10.0),
    ),
    {
        "fields": _adam(2e-3, 2e-4, 1200),
        "encodings": _adam(3e-2, 3e-3, 1200),
        "camera_opt": _adam(1e-3, 1e-4, 1200),
    },
    "TensoRF on KRONC poses, sized to train in a few minutes on two CPU cores.",
)


# ---- Direct Voxel Grid Optimization


def _dvgo_optimizers(coarse: int, fine: int, grids: float, mlp: float, decay: float) -> Optimizers:
    """Adam for steps of DVGO's two stages, each with its own exponential decay by ``decay`` a step.

    The fine stage's rates wait through the coarse stage, in which nothing of it is trained. eps is far below the
    gradients of voxels at their first alpha of 1e-6, or those would not move.
    """
    end = coarse + fine
    return {
        "coarse": _adam(grids, grids * decay**coarse, coarse, eps=1e-15),
        "fine": _adam(grids, grids * decay**fine, end, begin=coarse, eps=1e-15),
        "mlp": _adam(mlp, mlp * decay**fine, end, begin=coarse, eps=1e-15),
        "camera_opt": _adam(1e-3, 1e-4, end),
    }


def _dvgo(name: str, dataparser: DataParserConfig, description: str) -> MethodSpecification:
    """DVGO as in its paper, for as long as in KRONC's (section 5.1): 5k coarse and 10k fine steps of 8192 rays.

    The rates are DVGO's: 0.1 for grids and 1e-3 for the network, falling to a tenth in 20k steps.
    """
    return _on_gpu(
        name,
        15_000,
        _on_rays(8192, DVGOModelConfig(eval_num_rays_per_chunk=8192), dataparser),
        _dvgo_optimizers(5000, 10_000, grids=0.1, mlp=1e-3, decay=0.1 ** (1 / 20_000)),
        description,
    )


dvgo = _dvgo("dvgo", NerfstudioDataParserConfig(), "Direct Voxel Grid Optimization (CVPR 2022), pure torch.")
kronc_dvgo = _dvgo("kronc-dvgo", KroncDataParserConfig(), "DVGO on KRONC poses, with the paper's settings.")

kronc_dvgo_cpu = _on_cpu(
    # Small grids, fewer rays, a smaller network, and few steps with learning rates three times DVGO's that fall to a
    # tenth.
    "kronc-dvgo-cpu",
    1300,
    _on_rays(
        1024,
        DVGOModelConfig(
            coarse_iterations=200,
            coarse_voxels=32**3,
            fine_voxels=67**3,
            growth_steps=(200, 400),
            mlp_width=64,
            eval_num_rays_per_chunk=4096,
        ),
        KroncDataParserConfig(),
    ),
    _dvgo_optimizers(200, 1100, grids=0.3, mlp=3e-3, decay=0.1 ** (1 / 1100)),
    "DVGO on KRONC poses, sized to train in a few minutes on two CPU cores.",
)


# ---- Gaussian splatting


def _splat_optimizers(steps: int, faster: float = 1.0) -> Optimizers:
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


kronc_splatfacto = _on_gpu(
    # nerfstudio's splatfacto, stopped after the paper's 10k iterations (section 5.1) of its 30k, but for the
    # background: `kronc-dataparser` cuts the vehicle out on white by default, and a random background would have to
    # be covered with white Gaussians.
    "kronc-splatfacto",
    10_000,
    _on_images(SplatfactoCpuModelConfig(background_color="white")),
    _splat_optimizers(30_000),
    "Splatfacto on KRONC poses (gsplat's kernels, CUDA), with the paper's settings.",
)

kronc_splatfacto_cpu = _on_cpu(
    # A tenth of the steps, so larger rates and a denser schedule; half size for the first third, fewer Gaussians, no
    # resets of the opacities.
    "kronc-splatfacto-cpu",
    3000,
    _on_images(
        SplatfactoCpuModelConfig(
            background_color="white",
            warmup_length=300,
            num_downscales=1,
            resolution_schedule=1000,
            sh_degree_interval=500,
            densify_grad_thresh=0.002,
            stop_split_at=2000,
            stop_screen_size_at=0,
        )
    ),
    _splat_optimizers(3000, faster=4.0),
    "Splatfacto on KRONC poses without CUDA, sized to train in a few minutes on two CPU cores.",
)


# ---- BARF and L2G-NeRF


def _barf(name: str, model: BarfModelConfig, description: str) -> MethodSpecification:
    """As in BARF's synthetic scenes: 200k steps of 1024 rays with 128 samples each, and no finer ones among them.

    Rates fall from 5e-4 to 1e-4, those of poses from 1e-3 to 1e-5.
    """
    steps = 200_000
    optimizers = {"fields": _adam(5e-4, 1e-4, steps), "camera_opt": _adam(1e-3, 1e-5, steps)}
    return _on_gpu(name, steps, _on_rays(1024, model, KroncDataParserConfig()), optimizers, description)


barf = _barf("barf", BarfModelConfig(), "BARF (ICCV 2021): poses are found while a field trains, coarse to fine.")
l2g_nerf = _barf("l2g-nerf", L2GModelConfig(), "L2G-NeRF (CVPR 2023): BARF by local motions of rays.")


def _barf_cpu(name: str, steps: int, model: BarfModelConfig, description: str) -> MethodSpecification:
    """A few hundredths of the steps, a small network without viewing directions, few rays and samples, larger rates.

    The first frequencies are on from the start and poses wait until the field shows something: neither loses more
    than the fine detail that a start of a few degrees could not use yet.
    """
    model = dataclasses.replace(
        model,
        frequencies=6,
        direction_frequencies=None,
        coarse_until=-900,
        fine_from=1800,
        poses_from=250,
        depth=4,
        width=64,
        skip=None,
        samples=32,
    )
    pipeline = _on_rays(512, model, KroncDataParserConfig())
    pipeline.test_pose_steps = 150
    optimizers = {"fields": _adam(5e-3, 5e-4, steps), "camera_opt": _adam(3e-3, 3e-4, steps)}
    return _on_cpu(name, steps, pipeline, optimizers, description)


barf_cpu = _barf_cpu("barf-cpu", 4000, BarfModelConfig(), "BARF, sized to train in some minutes on two CPU cores.")
l2g_nerf_cpu = _barf_cpu(
    "l2g-nerf-cpu",
    6000,  # motions of single rays carry their cameras along more slowly
    L2GModelConfig(camera_optimizer=LocalToGlobalPosesConfig(mode="SE3", warp_depth=4, warp_width=64, code_size=32)),
    "L2G-NeRF, sized to train in some minutes on two CPU cores.",
)
