"""A camera optimizer over time: keyframe corrections, and world rays at any time between keyframes."""

from dataclasses import dataclass, field
from typing import Any, Literal

import torch
import tyro
from jaxtyping import Float, Int
from nerfstudio.cameras.camera_optimizers import CameraOptimizer, CameraOptimizerConfig
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from torch import Tensor, nn

from ebarf_ns.geometry.clock import ClockOffset, clock_offset
from ebarf_ns.geometry.smoothing import smoothed
from ebarf_ns.geometry.so3 import quat_wxyz_conjugate, quat_wxyz_to_matrix, rotate, turn_between
from ebarf_ns.geometry.trajectory import (
    Interpolation,
    Poses,
    Trajectory,
    corrected,
    densified,
    interpolate,
    intervals,
    within_span,
)
from ebarf_ns.nerf.dataparser import opengl_from_opencv

_GOOD_PX = 0.4
_SETTLED_STEP = 1000
# Rotations determine the clock offset; errors of translations are coupled with errors of depth.
_TRANSLATIONS_TELL = 0.3


@dataclass
class TrajectoryOptimizerConfig(CameraOptimizerConfig):
    """Settings for correcting the trajectory."""

    _target: type = field(default_factory=lambda: TrajectoryOptimizer)
    mode: Literal["refine", "off"] = "refine"  # pyright: ignore[reportIncompatibleVariableOverride]
    """Refine every keyframe, or keep the trajectory as given."""
    # nerfstudio's penalties are not meant for keyframes; the prior replaces them.
    trans_l2_penalty: tyro.conf.Suppress[float] = 0.0
    rot_l2_penalty: tyro.conf.Suppress[float] = 0.0
    smooth: bool = True
    """Start from a smoothing spline through the keyframes; keyframes on a smooth path stay in place."""
    align_steps: int = 400
    """Steps of a coarse field that looks for large errors before training; 0: skip."""
    longest_gap_us: int | None = None
    """Insert keyframes where the given ones are further apart than this; 0: never; None: as planned."""
    keyframe_stride: int | None = None
    """Learn a correction for every n-th keyframe and interpolate it in between; None: as planned."""
    prior: float = 0.01
    """Largest loss for leaving a good trajectory, where a render error of one threshold costs 1; 0: no prior."""
    every: int = 2
    """Train the keyframes in every n-th step, and from step 1,000 on in every n²-th; the other steps train only the
    field, which is faster."""
    interpolation: Interpolation | None = None
    """Motion between keyframes; linear: constant velocity (Eq. 3), cubic: velocities continuous at the keyframes;
    None: as planned."""

    def start(self, keyframes: Trajectory) -> Trajectory:
        """The keyframes from which training starts."""
        return smoothed(keyframes) if self.smooth and self.mode == "refine" else keyframes


class TrajectoryOptimizer(CameraOptimizer):
    """Keyframe poses with zero-initialised corrections (rotation, translation) in the camera frame.

    Corrections are in pixels: 1 is the rotation, or the translation at unit distance, that moves the image by a pixel,
    so that one learning rate suits any focal length. The model's attribute for this module is ``camera_optimizer``,
    where nerfstudio's viewer and exporters look for the refined poses.
    """

    config: TrajectoryOptimizerConfig

    def __init__(
        self,
        config: TrajectoryOptimizerConfig,
        num_cameras: int,
        device: torch.device | str,
        keyframes: Trajectory,
        focal_px: float,
        **kwargs: Any,
    ):
        super().__init__(CameraOptimizerConfig(mode="off"), num_cameras, device)
        self.config = config
        self.frozen = False
        """Whether the keyframes are fixed for now."""
        self.pixel_rad = 1 / focal_px
        kind, gap_us = config.interpolation or "linear", config.longest_gap_us or 0
        start, _ = densified(config.start(keyframes), gap_us, kind)
        keyframes, given = densified(keyframes, gap_us, kind)
        self.register_buffer("given", given, persistent=False)
        """Which keyframes came with the scene; the others are inserted."""
        self.given: Tensor
        self.register_buffer("keyframe_t_us", keyframes.t_us.clone())
        self.register_buffer("clock_offset_us", torch.zeros((), dtype=torch.int64))
        """Offset added to the times of the given keyframes; ``keyframe_t_us`` are on the event clock."""
        self.clock_offset_us: Tensor
        self.register_buffer("initial_position", keyframes.poses.position.clone())
        self.register_buffer("initial_quat_wxyz", keyframes.poses.quat_wxyz.clone())
        self.keyframe_t_us: Tensor
        self.initial_position: Tensor
        self.initial_quat_wxyz: Tensor
        self.register_buffer("start_position", start.poses.position.clone())
        self.register_buffer("start_quat_wxyz", start.poses.quat_wxyz.clone())
        self.start_position: Tensor
        self.start_quat_wxyz: Tensor
        self.register_buffer("before_px", torch.zeros(len(keyframes.t_us), 6))
        """Offset of the start from the given keyframes: rotations, and translations at unit distance, in pixels."""
        self.before_px: Tensor
        self.begin_from(start.poses)
        knots = _every(config.keyframe_stride or 1, len(keyframes.t_us))
        self.register_buffer("knots", knots, persistent=False)
        self.knots: Tensor
        self.register_buffer("unit", torch.ones(6))
        """Pixels by which a correction of 1 moves the image at unit distance."""
        self.register_buffer("hold", torch.zeros(()))
        """Loss per squared pixel of distance to the given keyframes."""
        self.unit: Tensor
        self.hold: Tensor
        # The knots around each keyframe never change.
        left, fraction = intervals(keyframes.t_us[knots], keyframes.t_us)
        self.register_buffer("left_knot", left, persistent=False)
        self.register_buffer("way_to_next_knot", fraction[:, None], persistent=False)
        self.left_knot: Tensor
        self.way_to_next_knot: Tensor
        if config.mode == "refine":
            self.correction = nn.Parameter(torch.zeros(len(knots), 6))
            self.clock_px = nn.Parameter(torch.zeros(1, 1))
            """Learned offset of the keyframe times beyond ``clock_offset_us``, in pixels of the mean motion."""
        self.register_buffer("clock_us_per_px", torch.zeros((), dtype=torch.float64))
        self.clock_us_per_px: Tensor

    def begin_step(self, step: int) -> None:
        """Enable or disable training of the keyframes for this step: their gradients make it a fifth longer."""
        if self.config.mode == "refine":
            every = self.config.every ** (1 if step < _SETTLED_STEP else 2)
            for one in (self.correction, self.clock_px):
                one.requires_grad_(step % every == 0 and not self.frozen)

    def begin_from(self, start: Poses) -> None:
        """Set the poses that the corrections are applied to."""
        self.start_position.copy_(start.position)
        self.start_quat_wxyz.copy_(start.quat_wxyz)
        self.before_px.copy_(_correction(self.initial(), start) / self.pixel_rad)

    @torch.no_grad()
    def shift_clock(self, offset_us: int) -> None:
        """Add ``offset_us`` to the times of all keyframes; each keyframe keeps its correction."""
        self.keyframe_t_us += offset_us
        self.clock_offset_us += offset_us

    @torch.no_grad()
    def learn_clock(self) -> None:
        """Learn the clock offset from now on."""
        self.clock_us_per_px.copy_(1e6 / (self._speed_rad_s() / self.pixel_rad))

    def _speed_rad_s(self) -> Tensor:
        """RMS image speed at unit distance [rad/s]."""
        start = self._start()
        turn = turn_between(start.quat_wxyz[:-1], start.quat_wxyz[1:])
        moved = torch.cat([turn, start.position.diff(dim=0)], dim=-1).double().norm(dim=-1)
        return (moved / (self.keyframe_t_us.diff() * 1e-6)).square().mean().sqrt().clamp_min(1e-6)

    def clock_us(self) -> Float[Tensor, ""] | None:
        """The learned clock offset beyond ``clock_offset_us``; None if poses are fixed."""
        return (self.clock_us_per_px * self.clock_px)[0, 0] if self.config.mode == "refine" else None

    @property
    def learns_clock(self) -> bool:
        """Whether :meth:`learn_clock` was called."""
        return bool(self.clock_us_per_px > 0)

    def remaining_clock_offset(self) -> ClockOffset:
        """The clock offset beyond ``clock_offset_us`` that the corrections imply."""
        kind, translation = self.config.interpolation or "linear", float(self.unit[3])
        given = Trajectory(self.keyframe_t_us, self.initial())
        return clock_offset(given, self.trajectory(), min(translation, _TRANSLATIONS_TELL), kind)

    @torch.no_grad()
    def explain_by_clock(self, offset_us: int) -> None:
        """Replace the learned clock offset by this one, and adjust the corrections so that the motion is unchanged.

        Where the shifted trajectory extends beyond the old one, the correction of the nearest keyframe is used.
        """
        before, kind = self.trajectory(), self.config.interpolation or "linear"
        self.shift_clock(offset_us)
        self.clock_px.zero_()
        t_us = self.keyframe_t_us[self.knots]
        inside = within_span(t_us, before.t_us)
        start = Poses(*(column[self.knots][inside] for column in self._start()))
        left = _correction(start, interpolate(before.t_us, before.poses, t_us[inside], kind))
        known = inside.nonzero()[:, 0]
        nearest = (torch.arange(len(t_us), device=t_us.device) - known[0]).clamp(0, len(known) - 1)
        self.correction.copy_(left[nearest] / self.pixel_rad / self.unit)

    def hold_to_given(self, cost: float, translation: float) -> None:
        """Penalise squared distances to the given keyframes, and make translations move less.

        Odometry errors are degrees of rotation rather than pixels of translation. The cost, and ``translation``, the
        pixels at unit distance that a correction of 1 shifts, separate the two: without them, opposite rotations and
        shifts grow together.
        """
        self.hold.fill_(cost)
        self.unit[3:] = translation

    def initial(self) -> Poses:
        """The initial keyframes, as given or inserted."""
        return Poses(self.initial_position, self.initial_quat_wxyz)

    def given_trajectory(self) -> Trajectory:
        """The scene's trajectory as given."""
        given = self.given
        t_us = self.keyframe_t_us - self.clock_offset_us
        return Trajectory(t_us[given], Poses(*(column[given] for column in self.initial())))

    def keyframes(self) -> Poses:
        """The keyframes as corrected so far."""
        start = self._start()
        if self.config.mode == "off":
            return start
        correction = self.correction
        if len(correction) < len(self.keyframe_t_us):
            left, right = correction[self.left_knot], correction[self.left_knot + 1]
            correction = torch.lerp(left, right, self.way_to_next_knot.to(correction))
        return corrected(start, self.pixel_rad * self.unit * correction)

    def start_trajectory(self) -> Trajectory:
        """The uncorrected start, on the event clock."""
        return Trajectory(self.keyframe_t_us, self._start())

    def _start(self) -> Poses:
        return Poses(self.start_position, self.start_quat_wxyz)

    def trajectory(self) -> Trajectory:
        """The corrected keyframes and their times on the event clock, detached."""
        poses, clock_us = self.keyframes(), self.clock_us()
        t_us = self.keyframe_t_us if clock_us is None else self.keyframe_t_us + clock_us.detach().round().long()
        return Trajectory(t_us, Poses(poses.position.detach(), poses.quat_wxyz.detach()))

    def poses_at(self, t_us: Int[Tensor, "*batch"], delay_us: Float[Tensor, "*batch"] | None = None) -> Poses:
        """Corrected poses at given times, or ``delay_us`` earlier."""
        kind, clock_us = self.config.interpolation or "linear", self.clock_us()
        if clock_us is not None:
            delay_us = clock_us.expand(t_us.shape) if delay_us is None else clock_us + delay_us
        return interpolate(self.keyframe_t_us, self.keyframes(), t_us, kind, delay_us)

    def start_at(self, t_us: Int[Tensor, "*batch"]) -> Poses:
        """Poses from which training started, at given times."""
        return interpolate(self.keyframe_t_us, self._start(), t_us, self.config.interpolation or "linear")

    def initial_at(self, t_us: Int[Tensor, "*batch"]) -> Poses:
        """Initial poses at given times on the trajectory's original clock."""
        return interpolate(self.keyframe_t_us - self.clock_offset_us, self.initial(), t_us)

    def apply_to_raybundle(self, raybundle: RayBundle) -> None:
        """Transform event rays from the camera frame at their time to the world; other rays are world rays already."""
        metadata = raybundle.metadata or {}
        t_us, delay_us = metadata.pop("event_t_us", None), metadata.pop("delay_us", None)
        if t_us is not None:
            poses = self.poses_at(t_us[..., 0], delay_us)
            raybundle.directions = rotate(poses.quat_wxyz, raybundle.directions)
            raybundle.origins = poses.position

    def forward(self, indices: Int[Tensor, "cameras"]) -> Float[Tensor, "cameras 3 4"]:
        """Transforms from the refined to the initial camera frame of keyframes, in nerfstudio's axes, to be multiplied
        on the right."""
        flip = torch.tensor([1.0, -1.0, -1.0], device=self.keyframe_t_us.device)
        # The viewer may pass an empty tensor, which is not of integer type.
        indices = indices.long()
        initial, refined = (
            Poses(p.position[self.given[indices]], p.quat_wxyz[self.given[indices]])
            for p in (self.initial(), self.keyframes())
        )
        to_initial = quat_wxyz_to_matrix(initial.quat_wxyz).mT
        rotation = to_initial @ quat_wxyz_to_matrix(refined.quat_wxyz)
        position = (to_initial @ (refined.position - initial.position)[..., None])[..., 0]
        return torch.cat([flip[:, None] * rotation * flip, (flip * position)[..., None]], dim=-1)

    def apply_to_camera(self, camera: Cameras) -> Float[Tensor, "cameras 3 4"]:
        """Camera-to-world of a dataset's camera, moved with the trajectory; other cameras are unchanged."""
        camera_to_world = camera.camera_to_worlds
        t_us = (camera.metadata or {}).get("camera_t_us")
        if t_us is None:
            return camera_to_world
        t_us = t_us.to(self.keyframe_t_us.device)[..., 0]
        initial = self.initial_at(t_us).matrix()
        refined = self.poses_at(t_us).matrix()
        given = opengl_from_opencv(camera_to_world).to(refined)
        local = initial[..., :3].mT @ torch.cat([given[..., :3], given[..., 3:] - initial[..., 3:]], dim=-1)
        moved = refined[..., :3] @ local
        moved = torch.cat([moved[..., :3], moved[..., 3:] + refined[..., 3:]], dim=-1)
        return opengl_from_opencv(moved).to(camera_to_world)

    def get_loss_dict(self, loss_dict: dict) -> None:
        """Add the trajectory prior: a given trajectory is either good to a fraction of a pixel or arbitrarily bad.

        Keyframes moved by a mean square of m pixels², by the start and by corrections, cost m / (m + 0.4²) times the
        prior, a robust loss (Geman and McClure, 1987). It keeps an immature field from bending a good trajectory, more
        so as the event loss falls, but hardly pulls back one that was noisy or drifted by pixels. A trajectory with
        :meth:`hold_to_given` also has a quadratic cost.
        """
        if self.config.mode == "refine":
            off_px2 = self.before_px.square().sum(dim=-1).mean() + self.correction.square().sum(dim=-1).mean()
            off = self.before_px[self.knots] / self.unit + self.correction
            saturating = self.config.prior * off_px2 / (off_px2 + _GOOD_PX**2)
            loss_dict["trajectory_prior"] = saturating + self.hold * off.square().sum(dim=-1).mean()

    def get_metrics_dict(self, metrics_dict: dict) -> None:
        """Add the mean size of the corrections in pixels, and the clock offset in milliseconds."""
        if self.config.mode == "refine":
            metrics_dict["correction_rotation_px"] = self.correction[:, :3].detach().norm(dim=-1).mean()
            clock_us = self.clock_us()
            assert clock_us is not None
            metrics_dict["clock_offset_ms"] = (self.clock_offset_us + clock_us.detach()) * 1e-3
            metrics_dict["correction_translation_px"] = self.correction[:, 3:].detach().norm(dim=-1).mean()

    def get_param_groups(self, param_groups: dict) -> None:
        """Add the corrections under nerfstudio's name for camera parameters."""
        if self.config.mode == "refine":
            param_groups["camera_opt"] = [self.correction, self.clock_px]


def _every(stride: int, count: int) -> Int[Tensor, "knots"]:
    """Every ``stride``-th of ``count``, and the last."""
    last = torch.tensor([count - 1])
    return torch.cat([torch.arange(0, count - 1, stride), last])


def _correction(some: Poses, others: Poses) -> Float[Tensor, "keyframes 6"]:
    """The correction that takes ``some`` to ``others`` in :func:`corrected`."""
    shift = rotate(quat_wxyz_conjugate(some.quat_wxyz), others.position - some.position)
    return torch.cat([turn_between(some.quat_wxyz, others.quat_wxyz), shift], dim=-1)
