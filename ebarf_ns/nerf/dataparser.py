"""Scene folder to nerfstudio cameras: one per keyframe for training, one per frame for evaluation.

Imports little, since nerfstudio imports this module while it is itself only partly loaded.
"""

import re
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import torch
import tyro
from jaxtyping import Float, Int64
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataParser, DataParserConfig, DataparserOutputs
from nerfstudio.data.scene_box import SceneBox
from nerfstudio.plugins.registry_dataparser import DataParserSpecification
from torch import Tensor

from ebarf_ns.errors import SceneError, one_line_errors
from ebarf_ns.files import whole_folder
from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.geometry.trajectory import Poses, Trajectory, interpolate, within_span
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.scene import Frame, Scene, box_of_bounds, check_bounds, read_scene, write_scene

# Without bounds, the trajectory fills this share of the uncontracted part of space.
_TRAJECTORY_SHARE = 0.25
_STAND_IN_VIEWS = 8
_ASIDE_PX = 1e-3
# The data manager's entry, which takes precedence; the parts of the path may be on separate lines.
_DATA = re.compile(r"^    data:.*\n((?:    - .*\n)*)", re.MULTILINE)


class Normalization(NamedTuple):
    """World to training coordinates: (point - centre) * scale; the scene's longest side fills [-1, 1]."""

    centre: Float[Tensor, "3"]
    scale: float
    half_sides: Float[Tensor, "3"]
    """Half the side lengths of the scene, in training coordinates."""

    def apply(self, trajectory: Trajectory) -> Trajectory:
        """World poses to training coordinates, float32."""
        position, quat_wxyz = trajectory.poses
        moved = (position.double() - self.centre) * self.scale
        return Trajectory(trajectory.t_us, Poses(moved.float(), quat_wxyz.float()))

    def invert(self, trajectory: Trajectory) -> Trajectory:
        """Training coordinates to world poses, float64."""
        position, quat_wxyz = trajectory.poses
        return Trajectory(
            trajectory.t_us, Poses(position.double().cpu() / self.scale + self.centre, quat_wxyz.double().cpu())
        )


@dataclass
class EbarfDataParserConfig(DataParserConfig):
    """A scene folder: scene.json, events, trajectory."""

    _target: type = field(default_factory=lambda: EbarfDataParser)
    data: Path = Path("scene")
    """The scene folder."""
    kept: tyro.conf.Suppress[Path | None] = None
    """The run's own copy of its scene, used if the scene is gone; set by training."""


@dataclass
class EbarfDataParser(DataParser):
    """Reads scene.json and the trajectory; the data manager reads the recording."""

    config: EbarfDataParserConfig

    def __init__(self, config: EbarfDataParserConfig):
        super().__init__(config)
        with one_line_errors():
            self.scene = read_scene(_scene_folder(config))
            _say_what_is_missing(self.scene)
            self.trajectory = read_tum(self.scene.trajectory)
            _check_scene_is_the_runs(self.scene, self.trajectory, config.kept)
            self.normalization = _normalization(self.scene, self.trajectory)
            self.mount_scale = self.normalization.scale / _reference_units(self.scene, self.trajectory)

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs: object) -> DataparserOutputs:
        keyframes = self.normalization.apply(self.trajectory)
        cameras, files = self._keyframe_views(keyframes) if split == "train" else self._evaluation_views(keyframes)
        translation = -self.normalization.centre[:, None]
        return DataparserOutputs(
            image_filenames=files,
            cameras=cameras,
            scene_box=SceneBox(aabb=torch.stack([-self.normalization.half_sides, self.normalization.half_sides])),
            metadata={
                "scene": self.scene,
                "trajectory": self.trajectory,
                "keyframes": keyframes,
                "normalization": self.normalization,
                "mount_scale": self.mount_scale,
            },
            dataparser_transform=torch.cat([torch.eye(3), translation.float()], dim=1),
            dataparser_scale=self.normalization.scale,
        )

    def _keyframe_views(self, keyframes: Trajectory, every: int = 1) -> tuple[Cameras, list[Path]]:
        chosen = Trajectory(keyframes.t_us[::every], Poses(*(column[::every] for column in keyframes.poses)))
        # Joining 100,000 file names with pathlib would take seconds.
        folder = str(self.scene.folder / "keyframes")
        files = [Path(f"{folder}/{t_us}.png") for t_us in chosen.t_us.tolist()]
        return _nerfstudio_cameras([self.scene.camera] * len(files), chosen.t_us, chosen.poses.matrix()), files

    def _evaluation_views(self, keyframes: Trajectory) -> tuple[Cameras, list[Path]]:
        """The frames within the trajectory's span; if there are none, a few keyframes, so that something is shown."""
        times = torch.tensor([frame.t_us for frame in self.scene.frames], dtype=torch.int64)
        inside = within_span(times, keyframes.t_us)
        frames = [frame for frame, keep in zip(self.scene.frames, inside.tolist(), strict=True) if keep]
        if not frames:
            return self._keyframe_views(keyframes, max(1, len(keyframes.t_us) // _STAND_IN_VIEWS))
        event_camera = Trajectory(times[inside], interpolate(keyframes.t_us, keyframes.poses, times[inside]))
        return frame_cameras(frames, event_camera, self.mount_scale), [frame.path for frame in frames]


def keep_scene(scene: Scene, folder: Path) -> None:
    """Write a copy of a scene for a trained run, without recording and frames, which may be large."""
    with whole_folder(folder) as kept:
        copies = {}
        for name in ("trajectory", "groundtruth"):
            if path := getattr(scene, name):
                copies[name] = kept / f"{name}.txt"
                copies[name].write_bytes(path.read_bytes())
        write_scene(replace(scene, folder=kept, frames=(), **copies))


def moved(config: EbarfDataParserConfig) -> str:
    """An error text: the scene folder is missing, and how to set its new location in the run's config.yml."""
    said = f"{Path(config.data).absolute()}: no such folder, expected the scene of the run; where it was moved, change"
    path = config.kept.parent / "config.yml" if config.kept else None
    found = _DATA.search(path.read_text(encoding="utf-8")) if path and path.is_file() else None
    if path is None or found is None:
        return f"{said} 'data:' under pipeline, datamanager in the run's config.yml to 'data: NEW PLACE'"
    first = found.string.count("\n", 0, found.start()) + 1
    lines = f"line {first}" if not found[1] else f"lines {first} to {first + found[1].count(chr(10))}"
    return f"{said} {lines} of {path.absolute()} to '    data: NEW PLACE'"


def _scene_folder(config: EbarfDataParserConfig) -> Path:
    """The scene folder, or the run's own copy if the folder is gone."""
    folder = Path(config.data)
    if folder.is_dir():
        return folder
    if config.kept is None or not (config.kept / "scene.json").is_file():
        raise SceneError(moved(config))
    sys.stderr.write(f"opened with the run's copy {config.kept}, without frames and recording ({moved(config)})\n")
    return config.kept


def _say_what_is_missing(scene: Scene) -> None:
    """Warn of missing frame files; training does not need them."""
    if scene.missing:
        sys.stderr.write(
            f"warning: {scene.missing[0]}: no such file; {len(scene.missing)} of the validation frames' files are "
            f"missing, and {len(scene.frames)} frames are left to compare renders with\n"
        )


def _check_scene_is_the_runs(scene: Scene, trajectory: Trajectory, kept: Path | None) -> None:
    """Raise :class:`SceneError` if the scene's trajectory is not the one that the run was trained on."""
    if kept is None or not (kept / "trajectory.txt").is_file():
        return
    trained = read_tum(kept / "trajectory.txt")
    columns = zip((trajectory.t_us, *trajectory.poses), (trained.t_us, *trained.poses), strict=True)
    if not all(torch.equal(now, then) for now, then in columns):
        raise SceneError(
            f"{scene.trajectory.absolute()}: {len(trajectory.t_us)} keyframes, other than the {len(trained.t_us)} of "
            f"{(kept / 'trajectory.txt').absolute()}, expected those that the run was trained on"
        )


def _normalization(scene: Scene, trajectory: Trajectory) -> Normalization:
    check_bounds(scene, trajectory)
    if scene.bounds is not None:
        centre, scale, half_sides = box_of_bounds(scene.bounds)
        return Normalization(centre, scale, half_sides.float())
    centre = trajectory.poses.position.mean(dim=0)
    radius = float((trajectory.poses.position - centre).norm(dim=-1).max())
    return Normalization(centre, _TRAJECTORY_SHARE / radius if radius > 0 else 1.0, torch.ones(3))


def _reference_units(scene: Scene, trajectory: Trajectory) -> float:
    """The trajectory's unit in units of the reference, which the rig's calibration uses; 1 if unknown or not needed.

    A trajectory's scale is arbitrary, but the offset of the frame camera from the event camera is given in metres.
    """
    if scene.groundtruth is None or not any(_apart(frame) for frame in scene.frames):
        return 1.0
    from ebarf_ns.evaluation.trajectory_error import trajectory_results

    results = trajectory_results(trajectory, read_tum(scene.groundtruth))
    return results["scale"] or results["scale_orientation"] or 1.0


def _apart(frame: Frame) -> bool:
    return any(row[3] for row in frame.event_camera_from_frame_camera[:3])


_OPENGL_FROM_OPENCV = torch.tensor([1.0, -1.0, -1.0, 1.0])


def opengl_from_opencv(camera_to_world: Float[Tensor, "*batch 3 4"]) -> Float[Tensor, "*batch 3 4"]:
    """The same pose with nerfstudio's camera axes (y up, z backward); its own inverse."""
    return camera_to_world * _OPENGL_FROM_OPENCV.to(camera_to_world)


def frame_cameras(frames: list[Frame], event_camera: Trajectory, mount_scale: float) -> Cameras:
    """The cameras of frames, from the event camera's pose in training coordinates at each frame's time.

    ``mount_scale`` is a unit of the rig's calibration in training coordinates.
    """
    mount = torch.tensor([frame.event_camera_from_frame_camera for frame in frames])
    pose = event_camera.poses.matrix()
    rotation = pose[:, :, :3] @ mount[:, :3, :3]
    position = pose[:, :, :3] @ (mount_scale * mount[:, :3, 3:]) + pose[:, :, 3:]
    return _nerfstudio_cameras(
        [frame.camera for frame in frames], event_camera.t_us, torch.cat([rotation, position], dim=-1)
    )


def replace_intrinsics(cameras: Cameras, given: Camera, learned: Camera) -> None:
    """Set the learned intrinsics of those cameras that have the given intrinsics of the event camera."""
    one = Trajectory(torch.zeros(1, dtype=torch.int64), Poses(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]])))
    before, after = (_nerfstudio_cameras([camera], one.t_us, one.poses.matrix()) for camera in (given, learned))
    columns = ("fx", "fy", "cx", "cy", "width", "height")
    same = torch.cat([getattr(cameras, name) == getattr(before, name) for name in columns], dim=-1).all(dim=-1)
    for name in ("fx", "fy", "cx", "cy", "distortion_params"):
        column, new = getattr(cameras, name), getattr(after, name)
        if column is not None and new is not None:
            setattr(cameras, name, torch.where(same[:, None], new.to(column), column))


def _nerfstudio_cameras(
    cameras: list[Camera], t_us: Int64[Tensor, "cameras"], camera_to_world: Float[Tensor, "cameras 3 4"]
) -> Cameras:
    # There may be 100,000 of them, nearly always the same camera.
    kinds = {camera: k for k, camera in enumerate(dict.fromkeys(cameras))}
    which = torch.tensor([kinds[camera] for camera in cameras])

    def column(name: str) -> Tensor:
        return torch.tensor([[getattr(camera, name)] for camera in kinds])[which]

    fisheye = torch.tensor([[camera.model == "equidistant"] for camera in kinds])[which]
    # Nerfstudio divides 0 by 0 at the exact centre of a fisheye.
    aside = _ASIDE_PX * fisheye
    return Cameras(
        camera_to_worlds=opengl_from_opencv(camera_to_world),
        fx=column("fx"),
        fy=column("fy"),
        cx=column("cx") + 0.5 + aside,  # nerfstudio's pixel centres are at half-integers
        cy=column("cy") + 0.5,
        width=column("width"),
        height=column("height"),
        distortion_params=torch.tensor([_nerfstudio_distortion(camera) for camera in kinds])[which]
        if any(camera.distortion for camera in kinds)
        else None,
        camera_type=torch.where(fisheye, CameraType.FISHEYE.value, CameraType.PERSPECTIVE.value),
        metadata={"camera_t_us": t_us[:, None]},
    )


def _nerfstudio_distortion(camera: Camera) -> list[float]:
    """k1 k2 k3 k4 p1 p2."""
    if camera.model == "radtan":
        k1, k2, p1, p2, k3 = (*camera.distortion, 0.0)[:5]
        return [k1, k2, k3, 0.0, p1, p2]
    return [*camera.distortion, 0.0, 0.0] if camera.distortion else [0.0] * 6


ebarf_data = DataParserSpecification(
    config=EbarfDataParserConfig(), description="A scene folder of an event camera: scene.json, events, trajectory."
)
