"""Recognise the unit of a trajectory's times from their spacing, their size and the span of the events."""

from decimal import Decimal
from pathlib import Path

import numpy as np

from ebarf_ns.errors import TrajectoryError
from ebarf_ns.formats.raw_poses import TimeUnit

US: dict[TimeUnit, Decimal] = {"s": Decimal(10**6), "ms": Decimal(1000), "us": Decimal(1), "ns": Decimal("0.001")}
# Plausible spacings: 0.1 ms to 10 s, and for times in milliseconds, 1 to 1000 poses per second.
_SPACINGS_S: dict[TimeUnit, tuple[float, float]] = {
    "s": (1e-4, 10.0), "ms": (1e-3, 1.0), "us": (1e-4, 10.0), "ns": (1e-4, 10.0)
}  # fmt: skip
# Unix times from 2001 to 2100.
_DATES_S = (978e6, 4.1e9)
_LEAST_SHARE, _CLEARLY = 0.01, 10


def recognised_unit(path: Path, times: list[Decimal], span_us: tuple[int, int] | None = None) -> TimeUnit:
    """The unit for which the spacing of the poses is plausible; ``span_us`` is that of the events or a reference.

    Raises :class:`TrajectoryError` if several units are. Seconds or microseconds are preferred to milliseconds only if
    they match ``span_us`` and milliseconds do not.
    """
    steps = [abs(float(after - before)) for before, after in zip(times, times[1:], strict=False)]
    spacing = float(np.median(steps)) if steps else 0.0
    latest = float(max(times))
    fitting: list[TimeUnit] = []
    for unit, (shortest, longest) in _SPACINGS_S.items():
        second = 1e6 / float(US[unit])
        if shortest * second <= spacing * (1 + 1e-9) and spacing <= longest * second and latest <= _DATES_S[1] * second:
            fitting.append(unit)
    dated: list[TimeUnit] = [unit for unit in fitting if latest * float(US[unit]) * 1e-6 >= _DATES_S[0]]
    if len(dated) == 1:
        return dated[0]
    if len(fitting) == 2 and "ms" in fitting and span_us:
        other = fitting[1 - fitting.index("ms")]
        share, of_ms = _shared(times, other, span_us), _shared(times, "ms", span_us)
        if share >= _LEAST_SHARE and share > _CLEARLY * of_ms:
            return other
    if len(fitting) == 1:
        return fitting[0]
    raise TrajectoryError(
        f"{path}: poses are {spacing:g} apart (median), which is a plausible spacing in "
        f"{' and in '.join(fitting) or 'no unit'}; expected --pose-time-unit{_beside(times, fitting, span_us)}"
    )


def _beside(times: list[Decimal], fitting: list[TimeUnit], span_us: tuple[int, int] | None) -> str:
    """Hint for the user: the number of poses within the span of the events for each unit."""
    if not fitting:
        return ""
    said = ', or a unit as "[s]" in a line of names'
    if span_us is None:
        return said
    within = {unit: sum(span_us[0] <= time * US[unit] <= span_us[1] for time in times) for unit in fitting}
    counts = ", ".join(f"{count} in {unit}" for unit, count in within.items())
    return f"{said} (of {len(times)} poses, within {span_us[0]} to {span_us[1]} us: {counts})"


def _shared(times: list[Decimal], unit: TimeUnit, span_us: tuple[int, int]) -> float:
    """Intersection over union of both spans."""
    first, last = float(min(times) * US[unit]), float(max(times) * US[unit])
    common = min(last, span_us[1]) - max(first, span_us[0])
    return max(common, 0.0) / max(max(last, span_us[1]) - min(first, span_us[0]), 1.0)
