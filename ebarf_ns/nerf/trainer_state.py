"""The state of a training, saved and restored so that a resumed training continues bitwise identically."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ebarf_ns.errors import TrainingError

if TYPE_CHECKING:
    from pathlib import Path


def trainer_state(trainer: Any, step: int) -> dict[str, Any]:
    """The state of an ``EbarfTrainer`` after ``step``, as tensors and plain values."""
    optimizers = trainer.optimizers
    with trainer.averaging.shown():
        pipeline = {name: value.clone() for name, value in trainer.pipeline.state_dict().items()}
    return {
        "step": step,
        "pipeline": pipeline,
        "optimizers": {name: optimizer.state_dict() for name, optimizer in optimizers.optimizers.items()},
        "schedulers": {name: scheduler.state_dict() for name, scheduler in optimizers.schedulers.items()},
        "scalers": trainer.grad_scaler.state_dict(),
        "ebarf": {
            "train_seconds": trainer.train_seconds,
            "event_pairs": trainer.event_pairs,
            **optimizers.guard_state(),
            # The pipeline's state has the averaged parameters; only a resumed training needs the unaveraged ones.
            "trained": [parameter.detach().clone() for parameter in trainer.averaging.parameters],
        },
    }


def restore(trainer: Any, state: dict[str, Any], path: Path, changed: str) -> None:
    """Restore a trainer from the state read from ``path``; ``changed`` lists the flags that have changed since.

    Raises :class:`TrainingError` if the state does not fit.
    """
    ours = state.get("ebarf", {})
    try:
        trainer.pipeline.load_pipeline(state["pipeline"], state["step"])
        # Optimizer moments of an earlier version may belong to other parameters.
        fits = not trainer.pipeline.upgraded
        trainer.averaging.begin_from(ours.get("trained") if fits else None)
        trainer.optimizers.load_optimizers(state["optimizers"] if fits else {})
        if trainer.config.load_scheduler:
            trainer.optimizers.load_schedulers(state["schedulers"])
        trainer.grad_scaler.load_state_dict(state["scalers"])
        trainer.optimizers.load_guard_state(ours)
        trainer.train_seconds = ours.get("train_seconds", 0.0)
        trainer.event_pairs = ours.get("event_pairs", 0)
    except (RuntimeError, LookupError, TypeError, ValueError, AttributeError) as error:
        said = str(error).splitlines()[-1].strip() if str(error) else type(error).__name__
        expected = f"expected a run's checkpoint, with the flags it was made by{changed and f': {changed}'}"
        raise TrainingError(f"{path}: cannot go on from it ({said}), {expected}") from None
