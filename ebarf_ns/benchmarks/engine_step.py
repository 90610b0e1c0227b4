"""One training step and its events, built from the core packages only, for timing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib.util import find_spec
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
import torch

from ebarf_ns.events.batches import HeldoutBlocks, batch_random
from ebarf_ns.events.indexing import index_pairs
from ebarf_ns.events.pairs import PairIndex
from ebarf_ns.events.recording import Recording
from ebarf_ns.geometry.so3 import quat_wxyz_exp, rotate
from ebarf_ns.geometry.trajectory import Interpolation, Poses, corrected, interpolate
from ebarf_ns.nerf.keyframe_adam import KeyframeAdam
from ebarf_ns.photometry.brightness import log_brightness
from ebarf_ns.photometry.event_loss import reported_change, threshold_loss
from ebarf_ns.radiance.field import RadianceField, fastest_precision
from ebarf_ns.radiance.lattice import HashGridShape
from ebarf_ns.radiance.ray_sampling import Rays
from ebarf_ns.radiance.renderer import Renderer, Sampling

WIDTH, HEIGHT, FOCAL_PX = 128, 96, 110.0


class Step:
    """One training step from events to updated field and poses, built from the core packages only."""

    def __init__(self, index: PairIndex, pairs: int = 512, samples: int = 16, levels: int = 8, keyframes: int = 41):
        torch.manual_seed(0)
        self.index, self.pairs = index, pairs
        self.heldout = HeldoutBlocks(0, 2_000_000, 0.05)
        self.renderer = renderer(samples, levels)
        rows, columns = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
        plane = torch.stack([(columns - WIDTH / 2) / FOCAL_PX, (rows - HEIGHT / 2) / FOCAL_PX], dim=-1).flatten(0, 1)
        bearing = torch.cat([plane, torch.ones(len(plane), 1)], dim=-1)
        self.bearing = torch.nn.functional.normalize(bearing, dim=-1).to(device())
        self.keyframe_t_us = torch.linspace(0, 2_000_000, keyframes).long().to(device())
        wiggle = torch.sin(torch.linspace(0, 6, keyframes))[:, None] * torch.tensor([0.2, 0.1, 0.05])
        self.start = Poses(wiggle.to(device()), quat_wxyz_exp(wiggle).to(device()))
        self.correction = torch.zeros(keyframes, 6, device=device(), requires_grad=True)
        adam = torch.optim.Adam(self.renderer.parameters(), lr=1e-2, betas=(0.9, 0.99), eps=1e-15, fused=True)
        has_scipy = find_spec("scipy") is not None
        self.optimizers = adam, KeyframeAdam([self.correction], stretches=has_scipy)
        self.interpolation: Interpolation = "cubic" if has_scipy else "linear"
        self.random = torch.Generator()
        self.number = 0

    def draw(self, batch: int) -> Any:
        """Draw event pairs as in training."""
        return self.index.draw_accepted(self.pairs, 30, batch_random(0, batch), self.heldout.training)

    def once(self) -> None:
        """Run one step: event pairs, poses, rays, intensities, difference, loss, gradients, update."""
        self.renderer.begin_step(self.number, self.random)
        drawn = self.draw(self.number)
        t_us = torch.from_numpy(np.r_[drawn.t0_us, drawn.t1_us]).to(device())
        keyframes = corrected(self.start, self.correction / FOCAL_PX)
        poses = interpolate(self.keyframe_t_us, keyframes, t_us, self.interpolation)
        bearing = self.bearing[torch.from_numpy(drawn.pixel).to(device())].repeat(2, 1)
        rendered = self.renderer(Rays(poses.position, rotate(poses.quat_wxyz, bearing)), self.random)
        before, after = log_brightness(rendered.intensity, "log").chunk(2)
        polarity_sum, event_count, variance = (
            torch.from_numpy(column).to(device()) for column in (drawn.polarity_sum, drawn.event_count, drawn.variance)
        )
        reported = reported_change(polarity_sum, event_count, 0.25, 0.25).to(before)
        threshold_loss(after - before, reported, variance.to(before), 0.25).backward()
        for optimizer in self.optimizers:
            optimizer.step()
            optimizer.zero_grad()
        self.number += 1


def renderer(samples: int, levels: int) -> Renderer:
    """A small renderer on this machine's device."""
    shape = HashGridShape(levels=levels, features=4, coarsest=8, finest=192, table_size_log2=15)
    field_ = RadianceField(shape, bounded=True, precision=fastest_precision(device()))
    return Renderer(field_, Sampling(samples)).to(device())


def device() -> str:
    """cuda if available, else cpu."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def median_seconds(once: Callable[[], object], repetitions: int) -> float:
    """Median time of a call after two warm-up calls."""
    times = []
    for _ in range(repetitions + 2):
        started = perf_counter()
        once()
        if device() == "cuda":
            torch.cuda.synchronize()
        times.append(perf_counter() - started)
    return median(times[2:])


def some_events(begin: int, count: int, total: int) -> Recording:
    """Events ``begin`` to ``begin + count`` of a 2 s recording with events at random pixels."""
    random = np.random.default_rng(begin)
    t_us = (np.arange(begin, begin + count) * (2_000_000 / total)).astype(np.int64)
    columns = (random.integers(0, WIDTH, count, np.uint16), random.integers(0, HEIGHT, count, np.uint16))
    return Recording(*columns, t_us, random.choice(np.array([-1, 1], np.int8), count))


def event_chunks(total: int) -> Iterator[Recording]:
    """Yield ``total`` events in chunks."""
    size = 1 << 22
    return (some_events(begin, min(size, total - begin), total) for begin in range(0, total, size))


def event_index(events: int) -> PairIndex:
    """An index of the given number of events."""
    return index_pairs(lambda: event_chunks(events), WIDTH, HEIGHT)
