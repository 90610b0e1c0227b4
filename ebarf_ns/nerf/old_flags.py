"""Former names of flags, which work for one more version."""

import sys
from collections.abc import Sequence

OLD_FLAGS = {
    "--pipeline.model.outliers-from": "--pipeline.model.huber-delta",
}
"""Old name to new name; an entry is removed one version after it was added."""


def old_names(flag: str) -> list[str]:
    """The former names of a flag, for tyro's ``aliases``."""
    return [old for old, new in OLD_FLAGS.items() if new == flag]


def warn_of_old_flags(words: Sequence[str]) -> None:
    """Print a warning to standard error for each former name among a command's arguments."""
    for word in words:
        old = word.split("=", 1)[0].replace("_", "-")
        if old in OLD_FLAGS:
            sys.stderr.write(f"warning: {old} is now called {OLD_FLAGS[old]}; the next version removes the old name\n")
