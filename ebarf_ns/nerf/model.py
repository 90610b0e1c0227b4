"""The method in one file: event pair, two poses, two rays, two intensities, one difference, one loss."""

from dataclasses import dataclass, field
from math import log, sqrt
from typing import Annotated, Any, Literal, TypeVar

import torch
import tyro
from jaxtyping import Float
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.models.base_model import Model, ModelConfig
from torch import Tensor

from ebarf_ns.errors import TrainingError, one_line_errors
from ebarf_ns.geometry.so3 import rotate
from ebarf_ns.nerf.intrinsics import Intrinsics
from ebarf_ns.nerf.old_flags import old_names
from ebarf_ns.nerf.trajectory_optimizer import TrajectoryOptimizer, TrajectoryOptimizerConfig
from ebarf_ns.photometry.brightness import BrightnessKind, log_brightness
from ebarf_ns.photometry.event_loss import normalized_loss, reported_change, target_change, threshold_loss
from ebarf_ns.photometry.sensor_response import SensorResponse, thresholds_of_ratio
from ebarf_ns.radiance.field import IntensityRange, Precision, RadianceField
from ebarf_ns.radiance.lattice import HashGridShape
from ebarf_ns.radiance.normals import SurfaceNormals
from ebarf_ns.radiance.ray_sampling import Rays
from ebarf_ns.radiance.renderer import Renderer, Sampling
from ebarf_ns.scene import Scene

# Log brightness is known up to a factor, which the field adapts to; 0.1 or 0.6 instead of 0.25 cost 1 to 2 dB.
_UNKNOWN_THRESHOLD = 0.25
T = TypeVar("T")


def _planned(value: T | None) -> T:
    """A value that the plan must have set; raises :class:`TrainingError` if it is None."""
    if value is None:
        raise TrainingError("this run's config.yml lacks values of its plan: it is of an earlier version of ebarf_ns")
    return value


@dataclass
class EbarfModelConfig(ModelConfig):
    """An event-loss NeRF that corrects its own trajectory."""

    _target: type = field(default_factory=lambda: EbarfModel)
    # nerfstudio's fields that have no effect here, hidden from the flags.
    enable_collider: tyro.conf.Suppress[bool] = False
    collider_params: tyro.conf.Suppress[dict[str, float] | None] = None
    loss_coefficients: tyro.conf.Suppress[dict[str, float]] = field(default_factory=dict)
    prompt: tyro.conf.Suppress[str | None] = None
    eval_num_rays_per_chunk: int = 4096
    camera_optimizer: TrajectoryOptimizerConfig = field(default_factory=TrajectoryOptimizerConfig)
    loss: Literal["threshold", "normalized"] = "threshold"
    """threshold: Eq. 5, with a default threshold if the scene states none; normalized: the paper's Eq. 6."""
    huber_delta: Annotated[float | None, tyro.conf.arg(aliases=old_names("--pipeline.model.huber-delta"))] = 0.3
    """Huber delta: errors of pairs beyond this many standard deviations count linearly; None: squared loss."""
    render_variance: float = 5.0
    """With Eq. 5: variance of a pair's render error, in units of one event's variance; both reduce a pair's weight."""
    threshold_ratio: float | None = None
    """With Eq. 5: C_on / C_off; None: as stated in the scene, else as estimated from the recording."""
    threshold_deviation: float | None = None
    """With Eq. 5: relative standard deviation of that ratio, which training refines; 0: fixed; None: 0 if the ratio is
    stated, else as estimated."""
    learn_intrinsics: tyro.conf.Suppress[bool] = False
    """Set by the trainer to --learn-intrinsics."""
    threshold_prior: float = 0.01
    """Loss of a ratio that is one standard deviation off, where a render error of one threshold costs 1."""
    time_constant_us: float | None = None
    """With Eq. 5: time constant of the photoreceptor at mean brightness; 0: no delay; None: as stated, else learned."""
    time_constant_prior: float = 0.001
    """Loss per millisecond of the time constant, where a render error of one threshold costs 1; a delay that the poses
    explain as well is left to them."""
    brightness: BrightnessKind = "log"
    """How log brightness is computed from intensity; lin_log: Eq. 2."""
    intensity_range: IntensityRange = "positive"
    """Activation of the field's intensity; unit: sigmoid, positive: exponential."""
    view_dependent: bool = False
    """Let intensity depend on the viewing direction."""
    contract: bool | None = None
    """True: the grid covers all of space, contracted; False: only the scene's bounds; None: as planned."""
    grid_levels: int | None = None
    """Levels of the hash grid; None: as planned."""
    grid_features: int = 4
    grid_coarsest: int = 8
    grid_finest: int | None = None
    """Cells per side of the finest level; None: as planned."""
    grid_table_size_log2: int | None = None
    """Log2 of the table rows per level; None: as planned."""
    broad_cells: int | None = None
    """Cells per side of the finest lattice for low-frequency log brightness; 0: none; None: as planned."""
    sampling: Literal["importance", "uniform"] = "importance"
    """Samples along a ray: importance: where the remembered density is; uniform: evenly spaced, as in the paper."""
    samples: int | None = None
    """Field evaluations per ray; None: as planned."""
    coarse_samples: int = Sampling.coarse_samples
    """Points per ray at which the remembered density is looked up for importance sampling."""
    uniform_share: float = Sampling.uniform_share
    """Share of the importance samples that is spread evenly, so that no region is missed."""
    most_hidden: float = Sampling.most_hidden
    """Largest share of what is behind it that a dense interval may occlude in sample placement; 1: all of it."""
    density_cells: int | None = None
    """Cells per side of the remembered density; None: as planned."""
    near: float = Sampling.near
    """Distance at which rays begin, in half scene sizes (without bounds: in four times the trajectory's radius)."""
    precision: Precision | None = None
    """Precision of the MLPs' matrix products; None: as planned."""
    exposure: float = 0.0
    """Brightens the output rgb by this many stops."""
    gamma: float = 1.0
    """Gamma of the output rgb; above 1 lifts the shadows."""

    def __getattr__(self, name: str) -> Any:
        # ns-export marching-cubes reads this attribute first, and would end in a traceback.
        if name == "sdf_field":
            with one_line_errors():
                raise TrainingError("ns-export marching-cubes is for signed distance fields; expected ebarf mesh RUN")
        raise AttributeError(name)


class EbarfModel(Model):
    """Renders rays and compares the two ends of each event pair."""

    config: EbarfModelConfig

    def populate_modules(self) -> None:
        """Build the modules that the scene needs."""
        super().populate_modules()
        config, scene = self.config, self.kwargs["metadata"]["scene"]
        assert isinstance(scene, Scene)
        self.normalized = config.loss == "normalized"
        # The paper's Eq. 6 uses raw polarities and has no scale in which a ratio could be learned.
        given = scene.contrast_threshold
        ratio, deviation = _planned(config.threshold_ratio), _planned(config.threshold_deviation)
        if self.normalized:
            on, off = 1.0, 1.0
        elif given and given.on / given.off == ratio:
            on, off = given.on, given.off
        else:
            mean = sqrt(given.on * given.off) if given else _UNKNOWN_THRESHOLD
            on, off = thresholds_of_ratio(ratio, mean)
        self.sensor = (
            SensorResponse(on, off) if self.normalized else SensorResponse(on, off, deviation, config.time_constant_us)
        )
        self.mean_threshold = (on + off) / 2
        shape = HashGridShape(
            levels=_planned(config.grid_levels),
            features=config.grid_features,
            coarsest=config.grid_coarsest,
            finest=_planned(config.grid_finest),
            table_size_log2=_planned(config.grid_table_size_log2),
        )
        field = RadianceField(
            shape,
            not _planned(config.contract),
            config.view_dependent,
            config.intensity_range,
            precision=_planned(config.precision),
            broad_cells=_planned(config.broad_cells),
        )
        sampling = Sampling(
            _planned(config.samples),
            config.near,
            config.sampling,
            config.coarse_samples,
            config.uniform_share,
            config.most_hidden,
            _planned(config.density_cells),
        )
        self.renderer = Renderer(field, sampling, self.scene_box.aabb[1])
        self.camera_optimizer: TrajectoryOptimizer = config.camera_optimizer.setup(
            num_cameras=self.num_train_data,
            device="cpu",
            keyframes=self.kwargs["metadata"]["keyframes"],
            focal_px=scene.camera.fx,
        )
        self.intrinsics = Intrinsics(scene.camera) if config.learn_intrinsics else None
        self.register_buffer("display_range", torch.tensor([-1.0, 1.0]), persistent=False)
        """Log brightness shown as black and as white."""
        self.display_range: Tensor
        self.exposure, self.gamma = config.exposure, config.gamma
        self.normals: SurfaceNormals | None = None
        self.random = torch.Generator()

    def get_param_groups(self) -> dict[str, list[torch.nn.Parameter]]:
        """Groups: fields, with the sensor's parameters; camera_opt for keyframe corrections; intrinsics, if learned."""
        groups = {"fields": [*self.renderer.parameters(), *self.sensor.parameters()]}
        self.camera_optimizer.get_param_groups(groups)
        if self.intrinsics:
            groups["intrinsics"] = [self.intrinsics.correction]
        return groups

    def pose_parameters(self) -> list[torch.nn.Parameter]:
        """The parameters that determine event rays: all but those of the field and the sensor."""
        return [one for name, group in self.get_param_groups().items() if name != "fields" for one in group]

    def begin_step(self, step: int, seed: int) -> None:
        """Seed random numbers by seed and step, so that a resumed run continues as if never stopped.

        In distributed training, each process has its own seed, and all use the first one's remembered density.
        """
        self.random.manual_seed(seed * 1_000_003 + step)
        self.renderer.begin_step(step, self.random)
        self.camera_optimizer.begin_step(step)
        self.sensor.begin_step(step)

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Rendered intensity, depth, accumulation, log brightness and its grey image for display; sensor parameters;
        for a finished run also surface normals, mapped to [0, 1] as in nerfstudio."""
        if self.intrinsics and "event_pixel" in (ray_bundle.metadata or {}):
            ray_bundle.directions = self.intrinsics.bearings(ray_bundle.metadata.pop("event_pixel")[:, 0])
        self._look_back(ray_bundle)
        self.camera_optimizer.apply_to_raybundle(ray_bundle)
        rays = Rays(ray_bundle.origins, ray_bundle.directions)
        rendered = self.renderer(rays, self.random if self.training else None)
        brightness = log_brightness(rendered.intensity, self.config.brightness)
        normals = {"normals": (self.normals(rays, rendered.depth) + 1) / 2} if self.normals else {}
        return {
            "rgb": self.grey(brightness.detach())[:, None].expand(-1, 3),
            "intensity": rendered.intensity[:, None],
            "brightness": brightness[:, None],
            "depth": rendered.depth[:, None],
            "accumulation": rendered.accumulation[:, None],
            # Distributed training requires all learned parameters to take part in the forward pass.
            "sensor": self.sensor(),
            **normals,
        }

    def _look_back(self, ray_bundle: RayBundle) -> None:
        """Set the photoreceptor's delay of each event ray, which depends on the brightness seen."""
        t_us = (ray_bundle.metadata or {}).get("event_t_us")
        if t_us is None or not self.sensor.delays:
            return
        with torch.no_grad():
            poses = self.camera_optimizer.poses_at(t_us[..., 0])
            rays = Rays(poses.position, rotate(poses.quat_wxyz, ray_bundle.directions))
            brightness = log_brightness(self.renderer(rays).intensity, self.config.brightness)
        ray_bundle.metadata["delay_us"] = self.sensor.delay_us(brightness)

    def get_loss_dict(self, outputs: dict[str, Any], batch: dict[str, Tensor], metrics_dict: Any = None) -> dict:
        """Compare the rendered change of log brightness between the rays of each pair with that reported by events."""
        before, after = outputs["brightness"][:, 0].chunk(2)
        change = after - before
        reported = reported_change(batch["polarity_sum"], batch["event_count"], *outputs["sensor"]).to(change)
        if self.normalized:
            loss = normalized_loss(change, reported)
        else:
            loss = threshold_loss(
                change,
                target_change(change, reported, batch["silent"], *outputs["sensor"]),
                batch["variance"].to(change),
                self.mean_threshold,
                self.config.huber_delta,
                self.config.render_variance,
            )
        losses = {"event_loss": loss}
        if self.sensor.learns_ratio:
            losses["threshold_prior"] = self.config.threshold_prior * self.sensor.prior()
        if self.sensor.learns_time_constant:
            losses["time_constant_prior"] = self.config.time_constant_prior * 1e-3 * self.sensor.time_constant_us
        self.camera_optimizer.get_loss_dict(losses)
        return losses

    def get_metrics_dict(self, outputs: dict[str, Any], batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Mean accumulation, sensor parameters, and how far the keyframes have moved."""
        metrics = {"accumulation": outputs["accumulation"].detach().mean()}
        if self.sensor.learns_time_constant:
            metrics["time_constant_us"] = self.sensor.time_constant_us.detach()
        if self.sensor.learns_ratio:
            metrics |= {name: number.detach() for name, number in outputs["sensor"]._asdict().items()}
        self.camera_optimizer.get_metrics_dict(metrics)
        return metrics

    def grey(self, brightness: Float[Tensor, "*pixels"]) -> Float[Tensor, "*pixels"]:
        """Log brightness mapped to [0, 1] for display."""
        low, high = self.display_range
        return ((brightness + log(2) * self.exposure - low) / (high - low)).clamp(0, 1) ** (1 / self.gamma)

    def fit_display_range(self, brightness: Float[Tensor, "rays"]) -> None:
        """Set the display range to that of these rays, without a thousandth at either end."""
        low, high = torch.quantile(brightness.float(), brightness.new_tensor([0.001, 0.999]))
        seen = torch.stack([low, torch.maximum(high, low + 0.1)])
        self.display_range.copy_(seen.where(seen.isfinite().all(), self.display_range))

    def show_normals(self) -> None:
        """Also render normals from now on, computed from the current field."""
        self.normals = SurfaceNormals(self.renderer)

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Grey with the true accumulation as alpha, so that exported point clouds leave empty space empty."""
        return torch.cat([outputs[output_name], outputs["accumulation"]], dim=-1)

    def get_outputs_for_camera(self, camera: Cameras, obb_box: OrientedBox | None = None) -> dict[str, Tensor]:
        """Render a camera; cameras of the dataset are first moved to their refined poses."""
        moved = camera[...]
        moved.camera_to_worlds = self.camera_optimizer.apply_to_camera(camera).detach()
        return super().get_outputs_for_camera(moved, obb_box)

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Images for nerfstudio's logs; the pipeline computes the metrics over all frames at once."""
        depth = outputs["depth"] / outputs["depth"].amax()
        reference = batch["image"].to(outputs["rgb"])
        return {}, {"img": torch.cat([reference, outputs["rgb"]], dim=1), "depth": depth.expand(-1, -1, 3)}
