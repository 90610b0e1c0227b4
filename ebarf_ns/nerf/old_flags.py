"""Flags under the names that they had before: they work for one more version."""

import sys
from collections.abc import Sequence

OLD_FLAGS = {
    "--pipeline.model.outliers-from": "--pipeline.model.huber-delta",
}
"""Old name to new; a name goes one version after it came here."""


def old_names(flag: str) -> list[str]:
    """Those of a flag, for tyro's ``aliases``."""
    return [old for old, new in OLD_FLAGS.items() if new == flag]


def warn_of_old_flags(words: Sequence[str]) -> None:
    """One line on standard error for each old name among a command's words."""
    for word in words:
        old = word.split("=", 1)[0].replace("_", "-")
        if old in OLD_FLAGS:
            sys.stderr.write(
                f"warning: {old} is now called {OLD_FLAGS[old]}; the old name goes with the next version\n"
            )
