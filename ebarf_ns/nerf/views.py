"""Full views for display, each a camera and an image, and the start view of spirals."""

import math
import random
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datasets.base_dataset import InputDataset
from nerfstudio.data.utils.dataloaders import RandIndicesEvalDataloader
from torch import Tensor

from ebarf_ns.errors import EbarfError
from ebarf_ns.events.recording import RecordingFile, accumulate
from ebarf_ns.scene import Scene

# Minimum sine of the angle between view and vertical. The views of a spiral turn by only 0.01 degrees.
_LEAST_TILT = 0.1


class EventDataset(InputDataset):
    """Cameras with one image each: the frame taken there, or else the events around the keyframe."""

    def __init__(self, dataparser_outputs: Any, scale_factor: float = 1.0):
        super().__init__(dataparser_outputs, scale_factor)
        self.scene: Scene = self.metadata["scene"]
        assert self.cameras.metadata is not None
        self.t_us: Tensor = self.cameras.metadata["camera_t_us"][:, 0]

    def show_from(self, cameras: Cameras) -> None:
        """Replace the cameras of the views, in the dataset and in its data parser outputs."""
        self.cameras = self._dataparser_outputs.cameras = cameras

    def get_numpy_image(self, image_idx: int) -> np.ndarray:
        """Return an 8-bit grey image in three channels, for display only; evaluation reads the frames themselves."""
        path = self._dataparser_outputs.image_filenames[image_idx]
        grey = self._read_frame(path) if path.is_file() else self._events_around(image_idx)
        size = (int(self.cameras.width[image_idx]), int(self.cameras.height[image_idx]))
        return cv2.resize(grey, size, interpolation=cv2.INTER_AREA)[:, :, None].repeat(3, axis=2)

    def _read_frame(self, path: Any) -> np.ndarray:
        from ebarf_ns.evaluation.frames import read_frame

        frame = next(frame for frame in self.scene.frames if frame.path == path)
        return for_people(read_frame(frame))

    def _events_around(self, image_idx: int) -> np.ndarray:
        camera = self.scene.camera
        half_us = int(self.t_us.diff().median()) // 2 if len(self.t_us) > 1 else 10_000
        t_us = int(self.t_us[image_idx])
        try:
            file = RecordingFile(self.scene.events, camera.width, camera.height)
            return accumulate(file.window(t_us - half_us, t_us + half_us), camera.width, camera.height)
        except EbarfError:
            # A trained run can still be viewed after its recording was deleted.
            return np.full((camera.height, camera.width), 128, np.uint8)


def for_people(linear: Float[np.ndarray, "height width"]) -> np.ndarray:
    """Return a linear frame as 8-bit grey with a gamma of 2.2."""
    return (np.clip(linear / max(linear.max(), 1e-9), 0, 1) ** (1 / 2.2) * 255).astype(np.uint8)


class SpiralStart(RandIndicesEvalDataloader):
    """Loader of random views, and of the view with a given index, from which ``ns-render spiral`` starts.

    nerfstudio uses the camera's viewing direction in the world as "up" in the camera's own frame, which rolls the
    spiral. The camera is therefore returned with the opposite roll. A camera that looks along the world's z axis is
    also tilted, because its "up" would otherwise be parallel to the view.
    """

    def __next__(self) -> tuple[Cameras, dict]:
        return super().get_camera(random.randint(0, len(self.cameras) - 1))

    def get_camera(self, image_idx: int = 0) -> tuple[Cameras, dict]:
        """Return the view with this index, rolled so that a spiral around it is upright."""
        camera, batch = super().get_camera(image_idx)
        rolled = camera[...]
        rolled.camera_to_worlds = torch.stack([upright_start(one) for one in camera.camera_to_worlds])
        return rolled, batch


def upright_start(camera_to_world: Float[Tensor, "3 4"]) -> Float[Tensor, "3 4"]:
    """Return the pose from which ``get_spiral_path`` renders views as upright as this camera (nerfstudio's axes)."""
    rotation, position = camera_to_world[:, :3].double(), camera_to_world[:, 3:]
    x, y, _ = rotation[:, 2].tolist()
    if math.hypot(x, y) < _LEAST_TILT:
        # Tilt about the camera's x axis, to the side where its backward axis is further from the world's z axis.
        tilt = max(
            (_axis_rotation(0, sign * 1.5 * _LEAST_TILT) for sign in (1, -1)),
            key=lambda candidate: _sine_from_z(rotation @ candidate),
        )
        rotation = rotation @ tilt
        x, y, _ = rotation[:, 2].tolist()
    roll_rad = math.atan2(-x, y)
    return torch.cat([(rotation @ _axis_rotation(2, -roll_rad)).to(position), position], dim=1)


def _sine_from_z(rotation: Float[Tensor, "3 3"]) -> float:
    return float(rotation[:2, 2].norm())


def _axis_rotation(axis: int, angle_rad: float) -> Float[Tensor, "3 3"]:
    generator = torch.zeros(3, 3, dtype=torch.float64)
    generator[(axis + 2) % 3, (axis + 1) % 3], generator[(axis + 1) % 3, (axis + 2) % 3] = angle_rad, -angle_rad
    return torch.linalg.matrix_exp(generator)
