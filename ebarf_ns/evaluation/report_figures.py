"""The figures of a run's report, made from the run's files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from ebarf_ns.evaluation.trajectory_error import aligned_positions, errors_over_time
from ebarf_ns.files import read_picture
from ebarf_ns.geometry.trajectory import Poses, Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Record = dict[str, Any]
CURVES = {
    "heldout_event_loss": "unexplained events",
    "psnr": "PSNR [dB]",
    "ate_m": "position error (sim3)",
    "ate_m_orientation": "position error (orientation)",
    "rotation_deg": "rotation error [deg]",
}
_POSITION = ("ate_m", "ate_m_orientation")
_LARGEST_EVENTS = 4
# Of longer trajectories, poses are drawn at even distances: markers make an SVG large, and slow to write.
_MOST_POINTS = 2000


class Drawn(NamedTuple):
    """A trajectory with the colour and line style of the paper's Fig. 2, in the reference's frame if there is one."""

    name: str
    colour: str
    line: dict[str, Any]
    seconds: np.ndarray
    position: np.ndarray
    rotation: Rotation


def drawn(initial: Trajectory, refined: Trajectory, reference: Trajectory | None) -> list[Drawn]:
    """The initial and the refined trajectory, and the reference if known."""
    styles: list[tuple[Trajectory, str, str, dict[str, Any]]] = [
        (initial, "initial", "tab:blue", {"lw": 0.8, "marker": ".", "ms": 3}),
        (refined, "refined", "tab:orange", {"lw": 2}),
    ]
    if reference:
        known = within(reference, refined)
        styles.append((known, "reference", "tab:green", {"lw": 1.5, "ls": "--"}))
    found = []
    for one, name, colour, line in styles:
        shown, position = one, one.poses.position.double().numpy()
        if reference and name != "reference":
            shown, position = within(one, reference), aligned_positions(one, reference)
            shown = shown if len(shown.t_us) == len(position) else one
        some = slice(None, None, -(-len(position) // _MOST_POINTS) or 1)
        rotation = Rotation.from_quat(shown.poses.quat_wxyz.double().numpy()[some][:, [1, 2, 3, 0]])
        found.append(Drawn(name, colour, line, shown.t_us.numpy()[some] * 1e-6, position[some], rotation))
    return found


def within(one: Trajectory, other: Trajectory) -> Trajectory:
    """The poses within the span of another trajectory."""
    inside = (one.t_us >= other.t_us[0]) & (one.t_us <= other.t_us[-1])
    return Trajectory(one.t_us[inside], Poses(*(column[inside] for column in one.poses)))


def views_figure(trajectories: list[Drawn]) -> Figure:
    """The trajectories from two sides."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 4))
    for one in trajectories:
        for axis, (first, second) in zip(axes, ((0, 1), (0, 2)), strict=True):
            axis.plot(one.position[:, first], one.position[:, second], color=one.colour, label=one.name, **one.line)
    for axis, names in zip(axes, ("xy", "xz"), strict=True):
        axis.set(xlabel=names[0], ylabel=names[1], aspect="equal")
        axis.set_adjustable("datalim")
        axis.grid(alpha=0.3)
    axes[0].legend()
    figure.tight_layout()
    return figure


def axes_figure(trajectories: list[Drawn]) -> Figure:
    """Position and rotation over time, per axis; rotations are relative to each trajectory's first pose."""
    figure, axes = plt.subplots(2, 3, figsize=(9, 4.5), sharex=True)
    for one in trajectories:
        turns_deg = np.degrees((one.rotation[0].inv() * one.rotation).as_rotvec())
        for k in range(3):
            axes[0, k].plot(one.seconds, one.position[:, k], color=one.colour, label=one.name, **one.line)
            axes[1, k].plot(one.seconds, turns_deg[:, k], color=one.colour, **one.line)
    for k, name in enumerate("xyz"):
        axes[0, k].set_title(f"position {name}", fontsize=9)
        axes[1, k].set_title(f"rotation about {name} [deg]", fontsize=9)
        axes[1, k].set_xlabel("time [s]")
    for axis in axes.flat:
        axis.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=8)
    figure.tight_layout()
    return figure


def errors_figure(initial: Trajectory, refined: Trajectory, reference: Trajectory) -> Figure | None:
    """Position and rotation errors over time, initial and refined; None if they cannot be aligned."""
    before, after = (errors_over_time(one, reference) for one in (initial, refined))
    if before is None or after is None:
        return None
    figure, axes = plt.subplots(1, 2, figsize=(9, 3))
    for one, name, colour in ((before, "initial", "tab:blue"), (after, "refined", "tab:orange")):
        axes[0].plot(one.t_us * 1e-6, one.position_m, color=colour, label=name)
        axes[1].plot(one.t_us * 1e-6, one.rotation_deg, color=colour, label=name)
    axes[0].set(title="position error", xlabel="time [s]", ylim=(0, None))
    axes[1].set(title="rotation error [deg]", xlabel="time [s]", ylim=(0, None))
    for axis in axes:
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    figure.tight_layout()
    return figure


def curves_figure(evaluations: list[Record]) -> Figure:
    """Errors over training time."""
    names = [name for name in CURVES if any(record.get(name) is not None for record in evaluations)]
    # For motion along a line, only the alignment by orientation is defined.
    names = [name for name in names if name != "ate_m_orientation" or "ate_m" not in names]
    rows = max(1, -(-len(names) // 2))
    figure, axes = plt.subplots(rows, 2, figsize=(7, 2.4 * rows), squeeze=False)
    for axis in axes.flat[len(names) :]:
        axis.set_axis_off()
    for axis, name in zip(axes.flat, names, strict=False):
        points = [(record["train_seconds"], record[name]) for record in evaluations if record.get(name) is not None]
        axis.plot(*zip(*points, strict=True), marker="o", ms=4)
        axis.set(xlabel="training time [s]", title=CURVES[name], xlim=(0, None))
        axis.title.set_fontsize(9)
        if name != "psnr":
            axis.set_ylim(0, None)
        axis.grid(alpha=0.3)
    figure.tight_layout()
    return figure


class Moments(NamedTuple):
    """Recorded and predicted events of some time windows, as sums of polarities per pixel."""

    t_us: np.ndarray
    width_us: np.ndarray
    recorded: np.ndarray
    predicted: np.ndarray


def read_moments(path: Path) -> Moments | None:
    """Read the moments of a run; None if it has none."""
    if not path.is_file():
        return None
    with np.load(path, allow_pickle=False) as file:
        return Moments(*(file[name] for name in Moments._fields))


def moments_figure(moments: Moments) -> Figure:
    """Recorded events, predicted events and their difference, one row per window."""
    count = len(moments.t_us)
    height, width = moments.recorded.shape[1:]
    figure, axes = plt.subplots(count, 3, figsize=(9, 3 * count * height / width + 0.3 * count), squeeze=False)
    for k in range(count):
        recorded, predicted = moments.recorded[k], moments.predicted[k]
        rows = (recorded, predicted, recorded - predicted)
        titles = (
            f"{moments.t_us[k] * 1e-6:.3f} s, {moments.width_us[k] * 1e-3:.3g} ms: {_counts(recorded)}",
            f"predicted: {_counts(predicted)}",
            f"difference; correlation {_correlation(recorded, predicted):.2f}",
        )
        for axis, picture, title in zip(axes[k], rows, titles, strict=True):
            _show_events(axis, picture, title)
    figure.tight_layout()
    return figure


def _show_events(axis: Axes, picture: np.ndarray, title: str) -> None:
    axis.imshow(picture, cmap="RdBu_r", vmin=-_LARGEST_EVENTS, vmax=_LARGEST_EVENTS, interpolation="nearest")
    axis.set_title(title, fontsize=8)
    axis.set_axis_off()


def _counts(events: np.ndarray) -> str:
    return f"+{events.clip(min=0).sum():,.0f} -{-events.clip(max=0).sum():,.0f} events"


def _correlation(recorded: np.ndarray, predicted: np.ndarray) -> float:
    if min(recorded.std(), predicted.std()) <= 0:
        return 0.0
    return float(np.corrcoef(recorded.ravel(), predicted.ravel())[0, 1])


def with_error_map(path: Path) -> tuple[bytes, float]:
    """A PNG of render, reference and error side by side, made from one of render and reference; and the PSNR [dB] of
    the displayed values."""
    grey = read_picture(path, cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    render, reference = np.split(grey, 2, axis=1)
    difference = render.astype(float) - reference
    mse = float(np.mean(difference**2))
    psnr = 10 * np.log10(255**2 / mse) if mse else np.inf
    # Blue where the render is too dark, red where it is too bright, white where it is right.
    shown = (plt.get_cmap("RdBu_r")(0.5 + difference / 128)[..., 2::-1] * 255).astype(np.uint8)
    beside = [cv2.cvtColor(one, cv2.COLOR_GRAY2BGR) for one in (render, reference)]
    _, png = cv2.imencode(".png", np.concatenate([*beside, shown], axis=1))
    return png.tobytes(), float(psnr)
