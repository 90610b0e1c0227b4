"""The basin of convergence: trajectory errors after training against those before, over many trainings."""

from collections.abc import Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

Record = dict[str, Any]

_ERRORS = {"rotation_deg": "rotation error [deg]", "ate_m": "position error [m]"}
# Errors below these count as zero.
_EXACT = {"rotation_deg": 0.02, "ate_m": 1e-4}
_WORSE = 1.05


def basin_figure(records: Sequence[Record]) -> Figure:
    """One point per training that refines its trajectory; points below the diagonal improved."""
    figure, axes = plt.subplots(1, len(_ERRORS), figsize=(9.0, 4.2))
    for axis, (name, title) in zip(axes, _ERRORS.items(), strict=True):
        scenes = list(dict.fromkeys(record["scene"] for record in records))
        values: list[float] = []
        for scene, marker in zip(scenes, "osD^v<>Px*" * len(scenes), strict=False):
            points = [_before_and_after(record, name) for record in records if record["scene"] == scene]
            known = [point for point in points if point]
            if known:
                axis.plot(*zip(*known, strict=True), marker, label=scene, alpha=0.6, ls="none")
                values += [value for point in known for value in point]
        ends = [min(values, default=0.1) / 1.5, max(values, default=1.0) * 1.5]
        axis.plot(ends, ends, color="grey", lw=0.8, label="as before")
        axis.set(xscale="log", yscale="log", xlabel=f"given: {title}", ylabel=f"refined: {title}")
        axis.grid(alpha=0.3, which="both")
    axes[0].legend(fontsize=8)
    figure.tight_layout()
    return figure


def worse_than_given(records: Sequence[Record]) -> list[Record]:
    """Trainings that increased an error of positions or rotations, not counted as zero before, by more than 1/20."""
    pairs = [(record, name, _before_and_after(record, name)) for record in records for name in _ERRORS]
    worse = [record for record, name, pair in pairs if pair and pair[0] > _EXACT[name] and pair[1] > _WORSE * pair[0]]
    return [record for k, record in enumerate(worse) if record not in worse[:k]]


def worse_lines(records: Sequence[Record]) -> list[str]:
    """The result of :func:`worse_than_given` in Markdown, with each run's own verdict."""
    worse = worse_than_given(records)
    lines = [
        f"{len(worse) or 'No'} training{'' if len(worse) == 1 else 's'} of {len(records)} left a trajectory worse."
    ]
    for record in worse:
        known = {title: _before_and_after(record, name) for name, title in _ERRORS.items()}
        errors = ", ".join(f"{pair[0]:.3g} to {pair[1]:.3g} {title}" for title, pair in known.items() if pair)
        said = record["evaluations"][-1].get("support") or {}
        lines.append(
            f"- {record['scene']}, {record['trajectory']}, {record['method']}, seed {record['seed']}: {errors}; "
            f"the run says: {said.get('verdict', 'nothing')}"
        )
    return lines


def _before_and_after(record: Record, name: str) -> tuple[float, float] | None:
    last = record["evaluations"][-1] if record.get("evaluations") else {}
    before, after = record["initial"].get(name), last.get(name)
    if before is None or after is None:
        return None
    return max(before, _EXACT[name]), max(after, _EXACT[name])
