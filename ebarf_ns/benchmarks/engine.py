"""Speed of the engine against baselines in the same run, and how its cost scales with the workload.

The engine's measurements need only torch, numpy, numba and h5py, so ``python -m ebarf_ns.benchmarks.engine`` also runs
on a bare GPU machine (without scipy, poses are interpolated linearly and each keyframe moves alone). Baselines are
measured if nerfstudio is importable, and skipped otherwise.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
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

from ebarf_ns.benchmarks.engine_step import (
    HEIGHT,
    WIDTH,
    Step,
    device,
    event_chunks,
    event_index,
    median_seconds,
    renderer,
)
from ebarf_ns.benchmarks.figures import Figure, machine, shown
from ebarf_ns.benchmarks.roofline import roofline
from ebarf_ns.benchmarks.settings import PARTS, EngineBenchmark, Part
from ebarf_ns.events.batches import DrawAhead, HeldoutBlocks, batch_random
from ebarf_ns.events.indexing import index_pairs
from ebarf_ns.radiance.field import fastest_precision
from ebarf_ns.radiance.hash_grid import HashGrid, encode_reference, fastest_backend
from ebarf_ns.radiance.lattice import HashGridShape
from ebarf_ns.radiance.ray_sampling import Rays

_ROUNDS = 3


def run_engine_benchmark(settings: EngineBenchmark, say: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Run the requested measurements; returns a JSON-ready result, which :func:`table` formats."""
    figures = []
    for part in settings.parts:
        say(f"measuring {part}")
        for figure in getattr(_Engine(settings), part)():
            figures.append({**vars(figure), "verdict": figure.verdict})
            say(f"  {figure.what}: {shown(figure.value)} {figure.unit} {figure.target} {figure.verdict}")
    return {
        "date": date.today().isoformat(),
        "machine": machine(),
        "backend": fastest_backend(torch.zeros(0, 3, device=device())),
        "precision": fastest_precision(device()),
        "versions": {"torch": torch.__version__, "numpy": np.__version__},
        "quick": settings.quick,
        "figures": figures,
    }


class _Engine:
    """One method per part, each yielding figures as they are measured."""

    def __init__(self, settings: EngineBenchmark):
        self.quick, self.seeds, self.seconds = settings.quick, settings.seeds, settings.seconds
        self._repetitions = 2 if settings.quick else 9

    def hash_grid(self) -> Iterator[Figure]:
        """Forward and backward with position gradients: fastest backend, torch reference, nerfstudio's encoding."""
        count = 1_000 if self.quick else 100_000
        shape = HashGridShape(levels=16, features=2, coarsest=16, finest=1024, table_size_log2=19)
        grid = HashGrid(shape).to(device())
        point = torch.rand(count, 3, device=device())
        name = f"hash grid 16 x 2, {count:,} points, forward + backward"
        reference = self._both_ways(
            lambda at: encode_reference(at, grid.table, grid.lattice), point, list(grid.parameters()), few=True
        )
        yield Figure(f"{name}, torch reference", 1e3 * reference, "ms")
        theirs_encode, theirs_parameters = None, []
        if find_spec("nerfstudio"):
            from ebarf_ns.nerf.comparison import hash_encoding

            theirs_encode, theirs_parameters = hash_encoding(shape, device())
        # Alternate, so that other load on the machine affects both equally.
        rounds = []
        for _ in range(1 if self.quick else _ROUNDS):
            ours = self._both_ways(grid, point, list(grid.parameters()))
            theirs = self._both_ways(theirs_encode, point, theirs_parameters, few=True) if theirs_encode else math.nan
            rounds.append((ours, theirs, theirs / ours))
        ours, theirs, ratio = (median(column) for column in zip(*rounds, strict=True))
        yield Figure(f"{name}, {fastest_backend(point)}", 1e3 * ours, "ms")
        if device() == "cuda":
            # Each corner is read twice and accumulated; points and features are read and written once.
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

        return median_seconds(once, 3 if few else self._repetitions)

    def step(self) -> Iterator[Figure]:
        """Training steps without nerfstudio, and the event sampler."""
        index = event_index(10_000 if self.quick else 1_000_000)
        for pairs in (512,) if device() == "cpu" or self.quick else (4096, 16384, 65536):
            step = Step(index, pairs)
            seconds = median_seconds(step.once, self._repetitions)
            yield Figure(f"step of {pairs:,} pairs", 1e3 * seconds, "ms")
            yield Figure(f"pairs per second, {pairs:,} a step", pairs / seconds, "pairs/s")
            # Background threads as in training: one on a CPU, four with a GPU.
            ahead, batches = DrawAhead(step.draw, ahead=1 if device() == "cpu" else 4), count()
            drawn = median_seconds(lambda take=ahead.batch, of=batches: take(next(of)), 20 * self._repetitions)
            yield Figure(f"sampler's speed over the step's, {pairs:,} pairs", seconds / drawn, "times", at_least=5)

    def roofline(self) -> Iterator[Figure]:
        """The field against the machine's compute and memory limits."""
        quick = self.quick
        yield from roofline(
            64 if quick else 1024, 128 if quick else 2048, 1 << (16 if quick else 26), self._repetitions
        )

    def scaling(self) -> Iterator[Figure]:
        """Scaling exponent of the step time in each workload parameter: 1 is linear, 0 is constant."""
        index = event_index(10_000 if self.quick else 1_000_000)
        sweeps: dict[str, tuple[list[int], Callable[[int], Step]]] = {
            "pairs per batch": ([256, 1024, 4096, 16384], lambda n: Step(index, n)),
            "samples": ([8, 16, 32, 64], lambda n: Step(index, samples=n)),
            "levels": ([4, 8, 16], lambda n: Step(index, levels=n)),
            "keyframes": ([10, 100, 1_000, 10_000], lambda n: Step(index, keyframes=n)),
            "events": ([100_000, 1_000_000, 10_000_000, 100_000_000], lambda n: Step(event_index(n))),
        }
        for name, (all_sizes, make) in sweeps.items():
            sizes = all_sizes[:2] if self.quick else all_sizes
            seconds = []
            for size in sizes:
                seconds.append(median_seconds(make(size).once, self._repetitions))
                yield Figure(f"step with {size:,} {name}", 1e3 * seconds[-1], "ms")
            slope = float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])
            flat = name in ("keyframes", "events")
            yield Figure(f"growth with {name}", slope, "exponent", at_most=0.1 if flat else 1.05)

    def frame(self) -> Iterator[Figure]:
        """Rendering a frame at DAVIS346 resolution."""
        width, height = (34, 26) if self.quick else (346, 260)
        frame_renderer = renderer(16, 8).eval()
        x, y = torch.meshgrid(torch.arange(width) / width - 0.5, torch.arange(height) / width - 0.4, indexing="xy")
        direction = torch.stack([x, y, torch.ones_like(x)], dim=-1).flatten(0, 1).to(device())
        rays = Rays(torch.zeros_like(direction), torch.nn.functional.normalize(direction, dim=-1))

        @torch.no_grad()
        def once() -> None:
            for start in range(0, len(direction), 4096):
                frame_renderer(Rays(*(column[start : start + 4096] for column in rays)))

        yield Figure(f"a {width} x {height} frame", median_seconds(once, self._repetitions), "s", at_most=1.5)

    def simulator(self) -> Iterator[Figure]:
        """Simulating a second of handheld motion at DAVIS240C resolution, without import time."""
        name = "simulating 1 s at 240 x 180"
        if not (find_spec("scipy") and find_spec("cv2")):
            yield Figure(name, None, "s")
            return
        from ebarf_ns.simulation.simulate import Simulation, simulate

        small = Simulation(width=24, height=18, focal_px=20.0, duration_s=0.2, frames=1)
        large = Simulation(width=240, height=180, focal_px=206.0, duration_s=1.0)
        with tempfile.TemporaryDirectory() as folder:
            # Compile before the clock starts.
            simulate(small, Path(folder) / "small")
            started = perf_counter()
            simulate(small if self.quick else large, Path(folder) / "large")
            yield Figure(name, perf_counter() - started, "s", at_most=20)

    def index(self) -> Iterator[Figure]:
        """Indexing a large event file, in memory and in a temporary file."""
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
        """Training rays per second of the default method and of stock nerfacto in torch."""
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
        """Training on the demo scene: time until within 1 dB of the final PSNR, and peak memory."""
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


def _copy_bandwidth() -> float:
    """Bytes read and written per second by a copy in GPU memory."""
    source = torch.empty(1 << 28, device="cuda")
    target = torch.empty_like(source)
    return 2 * source.numel() * 4 / median_seconds(lambda: target.copy_(source), 9)


def _write_events(path: Path, events: int) -> None:
    with h5py.File(path, "w") as file:
        dtypes = {"x": "u2", "y": "u2", "t": "i8", "p": "u1"}
        x, y, t, p = (file.create_dataset(f"events/{name}", (events,), dtype) for name, dtype in dtypes.items())
        begin = 0
        for chunk in event_chunks(events):
            rows = slice(begin, begin + len(chunk))
            x[rows], y[rows], t[rows], p[rows] = chunk.x, chunk.y, chunk.t_us, chunk.polarity > 0
            begin += len(chunk)


def _in_own_process(*words: str) -> Any:
    """Run this module in a subprocess and parse its last line: peak memory and nerfstudio's writers are per process."""
    command = [sys.executable, "-m", "ebarf_ns.benchmarks.engine", *words]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])


def _measure_index(path: Path, memory_gib: float) -> dict[str, float]:
    from ebarf_ns.events.recording import RecordingFile
    from ebarf_ns.memory import peak_memory_mib

    file = RecordingFile(path, WIDTH, HEIGHT)
    # Compile before the clock starts.
    index_pairs(lambda: [file.window(0, 20_000)], WIDTH, HEIGHT)
    started = perf_counter()
    index = index_pairs(file.chunks, WIDTH, HEIGHT, int(memory_gib * 2**30))
    seconds = perf_counter() - started
    step = HeldoutBlocks(0, 2_000_000, 0.05)
    batch = median_seconds(lambda: index.draw_accepted(512, 30, batch_random(0, 0), step.training), 30)
    return {"seconds": seconds, "peak_gib": peak_memory_mib() / 1024, "batch_ms": 1e3 * batch}


def _demo_scene(folder: Path, seed: int, quick: bool) -> Path:
    from ebarf_ns.simulation.simulate import Simulation, simulate

    scene = folder / f"scene-{seed}"
    small = {"width": 48, "height": 36, "focal_px": 41.0, "duration_s": 0.5, "frames": 3} if quick else {}
    simulate(Simulation(seed=seed, **small), scene, lambda _: None)
    return scene


def main(words: list[str]) -> None:
    """``python -m ebarf_ns.benchmarks.engine [PART ...]``, for machines without the full dependencies."""
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
