"""Timings of nerfstudio's hash encoding and of nerfacto, as baselines."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from statistics import mean, median
from time import perf_counter
from typing import TYPE_CHECKING, Any

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.field_components.encodings import HashEncoding
from nerfstudio.models.nerfacto import NerfactoModelConfig
from torch import nn

if TYPE_CHECKING:
    from ebarf_ns.radiance.lattice import HashGridShape


def hash_encoding(shape: HashGridShape, device: str) -> tuple[Callable, list[nn.Parameter]]:
    """Nerfstudio's torch hash encoding, and its parameters."""
    encoding = HashEncoding(
        num_levels=shape.levels,
        min_res=shape.coarsest,
        max_res=shape.finest,
        log2_hashmap_size=shape.table_size_log2,
        features_per_level=shape.features,
        implementation="torch",
    ).to(device)
    return encoding, list(encoding.parameters())


def ebarf_rays_per_second(scene: Path, folder: Path, steps: int) -> tuple[float, dict[str, int]]:
    """Training rays per second of the registered method on a scene, and its planned grid under nerfacto's field names.

    The first half of the steps is warm-up. The rate is a median over groups of eight, since every eighth step does
    more work.
    """
    from ebarf_ns.nerf.method import ebarf
    from ebarf_ns.nerf.trainer import EbarfTrainerConfig

    config = copy.deepcopy(ebarf.config)
    assert isinstance(config, EbarfTrainerConfig)
    config.pipeline.datamanager.data = scene
    config.output_dir, config.experiment_name, config.timestamp = folder, "speed", "run"
    config.vis, config.logging.local_writer.enable, config.evaluations = "tensorboard", False, 0
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    trainer.pipeline.train()
    times = []
    for step in range(steps):
        started = _now()
        trainer.train_iteration(step)
        times.append(_now() - started)
    seconds = median(sum(times[k : k + 8]) / len(times[k : k + 8]) for k in range(steps // 2, steps, 8))
    model = trainer.pipeline.model.config
    shape = {
        "num_levels": model.grid_levels,
        "features_per_level": model.grid_features,
        "base_res": model.grid_coarsest,
        "max_res": model.grid_finest,
        "log2_hashmap_size": model.grid_table_size_log2,
        "num_nerf_samples_per_ray": model.samples,
    }
    return trainer.pipeline.datamanager.get_train_rays_per_batch() / seconds, shape


def nerfacto_rays_per_second(shape: dict[str, Any], rays: int, repetitions: int) -> float:
    """Training rays per second of stock nerfacto in torch, without its data manager, on the same device as ebarf.

    Proposal networks are trained as rarely as after 5,000 steps. ``shape`` overrides configuration fields.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = _without_lpips(NerfactoModelConfig(implementation="torch", **shape)).to(device)
    optimizers = [torch.optim.Adam(group, lr=1e-2, eps=1e-15) for group in model.get_param_groups().values() if group]
    times = []
    for number in range(repetitions + 1):
        bundle, batch = _some_rays(rays).to(device), {"image": torch.rand(rays, 3, device=device)}
        model.proposal_sampler.step_cb(5_000 + number)
        started = _now()
        for optimizer in optimizers:
            optimizer.zero_grad()
        outputs = model(bundle)
        losses = model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))
        sum(losses.values(), torch.zeros(())).backward()
        for optimizer in optimizers:
            optimizer.step()
        times.append(_now() - started)
    # Mean, not median, since only some steps train the proposal networks.
    return rays / mean(times[1:])


def _now() -> float:
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return perf_counter()


def _without_lpips(config: NerfactoModelConfig) -> Any:
    """The model without the LPIPS metric, whose weights would be downloaded."""
    from torchmetrics.image import lpip

    kept = lpip.LearnedPerceptualImagePatchSimilarity
    lpip.LearnedPerceptualImagePatchSimilarity = lambda **_: nn.Identity()  # pyright: ignore[reportAttributeAccessIssue]
    try:
        box = SceneBox(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
        return config.setup(scene_box=box, num_train_data=41, metadata={}).train()
    finally:
        lpip.LearnedPerceptualImagePatchSimilarity = kept


def _some_rays(count: int) -> RayBundle:
    direction = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    return RayBundle(
        origins=0.2 * torch.rand(count, 3),
        directions=direction,
        pixel_area=torch.full((count, 1), 1e-4),
        camera_indices=torch.randint(0, 41, (count, 1)),
        metadata={"directions_norm": torch.ones(count, 1)},
    )
