"""One training as a user would run it, in a subprocess."""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ebarf_ns.errors import BenchmarkError


def train(
    words: Sequence[str], scene: Path, run: Path, seed: int, seconds: float, evaluations: int
) -> list[dict[str, Any]]:
    """Run ``ns-train`` with the given method and flags in the folder ``run`` and return its evaluations.

    Raises :class:`BenchmarkError` with the last line of output if the training fails.
    """
    method, *flags = words
    command = [
        Path(sys.executable).parent / "ns-train", method, "--data", scene, "--output-dir", run.parents[2],
        "--experiment-name", run.parents[1].name, "--timestamp", run.name, "--machine.seed", seed,
        "--max-train-seconds", seconds, "--max-num-iterations", 10**7, "--evaluations", evaluations,
        "--vis", "tensorboard", "--logging.local-writer.enable", "False", *flags,
    ]  # fmt: skip
    finished = subprocess.run([str(word) for word in command], capture_output=True, text=True, check=False)
    if finished.returncode:
        last = (finished.stderr.strip() or finished.stdout.strip() or "no message").splitlines()[-1]
        raise BenchmarkError(f"ns-train {method} on {scene} ended with code {finished.returncode}: {last}")
    lines = (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    return [json.loads(line) for line in lines[1:]]
