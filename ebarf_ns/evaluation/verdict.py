"""A run in plain words: whether to believe it, and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

_GOOD, _DOUBTFUL = 0.3, 0.5
_UNEVEN_THRESHOLDS = 2.5
Mark = Literal["good", "doubtful", "bad"]
_WORDS: dict[Mark, str] = {
    "good": "The field explains the recording.",
    "doubtful": "The field explains the recording in part.",
    "bad": "The field does not explain the recording: do not trust its pictures.",
}


@dataclass(frozen=True)
class Verdict:
    """What to think of a run."""

    mark: Mark
    headline: str
    reasons: tuple[str, ...]


def verdict(results: Mapping[str, Any], moved: tuple[float, float] | None = None) -> Verdict:
    """Of the last evaluation's numbers, and by how much (share of its extent, degrees) the trajectory was moved.

    Held-out events decide: up to 30 % unexplained is good, beyond half is bad; and where they support the trajectory
    as it was given, it is doubtful at best.
    """
    reasons, mark = [], "doubtful"
    unexplained = results.get("heldout_event_loss")
    if unexplained is not None:
        mark = "good" if unexplained <= _GOOD else "doubtful" if unexplained <= _DOUBTFUL else "bad"
        reasons.append(f"{max(1 - unexplained, 0.0):.0%} of the changes that held-out events report are explained")
    support = results.get("support") or {}
    if support.get("verdict") == "worse":
        mark = "doubtful" if mark == "good" else mark
        reasons.append("held-out events support the trajectory as it was given, not the refined one")
    elif support.get("verdict") == "better":
        reasons.append("held-out events support the refined trajectory, not the one given")
    if results.get("inverted"):
        mark = "bad"
        reasons.append("pictures are inverted: bright where the frames are dark")
    if results.get("psnr") is not None:
        reasons.append(f"frames that were never used are met with {results['psnr']:.1f} dB")
    if moved is not None:
        reasons.append(f"the trajectory was moved by {moved[0]:.1%} of its extent and {moved[1]:.2f}°")
    if results.get("clock_offset_ms"):
        deviation = results.get("clock_deviation_ms") or 0.0
        reasons.append(f"its clock was off by {results['clock_offset_ms']:.1f} ± {deviation:.1f} ms")
    on, off = results.get("implied_threshold_on"), results.get("implied_threshold_off")
    if on and off and on > 0 and off > 0:
        odd = not 1 / _UNEVEN_THRESHOLDS < on / off < _UNEVEN_THRESHOLDS
        reasons.append(f"the thresholds' ratio C_on / C_off is {on / off:.2f}{', which is unusual' if odd else ''}")
    if results.get("skipped_steps"):
        reasons.append(f"{results['skipped_steps']} steps were skipped for numbers that were not finite")
    return Verdict(mark, _WORDS[mark], tuple(reasons))
