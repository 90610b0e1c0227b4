"""Compiled functions, cached on disk between runs if a folder is writable."""

from collections.abc import Callable
from typing import Any, TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def njit(**options: Any) -> Callable[[Function], Function]:
    """``numba.njit``; if ``cache`` finds no writable folder, each process compiles for itself."""

    def compiled(function: Function) -> Function:
        try:
            return numba.njit(**options)(function)  # pyright: ignore
        except RuntimeError:
            # A container may have a read-only root and no home folder.
            return numba.njit(**{**options, "cache": False})(function)  # pyright: ignore

    return compiled
