"""Compilation of kernels before the training clock starts."""

from __future__ import annotations

from time import monotonic
from typing import TYPE_CHECKING

import torch
from nerfstudio.utils.rich_utils import CONSOLE

from ebarf_ns.nerf.terminal import say

if TYPE_CHECKING:
    from ebarf_ns.nerf.pipeline import EbarfPipeline

_REPORTED_ABOVE_S = 2.0


def compile_kernels(pipeline: EbarfPipeline) -> float:
    """Render one batch and compute its gradients; returns the duration in seconds.

    Numba and Triton compile a kernel on its first call, once per machine and version. The model does not change: it
    renders in evaluation mode, and the gradients are discarded.
    """
    started = monotonic()
    model, was_training = pipeline.model, pipeline.model.training
    with CONSOLE.status("compiling kernels for this processor (once only)"):
        try:
            model.eval()
            rays, _ = pipeline.datamanager.next_train(0)
            outputs = model(rays)
            parameters = (*model.renderer.parameters(), *model.pose_parameters())
            learned = [parameter for parameter in parameters if parameter.requires_grad]
            torch.autograd.grad(outputs["brightness"].sum(), learned, allow_unused=True)
        finally:
            model.train(was_training)
    seconds = monotonic() - started
    if seconds > _REPORTED_ABOVE_S:
        say(f"compiled kernels in {seconds:.0f} s (once per machine, not counted as training time)")
    return seconds
