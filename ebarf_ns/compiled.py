"""Compiled functions, kept on disk from one run to the next where there is a place that can be written."""

from collections.abc import Callable
from typing import Any, TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def njit(**options: Any) -> Callable[[Function], Function]:
    """``numba.njit``; where ``cache`` finds no folder to write to, each process compiles for itself."""

    def compiled(function: Function) -> Function:
        try:
            return numba.njit(**options)(function)  # pyright: ignore
        except RuntimeError:
            # A container's root may be read-only, with no home.
            return numba.njit(**{**options, "cache": False})(function)  # pyright: ignore

    return compiled
