"""The data manager: event pairs to rays in the camera frame."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
import tyro
from jaxtyping import Int64
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.utils.dataloaders import FixedIndicesEvalDataloader
from nerfstudio.utils import comms
from torch import Tensor

from ebarf_ns.errors import RecordingError, one_line_errors
from ebarf_ns.events.batches import DrawAhead, HeldoutBlocks, batch_random
from ebarf_ns.events.indexing import index_pairs
from ebarf_ns.events.pairs import EventPairs, PairIndex, joined
from ebarf_ns.events.recording import RecordingFile
from ebarf_ns.events.sensor_facts import SensorFacts, identify
from ebarf_ns.events.timing import clock_step_us, flicker_hz
from ebarf_ns.geometry.trajectory import Trajectory
from ebarf_ns.nerf.dataparser import EbarfDataParserConfig
from ebarf_ns.nerf.terminal import say
from ebarf_ns.nerf.views import EventDataset, SpiralStart
from ebarf_ns.scene import Scene, check_clocks

_HELDOUT_SEED = 1 << 32
_LONGEST_HELDOUT_PAIR = 30
_MOST_FLICKER = 0.5
_VIEWS_SEED = 2 << 32
_BY_CLOCK = (
    "span_us", "index", "_training_index", "_training_batches", "facts", "heldout_pairs", "heldout_blocks",
    "hot_pixels_left_out", "_believed_refractory_us",
)  # fmt: skip


@dataclass
class EventDataManagerConfig(VanillaDataManagerConfig):
    """Event pairs from a scene folder."""

    _target: type = field(default_factory=lambda: EventDataManager)
    dataparser: DataParserConfig = field(default_factory=EbarfDataParserConfig)
    train_num_rays_per_batch: int | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    """Rays per step, two per event pair; None: as planned."""
    eval_num_rays_per_batch: int = 8192
    """Rays of the held-out event pairs, two per pair."""
    longest_pair: int = 30
    """Pairs span 1 to this many events, drawn log-uniformly; 1: only consecutive events, as in the paper."""
    silent_share: float | None = None
    """Share of a batch's pairs that end while the pixel is silent rather than with an event; None: as planned."""
    doubles_us: int | None = None
    """Leave out events that repeat the previous one of their pixel within this time; 0: none; None: as found."""
    blank_share: float | None = None
    """Share of a batch's pairs that join two pixels that never fire, as parts of one surface; None: as planned."""
    refractory_us: int | None = None
    """Refractory period of a pixel after an event; 0: none; None: as stated in the scene, else as found."""
    leave_out_hot_pixels: bool = True
    """Train without pixels that are far busier than their neighbours."""
    leave_out_flicker: bool = True
    """Train without pixels that follow a flickering lamp, if they are less than half of all."""
    heldout_share: float = 0.05
    """Share of the recording's time whose events are held out for heldout_event_loss."""
    index_memory_gib: float = 4.0
    """An event index larger than this (12 bytes per event) is kept in a file under TMPDIR."""
    seed: tyro.conf.Suppress[int] = 0
    """Set by the trainer to --machine.seed; batch k of a seed is always the same."""


class EventDataManager(VanillaDataManager[EventDataset]):
    """Provides rays in the camera frame with their times; the model holds the poses.

    Attributes that read the recording are cached properties: nerfstudio's viewer accesses all others.
    """

    config: EventDataManagerConfig
    train_dataset: EventDataset
    eval_dataset: EventDataset
    clock_offset_us = 0
    """Offset added to the trajectory's times."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.train_dataparser_outputs = self._kept_outputs

    def create_train_dataset(self) -> EventDataset:
        """The views of the keyframes."""
        dataset = super().create_train_dataset()
        # If this is set, nerfstudio compares the sizes of all views: minutes for 100,000, although all are equal.
        self._kept_outputs = self.train_dataparser_outputs
        self.train_dataparser_outputs = None  # pyright: ignore[reportAttributeAccessIssue]
        return dataset

    def setup_train(self) -> None:
        """Index the events when a training starts; the viewer and exporters do not need the recording."""
        # Only training uses batches, and their size is then planned; ns-export sets its own number of rays.
        rays = self.config.train_num_rays_per_batch or 1024
        self.train_pixel_sampler = self._get_pixel_sampler(self.train_dataset, rays)
        if self.test_mode == "val":
            events, pairs = len(self.index.events), int(self.index.count(np.array(1)))
            say(f"{events:,} events, {pairs:,} consecutive pairs")
            total, _, _ = self._recording.span()
            if events < total:
                say(f"left out {total - events:,} events: doubled, or outside the trajectory's span")
            if self.hot_pixels_left_out:
                say(f"left out {self.hot_pixels_left_out:,} hot pixels, 3 times busier than their neighbours")
            if self.refractory_us:
                say(f"pixels are blind for {self.refractory_us:,} us after an event")

    def setup_eval(self) -> None:
        """Create the loaders of full views that nerfstudio's scripts use."""
        self.fixed_indices_eval_dataloader = FixedIndicesEvalDataloader(self.eval_dataset, device=self.device)
        self.eval_dataloader = SpiralStart(self.eval_dataset, device=self.device)

    def show_from(self, refined: Callable[[Cameras], Cameras]) -> None:
        """Replace the cameras of all views by the refined ones."""
        for dataset in (self.train_dataset, self.eval_dataset):
            dataset.show_from(refined(dataset.cameras))
        self.setup_eval()

    @cached_property
    def rank(self) -> int:
        """Global rank of this process in distributed training."""
        return comms.get_rank()

    def shift_clock(self, offset_us: int) -> None:
        """Set the offset of the trajectory's times to ``offset_us``, which changes the events that have poses."""
        if offset_us != self.clock_offset_us:
            self.clock_offset_us = offset_us
            for name in _BY_CLOCK:
                self.__dict__.pop(name, None)

    @cached_property
    def span_us(self) -> tuple[int, int]:
        """The time span with both events and poses; events outside are counted and left out."""
        scene: Scene = self.train_dataset.scene
        trajectory: Trajectory = self.train_dataset.metadata["trajectory"]
        file = self._recording
        _, start_us, end_us = file.span()
        check_clocks(scene, (start_us, end_us), trajectory)
        first_us, last_us = (int(t_us) + self.clock_offset_us for t_us in trajectory.t_us[[0, -1]])
        return max(start_us, first_us), min(end_us, last_us)

    @cached_property
    def _recording(self) -> RecordingFile:
        scene: Scene = self.train_dataset.scene
        return RecordingFile(scene.events, scene.camera.width, scene.camera.height)

    @cached_property
    def index(self) -> PairIndex:
        """All events within the trajectory's span, ready to draw pairs from."""
        file = self._recording
        memory_bytes = int(self.config.index_memory_gib * 2**30)
        within = lambda: (chunk.between(*self.span_us) for chunk in file.chunks())  # noqa: E731
        return index_pairs(within, file.width, file.height, memory_bytes, self.config.doubles_us or 0)

    @cached_property
    def _training_index(self) -> PairIndex:
        index = self.index if self.config.leave_out_hot_pixels else self.index.with_hot_pixels()
        if not self.config.leave_out_flicker:
            return index
        flicker = flicker_hz(index.events, index.first, clock_step_us(index.events["t_us"]))
        if not 0 < flicker.share_of_pixels < _MOST_FLICKER:
            return index
        say(f"left out {flicker.pixels.sum():,} pixels that follow a lamp of {flicker.hz:.1f} Hz")
        return index.without(flicker.pixels)

    @cached_property
    def hot_pixels_left_out(self) -> int:
        """Number of hot pixels left out of training."""
        return self.index.hot_pixels if self.config.leave_out_hot_pixels else 0

    @cached_property
    def heldout_blocks(self) -> HeldoutBlocks:
        """The time blocks whose events are held out from training."""
        return HeldoutBlocks(*self.span_us, self.config.heldout_share)

    @cached_property
    def facts(self) -> SensorFacts:
        """Sensor properties estimated from the recording, independent of flags, so that methods can be compared."""
        return identify(self.index, self.train_dataset.scene.refractory_us)

    @property
    def refractory_us(self) -> int:
        """The refractory period used in training."""
        return self.config.refractory_us or 0

    @cached_property
    def _training_batches(self) -> DrawAhead:
        # Create it before the threads start: otherwise each of them would create its own.
        _ = self._training_index
        ahead = 1 if torch.device(self.device).type == "cpu" else 4
        return DrawAhead(self._draw_training_pairs, self.world_size, ahead)

    def _draw_training_pairs(self, batch: int) -> EventPairs:
        total = self.get_train_rays_per_batch() // 2
        silent = min(int(total * (self.config.silent_share or 0.0)), total - 1)
        blank = min(int(total * (self.config.blank_share or 0.0)), total - 1 - silent)
        blank = blank if len(self._training_index.blank) else 0
        count = total - silent - blank
        random = batch_random(self.config.seed, batch)
        pairs = self._training_index.draw_accepted(
            count, self.config.longest_pair, random, self.heldout_blocks.training, self.refractory_us
        )
        if len(pairs) < count:
            raise RecordingError(
                f"{self.train_dataset.scene.events}: next to no pair of events lies outside the held-out "
                f"{self.config.heldout_share:.0%} of the recording: no pair to train on"
            )
        if not silent:
            return pairs
        # Draw twice as many, since some end before the first event or in held-out time.
        drawn = self._training_index.draw_silent(
            2 * silent, self.config.longest_pair, self.span_us, random, self.refractory_us
        )
        parts = [pairs, drawn.select(self.heldout_blocks.training(drawn)).select(slice(silent))]
        if blank:
            # Draw more, since most join a blank pixel with one that fires.
            width = self.train_dataset.scene.camera.width
            parts.append(self._training_index.draw_blank(4 * blank, width, self.span_us, random).select(slice(blank)))
        return joined(parts)

    @cached_property
    def _believed_refractory_us(self) -> float:
        stated = self.train_dataset.scene.refractory_us
        return self.facts.refractory_us.value if stated is None else stated

    @cached_property
    def heldout_pairs(self) -> EventPairs:
        """The held-out pairs, the same for every method and seed."""
        count = self.config.eval_num_rays_per_batch // 2
        random = batch_random(_HELDOUT_SEED, 0)
        accepted, refractory_us = self.heldout_blocks.heldout, round(self._believed_refractory_us)
        return self.index.draw_accepted(count, _LONGEST_HELDOUT_PAIR, random, accepted, refractory_us)

    @cached_property
    def bearings(self) -> torch.Tensor:
        """Unit viewing direction of every pixel, float32."""
        camera = self.train_dataset.scene.camera
        return camera.bearings(camera.pixel_grid()).float().flatten(0, 1).to(self.device)

    def next_train(self, step: int) -> tuple[RayBundle, dict[str, torch.Tensor]]:
        """Rays of batch ``step``; for scripts that open a finished run, different random rays of any view each time."""
        self.train_count += 1
        if self.test_mode != "val":
            return self.view_rays(self.get_train_rays_per_batch(), self.train_count), {}
        with one_line_errors():
            return self._rays(self._training_batches.batch(step * self.world_size + self.rank))

    def next_eval(self, step: int) -> tuple[RayBundle, dict[str, torch.Tensor]]:
        """Rays of the held-out pairs, the same for every step, method and seed."""
        self.eval_count += 1
        if not len(self.heldout_pairs):
            raise RecordingError(
                f"{self.train_dataset.scene.events}: no pair of events ends in the held-out "
                f"{self.config.heldout_share:.0%} of the recording; expected a larger share or a longer recording"
            )
        return self._rays(self.heldout_pairs)

    def get_train_rays_per_batch(self) -> int:
        """Rays per batch, which ns-export overrides with --num-rays-per-batch."""
        assert self.train_pixel_sampler is not None
        return self.train_pixel_sampler.num_rays_per_batch

    def view_rays(self, count: int, number: int) -> RayBundle:
        """Rays of random pixels at random times within the trajectory, whether or not they have events."""
        scene, random = self.train_dataset.scene, batch_random(_VIEWS_SEED, number)
        trajectory: Trajectory = self.train_dataset.metadata["trajectory"]
        first_us, last_us = (int(t_us) + self.clock_offset_us for t_us in trajectory.t_us[[0, -1]])
        pixel = random.integers(scene.camera.width * scene.camera.height, size=count)
        t_us = random.integers(first_us, last_us, size=count, endpoint=True)
        return self.rays_at(torch.from_numpy(pixel), torch.from_numpy(t_us))

    def rays_at(self, pixel: Int64[Tensor, "rays"], t_us: Int64[Tensor, "rays"]) -> RayBundle:
        """Rays of pixels (row-major index) in the camera frame, with times at which the model places them."""
        pixel = pixel.to(self.device)
        directions = self.bearings[pixel]
        return RayBundle(
            origins=torch.zeros_like(directions),
            directions=directions,
            pixel_area=torch.ones_like(directions[:, :1]),
            camera_indices=torch.zeros_like(directions[:, :1], dtype=torch.long),
            metadata={"event_t_us": t_us.to(self.device)[:, None], "event_pixel": pixel[:, None]},
        )

    def _rays(self, pairs: EventPairs) -> tuple[RayBundle, dict[str, torch.Tensor]]:
        def tensor(column: np.ndarray) -> torch.Tensor:
            return torch.from_numpy(column).to(self.device)

        pixel = torch.cat([tensor(pairs.pixel_before), tensor(pairs.pixel)]).long()
        bundle = self.rays_at(pixel, torch.cat([tensor(pairs.t0_us), tensor(pairs.t1_us)]))
        columns = ("polarity_sum", "event_count", "variance", "silent")
        return bundle, {name: tensor(getattr(pairs, name)) for name in columns}
