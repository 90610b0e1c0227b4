"""The commands that export a finished run."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import tyro
from rich.console import Console
from rich.progress import Progress

from ebarf_ns.errors import ExportError, RecordingError
from ebarf_ns.export.settings import RenderSettings, SurfaceSettings, TrajectoryFileFormat
from ebarf_ns.files import refuse_existing

if TYPE_CHECKING:
    from ebarf_ns.nerf.finished_run import FinishedRun

_stderr = Console(stderr=True)


@dataclass
class Render:
    """Pictures or a video of a finished run's scene along its refined trajectory, or the events that it predicts."""

    run_folder: tyro.conf.Positional[Path]
    """The folder with config.yml."""
    settings: tyro.conf.OmitArgPrefixes[RenderSettings] = field(default_factory=RenderSettings)
    """Which pictures."""
    output: Path | None = None
    """The video, or the folder of pictures, to make; where not given, in exports/ of the run."""
    events: Path | None = None
    """Instead of pictures: an HDF5 file to make, with what the sensor should have reported, /events/x y t p."""

    def run(self) -> None:
        """Render, and say where it is."""
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
        _stderr.print(f"{count:,} pictures: {output}", soft_wrap=True)

    def _events(self, path: Path) -> None:
        from ebarf_ns.export.resimulation import agreement, recorded, write_events

        with _opened(self.run_folder, "simulating") as (finished, progress):
            if path.exists() and finished.scene.events.exists() and path.samefile(finished.scene.events):
                raise ExportError(f"{path}: is the recording itself, expected another file")
            predicted = write_events(finished, self.settings, path, progress)
        _stderr.print(f"{len(predicted):,} predicted events: {path}", soft_wrap=True)
        try:
            real = recorded(finished, self.settings)
        except RecordingError as error:
            _stderr.print(f"not compared with the recording ({error})", soft_wrap=True)
            return
        camera = finished.scene.camera
        found = agreement(predicted, real, camera.width, camera.height)
        _stderr.print(
            f"{len(real):,} were recorded in that time; counts per pixel correlate by "
            f"{found['brighter_correlation']:.3f} (brighter) and {found['darker_correlation']:.3f} (darker)",
            soft_wrap=True,
        )


@dataclass
class Mesh:
    """A mesh of the surfaces that a finished run has found, grey, in the trajectory's frame and scale: PLY."""

    run_folder: tyro.conf.Positional[Path]
    """The folder with config.yml."""
    settings: tyro.conf.OmitArgPrefixes[SurfaceSettings] = field(default_factory=SurfaceSettings)
    """Which surface."""
    output: Path | None = None
    """The .ply file to make; where not given, exports/mesh.ply of the run."""

    def run(self) -> None:
        """Write the mesh, and say where it is."""
        from ebarf_ns.export.surface import write_mesh

        output = _ply(self.output or self.run_folder / "exports" / "mesh.ply")
        with _opened(self.run_folder, "looking around") as (finished, progress):
            vertices, faces = write_mesh(finished, self.settings, output, progress)
        _stderr.print(f"{vertices:,} vertices, {faces:,} faces: {output}", soft_wrap=True)


@dataclass
class Points:
    """A cloud of points of the surfaces that a finished run has found, grey, in the trajectory's frame: PLY."""

    run_folder: tyro.conf.Positional[Path]
    """The folder with config.yml."""
    settings: tyro.conf.OmitArgPrefixes[SurfaceSettings] = field(default_factory=SurfaceSettings)
    """Which surface."""
    output: Path | None = None
    """The .ply file to make; where not given, exports/points.ply of the run."""

    def run(self) -> None:
        """Write the cloud, and say where it is."""
        from ebarf_ns.export.surface import write_points

        output = _ply(self.output or self.run_folder / "exports" / "points.ply")
        with _opened(self.run_folder, "looking around") as (finished, progress):
            count = write_points(finished, self.settings, output, progress)
        _stderr.print(f"{count:,} points: {output}", soft_wrap=True)


@dataclass
class TrajectoryExport:
    """A finished run's refined trajectory for other programs: evo, COLMAP's readers, nerfstudio and what reads these.

    In the frame and scale of the trajectory given, on the clock of the events.
    """

    run_folder: tyro.conf.Positional[Path]
    """The folder with config.yml."""
    format: TrajectoryFileFormat
    """tum, kitti: a text file. colmap, transforms: a folder with rendered pictures and a cloud of points."""
    output: Path | None = None
    """The file or folder to make; where not given, in exports/ of the run."""
    rate_hz: float | None = None
    """Poses per second; where not given, those of the keyframes (of colmap and transforms, at most 300)."""

    def run(self) -> None:
        """Write the trajectory, and say where it is."""
        from ebarf_ns.export.trajectory import export_trajectory

        folder = self.format in ("colmap", "transforms")
        name = self.format if folder else f"trajectory_{self.format}.txt"
        output = self.output or self.run_folder / "exports" / name
        if folder:
            refuse_existing(output)
        with _opened(self.run_folder, "rendering") as (finished, progress):
            poses, points = export_trajectory(finished, self.format, output, self.rate_hz, progress)
        if folder and not points:
            _stderr.print("warning: no surface is seen sharply enough, the cloud of points is empty", soft_wrap=True)
        _stderr.print(f"{poses:,} poses: {output}", soft_wrap=True)


def _ply(path: Path) -> Path:
    if path.suffix.lower() != ".ply":
        raise ExportError(f"{path}: expected the name of a .ply file")
    return path


@contextmanager
def _opened(run_folder: Path, what: str) -> "Iterator[tuple[FinishedRun, Callable[[float], None]]]":
    """The run, and whom to tell how far one is."""
    from ebarf_ns.nerf.finished_run import open_run

    with Progress(transient=True, console=_stderr, disable=not _stderr.is_terminal) as shown:
        task = shown.add_task("opening the run", total=None)
        finished = open_run(run_folder)
        yield finished, lambda share: shown.update(task, description=what, completed=share, total=1.0)
