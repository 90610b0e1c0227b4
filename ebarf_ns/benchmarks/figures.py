"""Measured figures and their targets."""

from __future__ import annotations

import json
import math
import os
import platform
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from ebarf_ns.files import whole_file


@dataclass(frozen=True)
class Figure:
    """One measured number and, optionally, its target."""

    what: str
    value: float | None
    unit: str
    at_least: float | None = None
    at_most: float | None = None

    @property
    def verdict(self) -> str:
        """Whether the target is met; empty without a target."""
        if self.value is None:
            return "not measured"
        if self.at_least is not None:
            return "reached" if self.value >= self.at_least else "missed"
        if self.at_most is not None:
            return "reached" if self.value <= self.at_most else "missed"
        return ""

    @property
    def target(self) -> str:
        """The target as text."""
        if self.at_least is not None:
            return f">= {self.at_least:g}"
        return f"<= {self.at_most:g}" if self.at_most is not None else ""


def machine() -> str:
    """Human-readable name of the GPU or processor."""
    if torch.cuda.is_available():
        return f"one {torch.cuda.get_device_name()}"
    name = platform.processor() or platform.machine()
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), name)
    return f"{os.cpu_count()} cores of {name}"


def shown(value: float | None) -> str:
    """Format a figure for display."""
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def table(result: dict[str, Any]) -> str:
    """The figures as a Markdown table."""
    lines = [f"{result['machine']}, {result['date']}", "", "| what | measured | target | |", "|---|---|---|---|"]
    for one in result["figures"]:
        figure = Figure(**{name: value for name, value in one.items() if name != "verdict"})
        lines.append(f"| {figure.what} | {shown(figure.value)} {figure.unit} | {figure.target} | {figure.verdict} |")
    return "\n".join(lines)


def write(result: dict[str, Any], path: Path) -> None:
    """Write the figures as JSON."""
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
