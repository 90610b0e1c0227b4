"""Checkpoints of earlier versions: missing entries start as in a new training, obsolete ones are dropped."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ebarf_ns.errors import TrainingError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

_ADDED = {
    "camera_optimizer": ("before_px", "clock_offset_us", "clock_px", "clock_us_per_px", "hold", "unit"),
    "sensor": ("deviations", "seen_brightness", "time_constant"),
}
_DROPPED = {"_model.display_range", "_model.sensor.half_log_ratio", "_model.sensor.mean_brightness"}
_MAY_LACK = {f"_model.{part}.{name}" for part, names in _ADDED.items() for name in names}


def completed(
    state: Mapping[str, Tensor], fresh: Mapping[str, Tensor], what: str
) -> tuple[dict[str, Tensor], list[str]]:
    """A pipeline's state completed with new entries from ``fresh``, and the names of those entries.

    Raises :class:`TrainingError`, which names ``what`` was read, if the difference is not one between versions.
    """
    state = {_undistributed(name): value for name, value in state.items() if name not in _DROPPED}
    fresh = {_undistributed(name): value for name, value in fresh.items() if name not in _DROPPED}
    added = sorted(fresh.keys() - state.keys())
    if wrong := [name for name in added if name not in _MAY_LACK]:
        raise TrainingError(f"{what}: lacks {wrong[0]}, expected a checkpoint made with the same flags")
    if wrong := sorted(state.keys() - fresh.keys()):
        raise TrainingError(f"{what}: holds {wrong[0]}, which this run has no use for; expected the same flags")
    return {**state, **{name: fresh[name] for name in added}}, added


def _undistributed(name: str) -> str:
    """The name without the prefix that torch adds in distributed training."""
    return name.replace("_model.module.", "_model.", 1)
