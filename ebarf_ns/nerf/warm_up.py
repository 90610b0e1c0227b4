"""Kernels compiled before the clock of a training starts."""

from __future__ import annotations

from time import monotonic
from typing import TYPE_CHECKING

import torch
from nerfstudio.utils.rich_utils import CONSOLE

if TYPE_CHECKING:
    from ebarf_ns.nerf.pipeline import EbarfPipeline

_WORTH_SAYING_S = 2.0


def compile_kernels(pipeline: EbarfPipeline) -> float:
    """Draw a batch, render it and differentiate it once; returns the seconds that this took.

    Numba and Triton compile a kernel when it is first called, once for each machine and version. Nothing of the model
    changes: it is rendered as in an evaluation, and its gradients are thrown away.
    """
    started = monotonic()
    model, was_training = pipeline.model, pipeline.model.training
    with CONSOLE.status("compiling kernels for this processor, which happens once"):
        try:
            model.eval()
            rays, _ = pipeline.datamanager.next_train(0)
            outputs = model(rays)
            learned = [one for one in (*model.renderer.parameters(), *model.pose_parameters()) if one.requires_grad]
            torch.autograd.grad(outputs["brightness"].sum(), learned, allow_unused=True)
        finally:
            model.train(was_training)
    seconds = monotonic() - started
    if seconds > _WORTH_SAYING_S:
        CONSOLE.print(f"kernels compiled in {seconds:.0f} s, once for this machine; not part of the training time")
    return seconds
