"""Terminal output of facts and warnings about a file or folder."""

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, ProgressColumn
from rich.table import Table


def print_facts(what: Path, suspicions: Sequence[str], facts: Sequence[tuple[str, str]]) -> Console:
    """Print warnings about a file or folder, then a table of named facts; returns the console."""
    console = Console(highlight=False)
    console.print(f"[bold]{escape(str(what))}[/bold]", soft_wrap=True)
    for suspicion in suspicions:
        print_line(console, suspicion, "[yellow]![/yellow] ")
    if not suspicions:
        console.print("[green]nothing suspicious[/green]")
    table = Table.grid(padding=(0, 2))
    for name, value in facts:
        table.add_row(name, escape(value))
    console.print(table)
    return console


def print_line(console: Console, line: str, mark: str = "") -> None:
    """Print one line, wrapped between words on a terminal and left unwrapped elsewhere."""
    console.print(mark + escape(line), soft_wrap=not console.is_terminal)


@contextmanager
def progress_shown(console: Console, *columns: ProgressColumn) -> Iterator[Progress]:
    """A progress display that leaves nothing behind; where the console is no terminal, nothing is shown."""
    progress = Progress(*columns, transient=True, console=console)
    if not console.is_terminal:
        # Older rich leaves an empty line there, even if it is told to show nothing.
        yield progress
        return
    with progress:
        yield progress


def print_json(content: dict[str, Any]) -> None:
    """Print one JSON object on a line, for programs."""
    sys.stdout.write(json.dumps(content) + "\n")
