"""How fast the engine is, measured side by side in one run, and how its cost grows with the work.

What is ours needs only torch, numpy, numba and h5py, so that ``python -m ebarf_ns.benchmarks.engine`` also runs on a
bare machine with a GPU (without scipy, poses are straight between keyframes, each of which moves alone); what it is
compared with is measured where nerfstudio is importable, and left out where not.
"""

from __future__ import annotations

import json
import math
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from datetime import date
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import h5py
import numpy as np
import torch

from ebarf_ns.benchmarks.settings import PARTS, EngineBenchmark, Part
from ebarf_ns.events.pairs import DrawAhead, HeldoutBlocks, PairIndex, batch_random, index_pairs
from ebarf_ns.events.recording import Recording
from ebarf_ns.files import whole_file
from ebarf_ns.geometry.so3 import quat_wxyz_exp, rotate
from ebarf_ns.geometry.trajectory import Interpolation, Poses, corrected, interpolate
from ebarf_ns.nerf.keyframe_adam import KeyframeAdam
from ebarf_ns.photometry.brightness import log_brightness
from ebarf_ns.photometry.event_loss import reported_change, threshold_loss
from ebarf_ns.radiance.field import RadianceField, fastest_precision
from ebarf_ns.radiance.hash_grid import HashGrid, HashGridShape, encode_reference, fastest_carrier
from ebarf_ns.radiance.ray_sampling import Rays
from ebarf_ns.radiance.renderer import Renderer, Sampling

WIDTH, HEIGHT, FOCAL_PX = 128, 96, 110.0
_ROUNDS = 3


@dataclass(frozen=True)
class Figure:
    """One measured number and, where there is one, what it should reach."""

    what: str
    value: float | None
    unit: str
    at_least: float | None = None
    at_most: float | None = None

    @property
    def verdict(self) -> str:
        """Whether the target is met; empty where there is none."""
        if self.value is None:
            return "not measured"
        if self.at_least is not None:
            return "reached" if self.value >= self.at_least else "missed"
        if self.at_most is not None:
            return "reached" if self.value <= self.at_most else "missed"
        return ""

    @property
    def target(self) -> str:
        """For a person."""
        if self.at_least is not None:
            return f">= {self.at_least:g}"
        return f"<= {self.at_most:g}" if self.at_most is not None else ""


def run_engine_benchmark(settings: EngineBenchmark, say: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Measure everything asked for; returns what :func:`table` shows, ready for JSON."""
    figures = []
    for part in settings.parts:
        say(f"measuring {part}")
        for figure in getattr(_Engine(settings), part)():
            figures.append({**vars(figure), "verdict": figure.verdict})
            say(f"  {figure.what}: {_shown(figure.value)} {figure.unit} {figure.target} {figure.verdict}")
    return {
        "date": date.today().isoformat(),
        "machine": machine(),
        "carrier": fastest_carrier(torch.zeros(0, 3, device=_device())),
        "precision": fastest_precision(_device()),
        "versions": {"torch": torch.__version__, "numpy": np.__version__},
        "quick": settings.quick,
        "figures": figures,
    }


class _Engine:
    """One method for each part, which yields its figures as they come."""

    def __init__(self, settings: EngineBenchmark):
        self.quick, self.seeds, self.seconds = settings.quick, settings.seeds, settings.seconds
        self._repetitions = 2 if settings.quick else 9

    def hash_grid(self) -> Iterator[Figure]:
        """Forward and backward with position gradients: the fastest carrier, the torch reference, nerfstudio's."""
        count = 1_000 if self.quick else 100_000
        shape = HashGridShape(levels=16, features=2, coarsest=16, finest=1024, table_size_log2=19)
        grid = HashGrid(shape).to(_device())
        point = torch.rand(count, 3, device=_device())
        name = f"hash grid 16 x 2, {count:,} points, forward + backward"
        reference = self._both_ways(
            lambda at: encode_reference(at, grid.table, grid.lattice), point, list(grid.parameters()), few=True
        )
        yield Figure(f"{name}, torch reference", 1e3 * reference, "ms")
        theirs_encode, theirs_parameters = None, []
        if find_spec("nerfstudio"):
            from ebarf_ns.nerf.comparison import hash_encoding

            theirs_encode, theirs_parameters = hash_encoding(shape, _device())
        # In turns: whatever else the machine does meets both.
        rounds = []
        for _ in range(1 if self.quick else _ROUNDS):
            ours = self._both_ways(grid, point, list(grid.parameters()))
            theirs = self._both_ways(theirs_encode, point, theirs_parameters, few=True) if theirs_encode else math.nan
            rounds.append((ours, theirs, theirs / ours))
        ours, theirs, ratio = (median(column) for column in zip(*rounds, strict=True))
        yield Figure(f"{name}, {fastest_carrier(point)}", 1e3 * ours, "ms")
        if _device() == "cuda":
            # Each corner is read, read again and added to; points and features come and go once.
            moved = count * 16 * (8 * 2 * 4 * 4 + 2 * 2 * 4) + count * 3 * 4 * 3
            yield Figure(f"{name}, corner traffic at copy bandwidth", 1e3 * moved / _copy_bandwidth(), "ms")
        if theirs_encode:
            yield Figure(f"{name}, nerfstudio's HashEncoding (torch)", 1e3 * theirs, "ms")
            yield Figure("hash grid against nerfstudio's", ratio, "times", at_least=12)

    def _both_ways(self, encode: Callable, point: torch.Tensor, parameters: list, few: bool = False) -> float:
        point = point.clone().requires_grad_()
        weight = torch.rand_like(encode(point).detach())

        def once() -> None:
            torch.autograd.grad(encode(point), [*parameters, point], weight)

        return _seconds(once, 3 if few else self._repetitions)

    def step(self) -> Iterator[Figure]:
        """Training steps without nerfstudio around them, and the sampler beside them."""
        index = _index(10_000 if self.quick else 1_000_000)
        for pairs in (512,) if _device() == "cpu" or self.quick else (4096, 16384, 65536):
            step = _Step(index, pairs)
            seconds = _seconds(step.once, self._repetitions)
            yield Figure(f"step of {pairs:,} pairs", 1e3 * seconds, "ms")
            yield Figure(f"pairs per second, {pairs:,} a step", pairs / seconds, "pairs/s")
            # As in training: threads of its own, one on a CPU and four beside a GPU.
            ahead, batches = DrawAhead(step.draw, ahead=1 if _device() == "cpu" else 4), count()
            drawn = _seconds(lambda take=ahead.batch, of=batches: take(next(of)), 20 * self._repetitions)
            yield Figure(f"sampler's speed over the step's, {pairs:,} pairs", seconds / drawn, "times", at_least=5)

    def scaling(self) -> Iterator[Figure]:
        """Exponent of the seconds a step takes as one kind of work grows: 1 is linear, 0 is flat."""
        index = _index(10_000 if self.quick else 1_000_000)
        sweeps: dict[str, tuple[list[int], Callable[[int], _Step]]] = {
            "pairs per batch": ([256, 1024, 4096, 16384], lambda n: _Step(index, n)),
            "samples": ([8, 16, 32, 64], lambda n: _Step(index, samples=n)),
            "levels": ([4, 8, 16], lambda n: _Step(index, levels=n)),
            "keyframes": ([10, 100, 1_000, 10_000], lambda n: _Step(index, keyframes=n)),
            "events": ([100_000, 1_000_000, 10_000_000, 100_000_000], lambda n: _Step(_index(n))),
        }
        for name, (all_sizes, make) in sweeps.items():
            sizes = all_sizes[:2] if self.quick else all_sizes
            seconds = []
            for size in sizes:
                seconds.append(_seconds(make(size).once, self._repetitions))
                yield Figure(f"step with {size:,} {name}", 1e3 * seconds[-1], "ms")
            slope = float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])
            flat = name in ("keyframes", "events")
            yield Figure(f"growth with {name}", slope, "exponent", at_most=0.1 if flat else 1.05)

    def frame(self) -> Iterator[Figure]:
        """A DAVIS346's frame."""
        width, height = (34, 26) if self.quick else (346, 260)
        renderer = _renderer(16, 8).eval()
        x, y = torch.meshgrid(torch.arange(width) / width - 0.5, torch.arange(height) / width - 0.4, indexing="xy")
        direction = torch.stack([x, y, torch.ones_like(x)], dim=-1).flatten(0, 1).to(_device())
        rays = Rays(torch.zeros_like(direction), torch.nn.functional.normalize(direction, dim=-1))

        @torch.no_grad()
        def once() -> None:
            for start in range(0, len(direction), 4096):
                renderer(Rays(*(column[start : start + 4096] for column in rays)))

        yield Figure(f"a {width} x {height} frame", _seconds(once, self._repetitions), "s", at_most=1.5)

    def simulator(self) -> Iterator[Figure]:
        """A second of handheld motion before a DAVIS240C, from command to scene folder but for the imports."""
        name = "simulating 1 s at 240 x 180"
        if not (find_spec("scipy") and find_spec("cv2")):
            yield Figure(name, None, "s")
            return
        from ebarf_ns.simulation.simulate import Simulation, simulate

        small = Simulation(width=24, height=18, focal_px=20.0, duration_s=0.2, frames=1)
        large = Simulation(width=240, height=180, focal_px=206.0, duration_s=1.0)
        with tempfile.TemporaryDirectory() as folder:
            # Compiled before the clock starts.
            simulate(small, Path(folder) / "small")
            started = perf_counter()
            simulate(small if self.quick else large, Path(folder) / "large")
            yield Figure(name, perf_counter() - started, "s", at_most=20)

    def index(self) -> Iterator[Figure]:
        """An index of many events from a file, in memory and in a file of its own."""
        events = 100_000 if self.quick else 100_000_000
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "events.h5"
            _write_events(path, events)
            for place, memory_gib in (
                ("in memory", 1e6),
                ("in a file, with an eighth of the memory", events * 12 / 2**33),
            ):
                made = _in_own_process("index", str(path), str(memory_gib))
                name = f"index of {events:,} events, {place}"
                yield Figure(name, made["seconds"], "s", at_most=90)
                yield Figure(f"{name}: peak memory", made["peak_gib"], "GiB", at_most=6)
                yield Figure(f"{name}: a batch of 512 pairs", made["batch_ms"], "ms")

    def nerfacto(self) -> Iterator[Figure]:
        """Training rays per second of our default method, and of stock nerfacto in torch."""
        if not find_spec("nerfstudio"):
            yield Figure("training rays per second against nerfacto", None, "times")
            return
        from ebarf_ns.nerf.comparison import nerfacto_rays_per_second

        with tempfile.TemporaryDirectory() as folder:
            scene = _demo_scene(Path(folder), 0, self.quick)
            ours, shape = _in_own_process("ebarf", str(scene), folder, "20" if self.quick else "200")
        yield Figure("ebarf, training rays per second", ours, "rays/s")
        rays, repetitions = (64, 1) if self.quick else (4096, 12)
        cut = "nerfacto with the same grid and final samples"
        for name, changed, target in (("nerfacto", {}, 60), (cut, shape, 8)):
            theirs = nerfacto_rays_per_second(changed, rays, repetitions)
            yield Figure(f"{name}, training rays per second", theirs, "rays/s")
            yield Figure(f"ebarf against {name}", ours / theirs, "times", at_least=target)

    def training(self) -> Iterator[Figure]:
        """Trainings on the demo scene: how soon they are within 1 dB of where they end, and what memory they take."""
        if not find_spec("nerfstudio"):
            yield Figure("time until within 1 dB of the final PSNR", None, "s")
            return
        from ebarf_ns.benchmarks.training import train

        soon, memory = [], []
        seconds = 3.0 if self.quick else self.seconds
        for seed in self.seeds[:1] if self.quick else self.seeds:
            with tempfile.TemporaryDirectory() as folder:
                scene = _demo_scene(Path(folder), seed, self.quick)
                records = train(["ebarf"], scene, Path(folder) / "x" / "ebarf" / "run", seed, seconds, evaluations=24)
            last = records[-1]
            soon.append(next(one["train_seconds"] for one in records if one["psnr"] >= last["psnr"] - 1))
            memory.append(last["peak_memory_mib"] / 1024)
            yield Figure(f"demo scene, seed {seed}, {seconds:g} s: PSNR", last["psnr"], "dB")
            yield Figure(f"demo scene, seed {seed}, {seconds:g} s: position error", 100 * last["ate_m"], "cm")
            yield Figure(f"demo scene, seed {seed}, {seconds:g} s: rotation error", last["rotation_deg"], "deg")
            yield Figure(f"demo scene, seed {seed}: within 1 dB of that", soon[-1], "s")
        yield Figure("time until within 1 dB of the final PSNR, median", median(soon), "s", at_most=60)
        yield Figure("peak memory of training, largest", max(memory), "GiB", at_most=2)


class _Step:
    """One training step from events to updated field and poses, of the core rooms alone."""

    def __init__(self, index: PairIndex, pairs: int = 512, samples: int = 16, levels: int = 8, keyframes: int = 41):
        torch.manual_seed(0)
        self.index, self.pairs = index, pairs
        self.heldout = HeldoutBlocks(0, 2_000_000, 0.05)
        self.renderer = _renderer(samples, levels)
        rows, columns = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
        plane = torch.stack([(columns - WIDTH / 2) / FOCAL_PX, (rows - HEIGHT / 2) / FOCAL_PX], dim=-1).flatten(0, 1)
        bearing = torch.cat([plane, torch.ones(len(plane), 1)], dim=-1)
        self.bearing = torch.nn.functional.normalize(bearing, dim=-1).to(_device())
        self.keyframe_t_us = torch.linspace(0, 2_000_000, keyframes).long().to(_device())
        wiggle = torch.sin(torch.linspace(0, 6, keyframes))[:, None] * torch.tensor([0.2, 0.1, 0.05])
        self.start = Poses(wiggle.to(_device()), quat_wxyz_exp(wiggle).to(_device()))
        self.correction = torch.zeros(keyframes, 6, device=_device(), requires_grad=True)
        adam = torch.optim.Adam(self.renderer.parameters(), lr=1e-2, betas=(0.9, 0.99), eps=1e-15, fused=True)
        has_scipy = find_spec("scipy") is not None
        self.optimizers = adam, KeyframeAdam([self.correction], stretches=has_scipy)
        self.interpolation: Interpolation = "cubic" if has_scipy else "linear"
        self.random = torch.Generator()
        self.number = 0

    def draw(self, batch: int) -> Any:
        """Event pairs, as in training."""
        return self.index.draw_accepted(self.pairs, 30, batch_random(0, batch), self.heldout.training)

    def once(self) -> None:
        """Event pairs, poses, rays, intensities, difference, loss, gradients, update."""
        self.renderer.begin_step(self.number, self.random)
        drawn = self.draw(self.number)
        t_us = torch.from_numpy(np.r_[drawn.t0_us, drawn.t1_us]).to(_device())
        keyframes = corrected(self.start, self.correction / FOCAL_PX)
        poses = interpolate(self.keyframe_t_us, keyframes, t_us, self.interpolation)
        bearing = self.bearing[torch.from_numpy(drawn.pixel).to(_device())].repeat(2, 1)
        rendered = self.renderer(Rays(poses.position, rotate(poses.quat_wxyz, bearing)), self.random)
        before, after = log_brightness(rendered.intensity, "log").chunk(2)
        polarity_sum, event_count, variance = (
            torch.from_numpy(column).to(_device()) for column in (drawn.polarity_sum, drawn.event_count, drawn.variance)
        )
        reported = reported_change(polarity_sum, event_count, 0.25, 0.25).to(before)
        threshold_loss(after - before, reported, variance.to(before), 0.25).backward()
        for optimizer in self.optimizers:
            optimizer.step()
            optimizer.zero_grad()
        self.number += 1


def _renderer(samples: int, levels: int) -> Renderer:
    shape = HashGridShape(levels=levels, features=4, coarsest=8, finest=192, table_size_log2=15)
    field_ = RadianceField(shape, bounded=True, precision=fastest_precision(_device()))
    return Renderer(field_, Sampling(samples)).to(_device())


def _device() -> str:
    return "cuda" if torch.cuda.is_available() else "cpu"


def _seconds(once: Callable[[], object], repetitions: int) -> float:
    """Median time after two calls to warm up."""
    times = []
    for _ in range(repetitions + 2):
        started = perf_counter()
        once()
        if _device() == "cuda":
            torch.cuda.synchronize()
        times.append(perf_counter() - started)
    return median(times[2:])


def _copy_bandwidth() -> float:
    """Bytes read and written a second by a copy within the GPU's memory."""
    source = torch.empty(1 << 28, device="cuda")
    target = torch.empty_like(source)
    return 2 * source.numel() * 4 / _seconds(lambda: target.copy_(source), 9)


def _some_events(begin: int, count: int, total: int) -> Recording:
    """Events ``begin`` to ``begin + count`` of a recording of 2 s in which every pixel takes part."""
    random = np.random.default_rng(begin)
    t_us = (np.arange(begin, begin + count) * (2_000_000 / total)).astype(np.int64)
    columns = (random.integers(0, WIDTH, count, np.uint16), random.integers(0, HEIGHT, count, np.uint16))
    return Recording(*columns, t_us, random.choice(np.array([-1, 1], np.int8), count))


def _chunks(total: int) -> Iterator[Recording]:
    size = 1 << 22
    return (_some_events(begin, min(size, total - begin), total) for begin in range(0, total, size))


def _index(events: int) -> PairIndex:
    return index_pairs(lambda: _chunks(events), WIDTH, HEIGHT)


def _write_events(path: Path, events: int) -> None:
    with h5py.File(path, "w") as file:
        dtypes = {"x": "u2", "y": "u2", "t": "i8", "p": "u1"}
        x, y, t, p = (file.create_dataset(f"events/{name}", (events,), dtype) for name, dtype in dtypes.items())
        begin = 0
        for chunk in _chunks(events):
            rows = slice(begin, begin + len(chunk))
            x[rows], y[rows], t[rows], p[rows] = chunk.x, chunk.y, chunk.t_us, chunk.polarity > 0
            begin += len(chunk)


def _in_own_process(*words: str) -> Any:
    """What this module prints last when called with these words: memory and nerfstudio's writers are a process's."""
    command = [sys.executable, "-m", "ebarf_ns.benchmarks.engine", *words]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])


def _measure_index(path: Path, memory_gib: float) -> dict[str, float]:
    from ebarf_ns.events.recording import RecordingFile
    from ebarf_ns.memory import peak_memory_mib

    file = RecordingFile(path, WIDTH, HEIGHT)
    # Compiled before the clock starts.
    index_pairs(lambda: [file.window(0, 20_000)], WIDTH, HEIGHT)
    started = perf_counter()
    index = index_pairs(file.chunks, WIDTH, HEIGHT, int(memory_gib * 2**30))
    seconds = perf_counter() - started
    step = HeldoutBlocks(0, 2_000_000, 0.05)
    batch = _seconds(lambda: index.draw_accepted(512, 30, batch_random(0, 0), step.training), 30)
    return {"seconds": seconds, "peak_gib": peak_memory_mib() / 1024, "batch_ms": 1e3 * batch}


def _demo_scene(folder: Path, seed: int, quick: bool) -> Path:
    from ebarf_ns.simulation.simulate import Simulation, simulate

    scene = folder / f"scene-{seed}"
    small = {"width": 48, "height": 36, "focal_px": 41.0, "duration_s": 0.5, "frames": 3} if quick else {}
    simulate(Simulation(seed=seed, **small), scene, lambda _: None)
    return scene


def machine() -> str:
    """Processor or GPU, for people."""
    if torch.cuda.is_available():
        return f"one {torch.cuda.get_device_name()}"
    name = platform.processor() or platform.machine()
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), name)
    return f"{os.cpu_count()} cores of {name}"


def _shown(value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return "-"
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def table(result: dict[str, Any]) -> str:
    """The figures, as Markdown."""
    lines = [f"{result['machine']}, {result['date']}", "", "| what | measured | target | |", "|---|---|---|---|"]
    for one in result["figures"]:
        figure = Figure(**{name: value for name, value in one.items() if name != "verdict"})
        lines.append(f"| {figure.what} | {_shown(figure.value)} {figure.unit} | {figure.target} | {figure.verdict} |")
    return "\n".join(lines)


def write(result: dict[str, Any], path: Path) -> None:
    """Keep the figures as JSON."""
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def main(words: list[str]) -> None:
    """``python -m ebarf_ns.benchmarks.engine [PART ...]``: for machines without the rest of the project."""
    if words[:1] == ["index"] and len(words) == 3:
        print(json.dumps(_measure_index(Path(words[1]), float(words[2]))))
        return
    if words[:1] == ["ebarf"] and len(words) == 4:
        from ebarf_ns.nerf.comparison import ebarf_rays_per_second

        print(json.dumps(ebarf_rays_per_second(Path(words[1]), Path(words[2]), int(words[3]))))
        return
    quick = "--quick" in words
    parts: tuple[Part, ...] = tuple(part for part in PARTS if part in words) or PARTS
    result = run_engine_benchmark(EngineBenchmark(parts, quick), lambda line: print(line, file=sys.stderr, flush=True))
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main(sys.argv[1:])
