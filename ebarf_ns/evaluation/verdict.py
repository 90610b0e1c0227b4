"""The verdict on a run: whether to trust it, and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

_GOOD, _DOUBTFUL = 0.3, 0.5
_RELATED = 0.5
_UNEVEN_THRESHOLDS = 2.5
Mark = Literal["good", "doubtful", "bad"]
_HEADLINES: dict[Mark, str] = {
    "good": "The field explains the recording.",
    "doubtful": "The field explains only part of the recording.",
    "bad": "The field does not explain the recording: do not trust its renders.",
}


@dataclass(frozen=True)
class Verdict:
    """The verdict on a run, with its reasons."""

    mark: Mark
    headline: str
    reasons: tuple[str, ...]


def verdict(results: Mapping[str, Any], moved: tuple[float, float] | None = None) -> Verdict:
    """Return the verdict on a run from its last evaluation and its pose correction (share of the extent, degrees).

    Held-out events decide: up to 30 % unexplained is good, more than half is bad. If they support the given trajectory
    over the refined one, or renders correlate weakly with frames, the verdict is doubtful at best.
    """
    reasons, mark = [], "doubtful"
    unexplained = results.get("heldout_event_loss")
    if unexplained is not None:
        mark = "good" if unexplained <= _GOOD else "doubtful" if unexplained <= _DOUBTFUL else "bad"
        reasons.append(f"{max(1 - unexplained, 0.0):.0%} of the changes reported by held-out events are explained")
    support = results.get("support") or {}
    if support.get("verdict") == "worse":
        mark = "doubtful" if mark == "good" else mark
        reasons.append("held-out events support the given trajectory, not the refined one")
    elif support.get("verdict") == "better":
        undecided = ", though its positions moved by less than is certain" if support.get("positions_undecided") else ""
        reasons.append(f"held-out events support the refined trajectory, not the given one{undecided}")
    if results.get("inverted"):
        mark = "bad"
        reasons.append("renders are inverted: bright where the frames are dark")
    correlation = results.get("log_correlation")
    if correlation is not None and correlation < _RELATED:
        mark = "doubtful" if mark == "good" else mark
        reasons.append(f"the brightness of renders hardly follows that of the frames (correlation {correlation:.2f})")
    if results.get("psnr") is not None:
        reasons.append(f"held-out frames are reproduced with a PSNR of {results['psnr']:.1f} dB")
    if moved is not None:
        reasons.append(f"the trajectory was moved by {moved[0]:.1%} of its extent and {moved[1]:.2f}°")
    if results.get("clock_offset_ms"):
        deviation = results.get("clock_deviation_ms") or 0.0
        reasons.append(f"the trajectory's clock was off by {results['clock_offset_ms']:.1f} ± {deviation:.1f} ms")
    on, off = results.get("implied_threshold_on"), results.get("implied_threshold_off")
    if on and off and on > 0 and off > 0:
        uneven = not 1 / _UNEVEN_THRESHOLDS < on / off < _UNEVEN_THRESHOLDS
        reasons.append(f"the threshold ratio C_on / C_off is {on / off:.2f}{', which is unusual' if uneven else ''}")
    if results.get("skipped_steps"):
        reasons.append(f"{results['skipped_steps']} steps were skipped because of values that were not finite")
    return Verdict(mark, _HEADLINES[mark], tuple(reasons))
