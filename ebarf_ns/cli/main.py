"""The ``ebarf`` command: arguments in, one call, a message out."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
import yaml
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from ebarf_ns.benchmarks.settings import EngineBenchmark, RecordingsBenchmark
from ebarf_ns.cli.estimate_command import TrajectoryEstimate
from ebarf_ns.cli.export_commands import Mesh, Points, Render, TrajectoryExport
from ebarf_ns.cli.inspect_command import Inspect
from ebarf_ns.cli.replay import Replay
from ebarf_ns.errors import EbarfError, SceneError, one_line_errors
from ebarf_ns.files import refuse_existing
from ebarf_ns.formats.process import Format, ProcessSettings
from ebarf_ns.formats.trajectory_formats import TrajectoryFormat
from ebarf_ns.printing import print_json, print_line, progress_shown
from ebarf_ns.simulation.simulate import Simulation
from ebarf_ns.simulation.trajectory_errors import TrajectoryErrors, perturb

_ALIGNED_BY = {"sim3": "similarity (sim3)", "se3": "rigid motion (se3)", "orientation": "rotations"}


@dataclass
class Simulate:
    """Simulate a handheld event camera in a textured room, and write a scene folder with ground truth."""

    output: tyro.conf.Positional[Path]
    """The scene folder to make."""
    settings: tyro.conf.OmitArgPrefixes[Simulation] = field(default_factory=Simulation)
    """What to simulate."""

    def run(self) -> None:
        """Simulate with a progress bar."""
        from ebarf_ns.simulation.simulate import simulate

        refuse_existing(self.output)
        with progress_shown(_stderr) as progress:
            task = progress.add_task("simulating", total=1.0)
            simulate(self.settings, self.output, lambda fraction: progress.update(task, completed=fraction))
        _stderr.print(f"simulated scene in {self.output}; look at it with: ebarf inspect {self.output}")


@dataclass
class Process:
    """Make a scene folder from a recording in any known format; the source is only read, omissions are counted."""

    output: Path
    """The scene folder to make."""
    format: tyro.conf.Positional[Format] = "auto"
    """Format of the source; auto recognises dataset folders and recording files."""
    folder: tyro.conf.Positional[Path | None] = None
    """The recording: a dataset's folder as downloaded, or a file."""
    source: Path | None = None
    """The same, as a flag."""
    config: Path | None = None
    """A YAML file of flags, such as those in configs/ for public scenes; flags on the command line override it."""
    settings: tyro.conf.OmitArgPrefixes[ProcessSettings] = field(default_factory=ProcessSettings)
    """Properties that the source does not state."""

    def run(self) -> None:
        """Make the scene and print its contents."""
        from ebarf_ns.formats.process import process

        refuse_existing(self.output)
        source = self.folder or self.source
        if source is None:
            raise SceneError("no recording named, expected: ebarf process FORMAT SOURCE --output SCENE")
        columns = TextColumn("{task.description}"), SpinnerColumn(), TimeElapsedColumn()
        with progress_shown(_stderr, *columns) as progress:
            task = progress.add_task("reading", total=None)
            said = process(
                self.format,
                source,
                self.output,
                self.settings,
                lambda events: progress.update(task, description=f"{events:,} events"),
            )
        for sentence in said:
            _stderr.print(sentence, soft_wrap=True)


@dataclass
class TrajectoryCompare:
    """Errors of a trajectory against a reference, in any format that ebarf process reads.

    Positions are compared after Umeyama's alignment with scale (sim3) and without (se3), and after an alignment by the
    rotations, which is also defined for motion along a line. Rotations are compared after the best rotation of the
    world and, for estimates of another body on the same rig, also of the body.
    """

    estimate: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="ESTIMATE")]
    """The trajectory to judge."""
    reference: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="REFERENCE")]
    """The trajectory to compare it with."""
    known: tyro.conf.OmitArgPrefixes[TrajectoryFormat] = field(default_factory=TrajectoryFormat)
    """Properties that the estimate's file does not state."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Print the errors under each alignment."""
        from ebarf_ns.evaluation.compare import compare_files

        comparison = compare_files(self.estimate, self.reference, self.known)
        if self.json:
            print_json(comparison)
        else:
            self._print(comparison)

    def _print(self, comparison: dict[str, Any]) -> None:
        """Print a table with one alignment per row; positions are in the reference's unit."""
        console = Console(highlight=False)
        console.print(
            f"[bold]{escape(str(self.estimate))}[/bold] against [bold]{escape(str(self.reference))}[/bold], "
            f"{comparison['matched']} poses, root mean squares",
            soft_wrap=True,
        )
        table = Table("aligned by", "position", "scale", "rotation", "less a fixed rotation of the body", box=None)
        for alignment, words in _ALIGNED_BY.items():
            if error := comparison[alignment]:
                turns = (f"{error[name]:.3f}°" for name in ("rotation_deg", "rotation_deg_body"))
                table.add_row(words, f"{error['ate_m']:.4g}", f"{error['scale']:.4g}", *turns)
        console.print(table)
        for note in comparison["notes"]:
            print_line(console, note)


@dataclass
class TrajectoryPerturb:
    """Add odometry-like errors to a TUM file, as an imperfect trajectory for experiments."""

    source: tyro.conf.Positional[Path]
    output: tyro.conf.Positional[Path]
    errors: tyro.conf.OmitArgPrefixes[TrajectoryErrors] = field(default_factory=TrajectoryErrors)
    """The errors to add, in the trajectory's own unit."""
    seed: int = 0

    def run(self) -> None:
        """Write the perturbed trajectory."""
        from ebarf_ns.geometry.trajectory_file import read_tum, write_tum

        if self.output.resolve() == self.source.resolve():
            raise SceneError(f"{self.output}: the trajectory that is read, expected another file to write")
        perturbed = perturb(read_tum(self.source), self.errors, self.seed)
        write_tum(self.output, perturbed)
        _stderr.print(f"{len(perturbed.t_us)} perturbed poses in {self.output}")


@dataclass
class Evaluate:
    """Show a finished run's results from its folder, and write its report again."""

    run_folder: tyro.conf.Positional[Path]
    """The folder with config.yml and metrics.jsonl."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Print the last evaluation and the path of the report."""
        from ebarf_ns.evaluation.frames import lpips_note
        from ebarf_ns.evaluation.report import read_metrics, write_report
        from ebarf_ns.scene import read_scene

        header, evaluations = read_metrics(self.run_folder)
        try:
            groundtruth = read_scene(Path(header.get("scene", "scene"))).groundtruth
        except EbarfError as error:
            _stderr.print(f"the run's scene is gone, so the report has no reference trajectory ({error})")
            groundtruth = None
        page = write_report(self.run_folder, groundtruth)
        if missing := lpips_note(evaluations[-1]):
            _stderr.print(missing, soft_wrap=True)
        if self.json:
            print_json({**evaluations[-1], "method": header.get("method"), "report": str(page)})
        else:
            self._print(header, evaluations[-1], page)

    def _print(self, header: dict[str, Any], results: dict[str, Any], page: Path) -> None:
        from ebarf_ns.evaluation.verdict import verdict

        said = verdict(results)
        seconds = f", {results['train_seconds']:.0f} s of training" if results.get("train_seconds") else ""
        print(f"{said.headline} ({header.get('method')}, {results['step']:,} steps{seconds})")
        for reason in said.reasons:
            print(f"  {reason}")
        print(f"report: {page}\n--json prints all results")


@dataclass
class Trajectory:
    """Compare, perturb and export trajectories."""

    command: tyro.conf.OmitSubcommandPrefixes[
        Annotated[TrajectoryCompare, tyro.conf.subcommand("compare")]
        | Annotated[TrajectoryEstimate, tyro.conf.subcommand("estimate")]
        | Annotated[TrajectoryPerturb, tyro.conf.subcommand("perturb")]
        | Annotated[TrajectoryExport, tyro.conf.subcommand("export")]
    ]

    def run(self) -> None:
        """Run the chosen tool."""
        self.command.run()


@dataclass
class Bench:
    """Benchmark the engine's speed against nerfstudio's (engine), reading speed (recordings), or methods by error
    against run time (a manifest).

    A stopped comparison resumes where it stopped.
    """

    what: tyro.conf.Positional[str]
    """engine, recordings, or a manifest such as configs/benchmarks/shipped.yaml."""
    engine: tyro.conf.OmitArgPrefixes[EngineBenchmark] = field(default_factory=EngineBenchmark)
    """Settings of the engine benchmark."""
    recordings: tyro.conf.OmitArgPrefixes[RecordingsBenchmark] = field(default_factory=RecordingsBenchmark)
    """Settings of the recordings benchmark."""
    output: Path | None = None
    """For engine and recordings: a JSON file for the figures. For a comparison: the folder for scenes, runs, records
    and diagrams. Default: bench/ and the manifest's name."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Measure, print and save."""
        measure = {"engine": self._engine, "recordings": self._recordings}.get(self.what, self._comparison)
        result, shown = measure()
        if self.json:
            print_json(result)
        else:
            sys.stdout.write(shown + "\n")

    def _engine(self) -> tuple[dict[str, Any], str]:
        from ebarf_ns.benchmarks.engine import run_engine_benchmark
        from ebarf_ns.benchmarks.figures import table, write

        result = run_engine_benchmark(self.engine, _stderr.print)
        if self.output:
            write(result, self.output)
        return result, table(result)

    def _recordings(self) -> tuple[dict[str, Any], str]:
        from ebarf_ns.benchmarks.figures import table, write
        from ebarf_ns.benchmarks.recordings import run_recordings_benchmark

        result = run_recordings_benchmark(self.recordings, _stderr.print)
        if self.output:
            write(result, self.output)
        return result, table(result)

    def _comparison(self) -> tuple[dict[str, Any], str]:
        from ebarf_ns.benchmarks.comparison import run_comparison
        from ebarf_ns.benchmarks.manifest import read_manifest
        from ebarf_ns.evaluation.comparison_tables import tables
        from ebarf_ns.evaluation.diagrams import write_diagrams

        manifest = read_manifest(Path(self.what))
        folder = self.output or Path("bench") / manifest.name
        with Progress(*Progress.get_default_columns(), TimeElapsedColumn(), console=_stderr) as progress:
            task = progress.add_task("", total=None)
            result = run_comparison(
                manifest,
                folder,
                lambda done, of, what: progress.update(task, completed=done, total=of, description=what),
            )
        for path in write_diagrams(result, folder):
            _stderr.print(f"written: {path}", soft_wrap=True)
        return result, tables(result)


_stderr = Console(stderr=True)


def _with_config(words: list[str]) -> list[str]:
    """A command's arguments; those from the ``--config`` file come first, so that the others override them."""
    # "--config=FILE" is also accepted.
    split = [word.split("=", 1) if word.startswith("--config=") else [word] for word in words]
    words = [word for parts in split for word in parts]
    if words[:1] != ["process"] or "--config" not in words[:-1]:
        return words
    path = Path(words[words.index("--config") + 1])
    try:
        flags = yaml.safe_load(path.read_text(encoding="utf-8"))
        format_ = [flags.pop("format")] if "format" in flags else []
        found = [word for name, value in flags.items() for word in _flag(name, value, path.parent)]
    except (OSError, ValueError, yaml.YAMLError, AttributeError, TypeError) as error:
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise SceneError(f"{path}: {reason}; expected a YAML file of flags and their values") from None
    return ["process", *format_, *found, *words[1:]]


def _flag(name: str, value: Any, folder: Path) -> list[str]:
    words = [f"--{name}", *map(str, value if isinstance(value, list) else [value])]
    return [word.replace("{config}", str(folder)) for word in words]


def entrypoint() -> None:
    """The console script."""
    with one_line_errors():
        command = tyro.extras.subcommand_cli_from_dict(
            {
                "simulate": Simulate,
                "process": Process,
                "inspect": Inspect,
                "trajectory": Trajectory,
                "evaluate": Evaluate,
                "render": Render,
                "mesh": Mesh,
                "points": Points,
                "bench": Bench,
                "replay": Replay,
            },
            description=__doc__,
            args=_with_config(sys.argv[1:]),
        )
        command.run()
