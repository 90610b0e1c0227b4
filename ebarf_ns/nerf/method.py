"""The methods registered with ns-train: ebarf, and the baselines ebarf-paper and enerf."""

from typing import Literal

import torch
from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.engine.optimizers import OptimizerConfig
from nerfstudio.plugins.types import MethodSpecification

from ebarf_ns.nerf.datamanager import EventDataManagerConfig
from ebarf_ns.nerf.model import EbarfModelConfig
from ebarf_ns.nerf.optimizers import BudgetDecayConfig, FusedAdamConfig, KeyframeAdamConfig
from ebarf_ns.nerf.pipeline import EbarfPipelineConfig
from ebarf_ns.nerf.trainer import EbarfTrainer
from ebarf_ns.nerf.trainer_config import EbarfTrainerConfig
from ebarf_ns.nerf.trajectory_optimizer import TrajectoryOptimizerConfig
from ebarf_ns.nerf.viewer_panel import ViewedPipeline


def _trainer(
    method_name: str,
    datamanager: EventDataManagerConfig,
    model: EbarfModelConfig,
    field_rate: float,
    poses: OptimizerConfig,
    field_decay: float = 0.1,
    averaged_steps: int = 1,
) -> EbarfTrainerConfig:
    return EbarfTrainerConfig(
        _target=EbarfTrainer,
        method_name=method_name,
        machine=MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu"),
        max_num_iterations=30_000,
        # Evaluation follows the budget, see EbarfTrainerConfig.evaluations.
        steps_per_eval_batch=10**9,
        steps_per_eval_image=10**9,
        steps_per_eval_all_images=10**9,
        steps_per_save=1000,
        mixed_precision=False,
        averaged_steps=averaged_steps,
        pipeline=EbarfPipelineConfig(_target=ViewedPipeline, datamanager=datamanager, model=model),
        optimizers={
            "fields": {
                "optimizer": FusedAdamConfig(lr=field_rate, eps=1e-15),
                "scheduler": BudgetDecayConfig(lr_final_ratio=field_decay),
            },
            "camera_opt": {
                "optimizer": poses,
                "scheduler": BudgetDecayConfig(),
            },
            # Used only with --learn-intrinsics.
            "intrinsics": {
                "optimizer": KeyframeAdamConfig(lr=0.03),
                "scheduler": BudgetDecayConfig(),
            },
        },
        # The trainer prints its own live line.
        logging=LoggingConfig(steps_per_log=10, profiler="none", local_writer=LocalWriterConfig(enable=False)),
        # Anyone who can reach the viewer can control it.
        viewer=ViewerConfig(num_rays_per_chunk=4096, websocket_host="127.0.0.1"),
        vis="viewer",
    )


def _paper(method_name: str, mode: Literal["refine", "off"]) -> EbarfTrainerConfig:
    """The E-BARF paper's method; its baseline is the same with frozen poses."""
    model = EbarfModelConfig(
        camera_optimizer=TrajectoryOptimizerConfig(
            mode=mode,
            smooth=False,
            align_steps=0,
            longest_gap_us=0,
            keyframe_stride=1,
            prior=0.0,
            every=1,
            interpolation="linear",
        ),
        loss="normalized",
        huber_delta=None,
        render_variance=0.0,
        threshold_ratio=1.0,
        threshold_deviation=0.0,
        brightness="lin_log",
        intensity_range="unit",
        view_dependent=True,
        sampling="uniform",
        samples=96,
        grid_levels=16,
        grid_features=2,
        grid_coarsest=16,
        grid_finest=512,
        grid_table_size_log2=17,
        broad_cells=0,
        precision="float32",
    )
    datamanager = EventDataManagerConfig(
        longest_pair=1,
        silent_share=0.0,
        blank_share=0.0,
        doubles_us=0,
        refractory_us=0,
        leave_out_hot_pixels=False,
        leave_out_flicker=False,
        train_num_rays_per_batch=1024,
    )
    return _trainer(method_name, datamanager, model, field_rate=5e-3, poses=FusedAdamConfig(lr=0.1))


ebarf = MethodSpecification(
    config=_trainer(
        "ebarf",
        EventDataManagerConfig(),
        EbarfModelConfig(),
        field_rate=1e-2,
        # With parameter averaging, the learning rate need not decay as far.
        field_decay=0.3,
        averaged_steps=100,
        poses=KeyframeAdamConfig(lr=0.03),
    ),
    description="NeRF from an event camera and its imperfect trajectory, which is refined on the way.",
)

ebarf_paper = MethodSpecification(
    config=_paper("ebarf-paper", "refine"),
    description="E-BARF as published: consecutive event pairs, uniform samples, normalised loss.",
)

enerf = MethodSpecification(
    config=_paper("enerf", "off"),
    description="E-NeRF: ebarf-paper with the poses frozen.",
)
