"""``ebarf replay``."""

import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import tyro


@dataclass
class Replay:
    """Repeat the step whose bad numbers ended a training, and say where they begin."""

    file: tyro.conf.Positional[Path]
    """A replay-*.pt file in a run's folder."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Print what was found."""
        from ebarf_ns.nerf.replay import replay

        found = replay(self.file)
        sys.stdout.write((json.dumps(asdict(found)) if self.json else "\n".join(found.lines())) + "\n")
