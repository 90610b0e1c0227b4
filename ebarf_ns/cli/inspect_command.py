"""``ebarf inspect``: the contents of a scene or a recording, and what looks wrong."""

from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from ebarf_ns.errors import RecordingError, SceneError, did_you_mean
from ebarf_ns.formats.source import TimeUnit
from ebarf_ns.printing import print_json


@dataclass
class Inspect:
    """Show the contents of a scene folder or of a recording in any format, and what looks wrong."""

    scene: tyro.conf.Positional[Path]
    """A scene folder, or a recording."""
    picture: Path | None = None
    """A PNG to write, with events at several times."""
    part: str | None = None
    """For a recording: the HDF5 group or bag topic of the events, if several have events."""
    event_time_unit: TimeUnit | None = None
    """For a recording: the unit of its times, if it does not state it."""
    event_columns: str | None = None
    """For a recording: the order of unnamed columns, such as 'x y p t'."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def run(self) -> None:
        """Print the summary."""
        from ebarf_ns.formats.recognise import recognised_folder

        if not self.scene.exists():
            raise SceneError(
                f"{self.scene}: no such file or folder, expected a scene or a recording{did_you_mean(self.scene)}"
            )
        if self.picture and self.picture.suffix.lower() != ".png":
            raise RecordingError(f"--picture is {self.picture}, expected the name of a .png file to make")
        # A folder that is neither is treated as a scene, so that the error says what it lacks.
        if not (self.scene / "scene.json").exists() and (self.scene.is_file() or recognised_folder(self.scene)):
            summary = self._recording(self.scene)
        else:
            self._refuse_dataset()
            summary = self._scene()
        if self.json:
            print_json(asdict(summary))
        elif self.picture:
            Console().print(f"picture  {self.picture}", soft_wrap=True, highlight=False)

    def _refuse_dataset(self) -> None:
        """Raise :class:`SceneError` for the folder of a dataset, which is made into a scene first."""
        from ebarf_ns.formats.layouts import recognised_layout

        is_scene = any((self.scene / name).exists() for name in ("scene.json", "trajectory.txt"))
        if is_scene:
            return
        with suppress(SceneError):
            layout = recognised_layout(self.scene)
            raise RecordingError(
                f"{self.scene}: the folder of a recording ({layout}), expected a scene or the recording's file; make "
                f"a scene: ebarf process auto {self.scene} --output SCENE"
            )

    def _recording(self, events: Path, size: tuple[int, int] | None = None, shown: bool = True) -> Any:
        from ebarf_ns.formats.raw_inspection import contact_sheet, inspect_recording, print_raw_summary
        from ebarf_ns.formats.recognise import open_recording

        known = partial(
            open_recording, events, part=self.part, time_unit=self.event_time_unit, columns=self.event_columns
        )
        opened = known if size is None else lambda: replace(known(), sensor_size=size)
        summary = inspect_recording(opened)
        if self.picture:
            contact_sheet(opened, summary, self.picture)
        if shown and not self.json:
            print_raw_summary(summary, events)
        return summary

    def _scene(self) -> Any:
        from ebarf_ns.inspection import inspect_scene, print_summary
        from ebarf_ns.scene import read_scene

        scene = read_scene(self.scene, trajectory_to_come=True)
        if not scene.trajectory.is_file():
            summary = self._recording(scene.events, (scene.camera.width, scene.camera.height))
            if not self.json:
                how = f"training estimates one first, as does ebarf trajectory estimate {self.scene}"
                Console().print(f"no trajectory yet: {how}", soft_wrap=True, highlight=False)
            return summary
        summary = inspect_scene(self.scene)
        if self.picture:
            self._recording(scene.events, shown=False)
        if not self.json:
            print_summary(summary, self.scene)
        return summary
