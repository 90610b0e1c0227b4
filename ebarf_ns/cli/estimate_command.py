"""``ebarf trajectory estimate``: an initial trajectory from the events of a scene or a recording."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import tyro
from rich.console import Console
from rich.progress import SpinnerColumn, TextColumn, TimeElapsedColumn

from ebarf_ns.errors import SceneError
from ebarf_ns.odometry.settings import OdometrySettings
from ebarf_ns.printing import progress_shown

if TYPE_CHECKING:
    from ebarf_ns.odometry.estimate import Estimate
    from ebarf_ns.scene import Scene


@dataclass
class TrajectoryEstimate:
    """Estimate an initial trajectory from events alone, with points.ply and odometry.json, or say why it fails."""

    source: tyro.conf.Positional[Path]
    """A scene folder, with or without a trajectory, or a recording of any format."""
    camera: Path | None = None
    """For a recording: its calibration file."""
    camera_name: str | None = None
    """Name of the camera in that file."""
    part: str | None = None
    """For a recording: the group, topic or array of the events, if several have events."""
    output: Path | None = None
    """The TUM file to write; it must not exist. Default: trajectory.txt in the scene's or the current folder."""
    settings: tyro.conf.OmitArgPrefixes[OdometrySettings] = field(default_factory=OdometrySettings)
    """Settings of the estimation."""

    def run(self) -> None:
        """Estimate, write, and report the quality of the result."""
        from ebarf_ns.odometry.output import sentences, write_estimate

        stderr = Console(stderr=True)
        columns = TextColumn("{task.description}"), SpinnerColumn(), TimeElapsedColumn()
        with (
            tempfile.TemporaryDirectory() as folder,
            progress_shown(stderr, *columns) as progress,
        ):
            task = progress.add_task("reading", total=None)
            say = lambda step: progress.update(task, description=step)  # noqa: E731
            estimate, output, completed = self._estimate(Path(folder), say)
        write_estimate(estimate, output, completed)
        for sentence in (*sentences(estimate, completed), f"written: {output}, and its quality: odometry.json"):
            stderr.print(sentence, soft_wrap=True)

    def _estimate(self, folder: Path, progress: Callable[[str], None]) -> tuple[Estimate, Path, Scene | None]:
        """The estimate, its output path, and the scene that it completes, if any."""
        from ebarf_ns.formats.process import ProcessSettings, process
        from ebarf_ns.odometry.output import of_scene
        from ebarf_ns.scene import read_scene

        is_scene = (self.source / "scene.json").is_file()
        if is_scene and (self.camera or self.camera_name or self.part):
            raise SceneError(f"{self.source}: a scene knows its camera and events, expected no flags that say them")
        if is_scene:
            scene = read_scene(self.source, trajectory_to_come=True)
            output = self.output or scene.trajectory
        else:
            output = self.output or Path("trajectory.txt")
        for path in (output, output.with_name("points.ply"), output.with_name("odometry.json")):
            if path.exists():
                raise SceneError(
                    f"{path}: exists, expected --output with a new file's name, in a folder without {path.name}"
                )
        if not is_scene:
            settings = ProcessSettings(camera=self.camera, camera_name=self.camera_name, part=self.part, frames=False)
            process("auto", self.source, folder / "scene", settings)
            scene = read_scene(folder / "scene", trajectory_to_come=True)
        return of_scene(scene, self.settings, progress), output, scene if output == scene.trajectory else None
