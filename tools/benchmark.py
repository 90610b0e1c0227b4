"""The README's table: methods on simulated scenes, or on one scene folder, some seeds each.

python tools/benchmark.py OUTPUT.json --methods ebarf enerf --seconds 100 --seeds 0 1 2 [--scene SCENE]
"""

import argparse
import json
import shlex
import statistics
import subprocess
import sys
import tempfile
from datetime import date
from pathlib import Path
from typing import Any

from ebarf_ns.benchmarks.engine import machine
from ebarf_ns.benchmarks.training import train as train_in_process

COLUMNS = {
    "heldout_event_loss": "unexplained events",
    "psnr": "PSNR [dB]",
    "ate_m": "position error, sim3 [m]",
    "ate_m_orientation": "position error, orientation [m]",
    "rotation_deg": "rotation error [deg]",
    "event_pairs": "event pairs",
}


def run(*words: object) -> None:
    """Run a console script of this environment."""
    name, *arguments = map(str, words)
    subprocess.run([Path(sys.executable).parent / name, *arguments], check=True, stdout=subprocess.DEVNULL)


def train(method: str, scene: Path, seconds: float, seed: int, folder: Path) -> dict[str, Any]:
    """One training; its last evaluation, and the initial trajectory's errors."""
    evaluations = train_in_process([method], scene, folder / f"{method}-{seed}" / method / "run", seed, seconds, 8)
    return {"method": method, "seed": seed, "seconds": seconds, **evaluations[-1]}


def table(records: list[dict[str, Any]]) -> str:
    """Medians over the seeds, as Markdown."""
    columns = [name for name in COLUMNS if any(record.get(name) is not None for record in records)]
    lines = ["| method | seconds | seeds | " + " | ".join(COLUMNS[name] for name in columns) + " |"]
    lines.append("|---" * (3 + len(columns)) + "|")
    for method, seconds in dict.fromkeys((record["method"], record["seconds"]) for record in records):
        same = [record for record in records if (record["method"], record["seconds"]) == (method, seconds)]
        medians = [statistics.median(record[name] for record in same) for name in columns]
        cells = " | ".join(f"{value:,.0f}" if value > 1000 else f"{value:.3g}" for value in medians)
        lines.append(f"| `{method}` | {seconds:g} | {len(same)} | {cells} |")
    return "\n".join(lines)


def main() -> None:
    """Simulate, train, write the records, print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("output", type=Path)
    parser.add_argument("--methods", nargs="+", default=["ebarf", "enerf"])
    parser.add_argument("--seconds", type=float, default=100)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--scene", type=Path, help="a scene folder; a simulated one for each seed where not given")
    options = parser.parse_args()
    records = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for seed in options.seeds:
            scene = options.scene or folder / f"scene-{seed}"
            if not options.scene:
                run("ebarf", "simulate", scene, "--seed", seed)
            for method in options.methods:
                records.append(train(method, scene, options.seconds, seed, folder))
                print(records[-1], flush=True)
    content = {
        "date": date.today().isoformat(),
        "machine": machine(),
        "command": shlex.join(["python", *sys.argv]),
        "records": records,
    }
    options.output.write_text(json.dumps(content, indent=1) + "\n")
    print(table(records))


if __name__ == "__main__":
    main()
