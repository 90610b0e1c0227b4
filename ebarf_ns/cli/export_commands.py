"""The commands that export a finished run."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import tyro
from rich.console import Console

from ebarf_ns.errors import ExportError, RecordingError
from ebarf_ns.export.settings import RenderSettings, SurfaceSettings, TrajectoryFileFormat
from ebarf_ns.files import refuse_existing
from ebarf_ns.printing import progress_shown

if TYPE_CHECKING:
    from ebarf_ns.nerf.finished_run import FinishedRun

_stderr = Console(stderr=True)


@dataclass
class Render:
    """Render a finished run along its refined trajectory, as pictures, a video, or predicted events."""

    run_folder: tyro.conf.Positional[Path]
    """The folder with config.yml."""
    settings: tyro.conf.OmitArgPrefixes[RenderSettings] = field(default_factory=RenderSettings)
    """Which pictures to render."""
    output: Path | None = None
    """The video or the folder of pictures to write. Default: in exports/ of the run."""
    events: Path | None = None
    """Write predicted events to this HDF5 file (/events/x, y, t, p) instead of pictures."""

    def run(self) -> None:
        """Render, and print where the output is."""
        from ebarf_ns.export.pictures import render

        if self.events:
            self._events(self.events)
            return
        kind = self.settings.format
        output = self.output or self.run_folder / "exports" / ("video.mp4" if kind == "mp4" else kind)
        if kind != "mp4":
            refuse_existing(output)
        with _opened(self.run_folder, "rendering") as (finished, progress):
            count = render(finished, self.settings, output, progress)
        _stderr.print(f"{count:,} picture{'s' * (count != 1)}: {output}", soft_wrap=True)

    def _events(self, path: Path) -> None:
        from ebarf_ns.export.resimulation import agreement, recorded, write_events

        with _opened(self.run_folder, "simulating") as (finished, progress):
            if path.exists() and finished.scene.events.exists() and path.samefile(finished.scene.events):
                raise ExportError(f"{path}: is the recording itself, expected a different file")
            predicted = write_events(finished, self.settings, path, progress)
        _stderr.print(f"{len(predicted):,} predicted events: {path}", soft_wrap=True)
        try:
            real = recorded(finished, self.settings)
        except RecordingError as error:
            _stderr.print(f"no comparison with the recording ({error})", soft_wrap=True)
            return
        camera = finished.scene.camera
        found = agreement(predicted, real, camera.width, camera.height)
        _stderr.print(
            f"{len(real):,} events were recorded in that time; counts per pixel correlate by "
            f"{found['brighter_correlation']:.3f} (brighter) and {found['darker_correlation']:.3f} (darker)",
            soft_wrap=True,
        )


@dataclass
class Mesh:
    """Export the surfaces of a finished run as a grey PLY mesh, in the trajectory's frame and scale."""

    run_folder: tyro.conf.Positional[Path]
    """The folder with config.yml."""
    settings: tyro.conf.OmitArgPrefixes[SurfaceSettings] = field(default_factory=SurfaceSettings)
    """Which surface."""
    output: Path | None = None
    """The .ply file to write. Default: exports/mesh.ply of the run."""

    def run(self) -> None:
        """Write the mesh, and print where it is."""
        from ebarf_ns.export.surface import write_mesh

        output = _ply(self.output or self.run_folder / "exports" / "mesh.ply")
        with _opened(self.run_folder, "rendering views") as (finished, progress):
            vertices, faces = write_mesh(finished, self.settings, output, progress)
        _stderr.print(f"{vertices:,} vertices, {faces:,} faces: {output}", soft_wrap=True)


@dataclass
class Points:
    """Export the surfaces of a finished run as a grey PLY point cloud, in the trajectory's frame and scale."""

    run_folder: tyro.conf.Positional[Path]
    """The folder with config.yml."""
    settings: tyro.conf.OmitArgPrefixes[SurfaceSettings] = field(default_factory=SurfaceSettings)
    """Which surface."""
    output: Path | None = None
    """The .ply file to write. Default: exports/points.ply of the run."""

    def run(self) -> None:
        """Write the point cloud, and print where it is."""
        from ebarf_ns.export.surface import write_points

        output = _ply(self.output or self.run_folder / "exports" / "points.ply")
        with _opened(self.run_folder, "rendering views") as (finished, progress):
            count = write_points(finished, self.settings, output, progress)
        _stderr.print(f"{count:,} points: {output}", soft_wrap=True)


@dataclass
class TrajectoryExport:
    """Export a finished run's refined trajectory for other programs such as evo, COLMAP and nerfstudio.

    It is in the frame and scale of the given trajectory, on the clock of the events.
    """

    run_folder: tyro.conf.Positional[Path]
    """The folder with config.yml."""
    format: TrajectoryFileFormat
    """tum, kitti: a text file. colmap, transforms: a folder with rendered pictures and a point cloud."""
    output: Path | None = None
    """The file or folder to write. Default: in exports/ of the run."""
    rate_hz: float | None = None
    """Poses per second. Default: the poses of the keyframes (at most 300 for colmap and transforms)."""

    def run(self) -> None:
        """Write the trajectory, and print where it is."""
        from ebarf_ns.export.trajectory import export_trajectory

        folder = self.format in ("colmap", "transforms")
        name = self.format if folder else f"trajectory_{self.format}.txt"
        output = self.output or self.run_folder / "exports" / name
        if folder:
            refuse_existing(output)
        with _opened(self.run_folder, "rendering") as (finished, progress):
            poses, points = export_trajectory(finished, self.format, output, self.rate_hz, progress)
        if folder and not points:
            _stderr.print("warning: no surface is sharp enough, the point cloud is empty", soft_wrap=True)
        _stderr.print(f"{poses:,} poses: {output}", soft_wrap=True)


def _ply(path: Path) -> Path:
    if path.suffix.lower() != ".ply":
        raise ExportError(f"{path}: expected the name of a .ply file")
    return path


@contextmanager
def _opened(run_folder: Path, activity: str) -> "Iterator[tuple[FinishedRun, Callable[[float], None]]]":
    """Yield the finished run, and a function that reports progress from 0 to 1."""
    # Warnings of torch and nerfstudio about their own code.
    warnings.filterwarnings("ignore", category=FutureWarning)
    from ebarf_ns.nerf.finished_run import open_run

    with progress_shown(_stderr) as shown:
        task = shown.add_task("opening the run", total=None)
        finished = open_run(run_folder)
        announced = _stderr.is_terminal

        def progress(share: float) -> None:
            nonlocal announced
            if not announced:
                _stderr.print(f"{activity}: may take minutes", soft_wrap=True)
                announced = True
            shown.update(task, description=activity, completed=share, total=1.0)

        yield finished, progress
