"""Scene elements of the viewer's panel: three trajectories, and the keyframes with the events around them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch

from ebarf_ns.errors import EbarfError
from ebarf_ns.evaluation.trajectory_error import reference_in_estimates_world
from ebarf_ns.geometry.trajectory import Poses, Trajectory, within_span
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.nerf.viewer_pictures import event_picture, half_window_us

if TYPE_CHECKING:
    from collections.abc import Callable

    import viser
    from jaxtyping import Float
    from torch import Tensor

    from ebarf_ns.nerf.pipeline import EbarfPipeline

# nerfstudio's VISER_NERFSTUDIO_SCALE_RATIO. Its module cannot be imported while nerfstudio is only partly loaded.
SCALE = 10.0
_BLUE, _ORANGE, _GREEN = (31, 119, 180), (255, 127, 14), (44, 160, 44)
_MOST_FRUSTUMS = 512
_MOST_POINTS, _DASHES = 400, 40
_THUMBNAIL_PX = 64
# Distance up to which a frustum obstructs the view, in frustum lengths.
_OBSTRUCTING = 4.0


class DrawnScene:
    """Trajectories and keyframes, under the scene nodes /initial, /refined, /reference and /keyframes."""

    def __init__(self, pipeline: EbarfPipeline, server: viser.ViserServer, most: int, frustum_scale: float):
        self.pipeline, self.server, self.frustum_scale = pipeline, server, frustum_scale
        given = pipeline.model.camera_optimizer.given.cpu()
        count = min(len(given), _MOST_FRUSTUMS if most < 0 else min(most, _MOST_FRUSTUMS))
        self.keyframes = given[np.linspace(0, len(given) - 1, count).astype(int)]
        """Indices of the drawn keyframes, evenly spaced among those given with the scene."""
        self.frustums: list[viser.CameraFrustumHandle] = []
        self._positions = np.zeros((0, 3))

    def _poses(self) -> Poses:
        keyframes = self.pipeline.model.camera_optimizer.trajectory().poses
        return Poses(*(column[self.keyframes.to(column.device)].double().cpu() for column in keyframes))

    def places(self) -> Float[Tensor, "keyframes 3"]:
        """Return the current positions of the drawn keyframes, in training coordinates."""
        return self._poses().position

    def draw_keyframes(self, on_click: Callable[[int, viser.ClientHandle | None], None]) -> None:
        """Draw a frustum per keyframe, with its events; a click calls ``on_click`` with the keyframe's index."""
        camera, times = self.pipeline.scene.camera, self.pipeline.model.camera_optimizer.keyframe_t_us.cpu()
        half_us, poses = half_window_us(times), self._poses()
        stride_px = max(camera.width // _THUMBNAIL_PX, 1)
        drawn = []
        for k, keyframe in enumerate(self.keyframes.tolist()):
            picture = event_picture(self.pipeline, int(times[keyframe]), half_us)[::stride_px, ::stride_px]
            handle = self.server.scene.add_camera_frustum(
                f"/keyframes/{keyframe:05d}",
                fov=vertical_fov_rad(self.pipeline),
                aspect=camera.width / camera.height,
                scale=self.frustum_scale,
                color=_ORANGE,
                image=np.repeat(picture[:, :, None], 3, axis=2),
                position=SCALE * poses.position[k].numpy(),
                wxyz=poses.quat_wxyz[k].numpy(),
            )
            handle.on_click(lambda event, keyframe=keyframe: on_click(keyframe, event.client))
            drawn.append(handle)
        self.frustums, self._positions = drawn, SCALE * poses.position.numpy()

    @torch.no_grad()
    def draw_lines(self) -> None:
        """Draw the current trajectories, and move the keyframes to their current poses."""
        optimizer = self.pipeline.model.camera_optimizer
        refined = optimizer.trajectory()
        self._line("/initial/line", optimizer.initial().position, _BLUE, 2.0)
        fraction = torch.linspace(0, 1, min(4 * len(refined.t_us), _MOST_POINTS), dtype=torch.float64)
        span_us = int(refined.t_us[-1] - refined.t_us[0])
        times = refined.t_us[0] + (fraction * span_us).round().long().to(refined.t_us)
        self._line("/refined/line", optimizer.poses_at(times).position, _ORANGE, 4.0)
        for k, dash in enumerate(self._reference_dashes()):
            self._line(f"/reference/{k:03d}", dash, _GREEN, 3.0)
        poses = self._poses()
        self._positions = SCALE * poses.position.numpy()
        for handle, place, wxyz in zip(self.frustums, self._positions, poses.quat_wxyz.numpy(), strict=True):
            if max(np.abs(handle.position - place).max(), np.abs(handle.wxyz - wxyz).max()) > 1e-4:
                handle.position, handle.wxyz = place, wxyz

    def clear_the_view(self, camera: viser.CameraHandle) -> None:
        """Hide the frustums close to the viewer's camera."""
        far = np.abs(self._positions - camera.position).max(axis=-1) > _OBSTRUCTING * self.frustum_scale
        for handle, visible in zip(self.frustums, far.tolist(), strict=True):
            handle.visible = visible

    def _line(self, name: str, position: Float[Tensor, "points 3"], color: tuple[int, int, int], width: float) -> None:
        stride = -(-len(position) // _MOST_POINTS)
        points = SCALE * position[::stride].detach().double().cpu().numpy()
        # With one segment between two points, the spline does not round the corners.
        self.server.scene.add_spline_catmull_rom(
            name, points, color=color, line_width=width, segments=max(len(points) - 1, 1)
        )

    def _reference_dashes(self) -> list[Float[Tensor, "points 3"]]:
        """Return alternate pieces of the reference, aligned with the current trajectory, in training coordinates."""
        scene, estimate = self.pipeline.scene, self.pipeline.trajectory()
        if scene.groundtruth is None:
            return []
        reference = read_tum(scene.groundtruth)
        t_us = reference.t_us[within_span(reference.t_us, estimate.t_us)]
        t_us = t_us[:: max(len(t_us) // _MOST_POINTS, 1)]
        try:
            poses = reference_in_estimates_world(estimate, reference, t_us)
        except EbarfError:
            return []
        normalization = self.pipeline.datamanager.train_dataset.metadata["normalization"]
        position = normalization.apply(Trajectory(t_us, poses)).poses.position
        dashes = position.split(max(-(-len(position) // (2 * _DASHES)), 2))[::2]
        return [dash for dash in dashes if len(dash) > 1]


def vertical_fov_rad(pipeline: EbarfPipeline) -> float:
    """Return the vertical field of view of the event camera, as viser expects it [rad]."""
    camera = pipeline.scene.camera
    return float(2 * np.arctan(camera.height / 2 / camera.fy))
