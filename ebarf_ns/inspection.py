"""The contents of a scene folder, and what looks wrong in it."""

from dataclasses import dataclass, field
from math import atan2, degrees
from pathlib import Path

import numpy as np
import torch

from ebarf_ns.errors import SceneError
from ebarf_ns.evaluation.frames import read_frame
from ebarf_ns.evaluation.polarity import polarity_contradicted, polarity_correlations
from ebarf_ns.events.pixels import hot_pixels
from ebarf_ns.events.recording import RecordingFile
from ebarf_ns.events.sensor_facts import Estimate, SensorFacts, identify_recording
from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.geometry.smoothing import smoothed
from ebarf_ns.geometry.trajectory import Trajectory, intervals, within_span
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.geometry.trajectory_jumps import torn
from ebarf_ns.machine import free_threads
from ebarf_ns.plan import Line, depth_spread, plan_for
from ebarf_ns.printing import print_facts, print_line
from ebarf_ns.scene import Scene, check_bounds, check_clocks, events_left_out, read_scene

_FEW_EVENTS_PER_PIXEL = 5
_FEW_PIXELS = 0.005
# Rooms are below 2.1; bounds of 2.9 cost 2 dB, and of 4.4 cost 10.
_DEEP = 2.5
# Beyond these fields of view, a focal length in the wrong unit is more likely than such a lens.
_WIDEST_DEG, _WIDEST_FISHEYE_DEG, _NARROWEST_DEG = 150, 240, 2


@dataclass(frozen=True)
class Summary:
    """Statistics of a scene; ``suspicions`` are human-readable warnings."""

    events: int
    width: int
    height: int
    start_us: int
    end_us: int
    events_per_second: float
    brighter_share: float
    silent_pixel_share: float
    events_per_active_pixel: float
    busiest_pixel: tuple[int, int, int]
    """Column, row and number of events."""
    hot_pixels: int
    """Number of hot pixels, which training leaves out."""
    keyframes: int
    trajectory_start_us: int
    trajectory_end_us: int
    keyframes_per_second: float
    path_length: float
    events_within_trajectory: int
    contrast_threshold: tuple[float, float] | None
    bounded: bool
    frames: int
    groundtruth: bool
    distortion: str
    """The camera model if it has distortion, else none."""
    sensor: SensorFacts
    """Sensor properties estimated from the recording."""
    plan: list[Line]
    """The settings that training will use on this machine, unless overridden by flags."""
    suspicions: list[str] = field(default_factory=list)


def inspect_scene(folder: Path) -> Summary:
    """Read the whole scene; raises the reader's error for any file that training could not use."""
    scene = read_scene(folder)
    trajectory = read_tum(scene.trajectory)
    check_bounds(scene, trajectory)
    if scene.groundtruth:
        read_tum(scene.groundtruth)
    if scene.missing:
        raise SceneError(f"{scene.missing[0]}: no such file, expected a validation frame{_and_others(scene)}")
    for frame in scene.frames:
        read_frame(frame)
    summary = _summarize(scene, trajectory)
    check_clocks(scene, (summary.start_us, summary.end_us), trajectory)
    contradicted = polarity_contradicted(polarity_correlations(scene))
    summary.suspicions.extend([contradicted] if contradicted else [])
    summary.suspicions.extend(_suspicions(scene, summary, trajectory))
    return summary


def _and_others(scene: Scene) -> str:
    others = len(scene.missing) - 1
    return f", and {others} more that are named in {scene.folder / 'frames.json'}" if others else ""


def _summarize(scene: Scene, trajectory: Trajectory) -> Summary:
    camera = scene.camera
    file = RecordingFile(scene.events, camera.width, camera.height)
    first_us, last_us = int(trajectory.t_us[0]), int(trajectory.t_us[-1])
    counts, brighter, within = np.zeros(camera.width * camera.height, np.int64), 0, 0
    for chunk in file.chunks():
        counts += np.bincount(chunk.pixels(camera.width), minlength=len(counts))
        brighter += int((chunk.polarity > 0).sum())
        within += len(chunk.between(first_us, last_us))
    events, start_us, end_us = file.span()
    busiest = int(counts.argmax())
    facts = identify_recording(file, (first_us, last_us), scene.refractory_us)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    return Summary(
        events=events,
        width=camera.width,
        height=camera.height,
        start_us=start_us,
        end_us=end_us,
        events_per_second=events / max((end_us - start_us) * 1e-6, 1e-6),
        brighter_share=brighter / events,
        silent_pixel_share=float((counts == 0).mean()),
        events_per_active_pixel=float(counts[counts > 0].mean()),
        busiest_pixel=(busiest % camera.width, busiest // camera.width, int(counts[busiest])),
        hot_pixels=int(hot_pixels(counts, camera.width).sum()),
        keyframes=len(trajectory.t_us),
        trajectory_start_us=first_us,
        trajectory_end_us=last_us,
        keyframes_per_second=(len(trajectory.t_us) - 1) / ((last_us - first_us) * 1e-6),
        path_length=float(trajectory.poses.position.diff(dim=0).norm(dim=-1).sum()),
        events_within_trajectory=within,
        contrast_threshold=(scene.contrast_threshold.on, scene.contrast_threshold.off)
        if scene.contrast_threshold
        else None,
        bounded=scene.bounds is not None,
        frames=len(scene.frames),
        groundtruth=scene.groundtruth is not None,
        distortion=camera.model if camera.distortion else "none",
        sensor=facts,
        plan=[*plan_for(scene, smoothed(trajectory), events, device, facts=facts), free_threads()],
    )


def _suspicions(scene: Scene, summary: Summary, trajectory: Trajectory) -> list[str]:
    found = []
    outside = summary.events - summary.events_within_trajectory
    if summary.events_within_trajectory:
        found += events_left_out(outside, summary.events)
    if not 0.35 < summary.brighter_share < 0.65:
        found.append(f"{summary.brighter_share:.0%} of the events are brighter: unequal thresholds, or polarity lost?")
    if summary.hot_pixels:
        found.append(f"hot pixels, 3 times busier than their neighbours, left out of training: {summary.hot_pixels:,}")
    if summary.sensor.flicker_hz:
        found.append(
            f"lamps flicker at {summary.sensor.flicker_hz:.1f} Hz; {summary.sensor.flicker_share:.0%} of the pixels "
            "follow them, and are left out of training where they are less than half"
        )
    if summary.sensor.clock_step_us > 1:
        found.append(f"times come in steps of {summary.sensor.clock_step_us:,} us: faster changes cannot be resolved")
    if summary.sensor.dead_pixels > 0.01 * summary.width * summary.height:
        found.append(f"pixels that never respond although their neighbours do: {summary.sensor.dead_pixels:,}")
    if summary.events_per_active_pixel < _FEW_EVENTS_PER_PIXEL:
        found.append(
            f"only {summary.events_per_active_pixel:.1f} events per active pixel: too short for a detailed picture"
        )
    active = round((1 - summary.silent_pixel_share) * summary.width * summary.height)
    if active <= _FEW_PIXELS * summary.width * summary.height:
        found.append(f"all events are at {active:,} of {summary.width * summary.height:,} pixels: columns mixed up?")
    found.extend(_view(scene.camera))
    if scene.bounds is not None:
        lower, upper = torch.tensor(scene.bounds, dtype=torch.float64)
        position = trajectory.poses.position
        away = float(((position < lower) | (position > upper)).any(dim=-1).double().mean())
        if away > 0:
            found.append(f"{away:.0%} of the keyframes lie outside the bounds: they must hold all that is seen")
    spread = depth_spread(scene, trajectory)
    if spread is not None and spread > _DEEP:
        found.append(
            f"the bounds are {spread:.1f} times as far away in some directions as in others: detail nearby is lost; "
            'without bounds ("bounds": null in scene.json), space is contracted instead'
        )
    if summary.path_length == 0:
        found.append("the trajectory does not move: without translation, depth cannot be estimated")
    gaps_us = trajectory.t_us.diff()
    if int(gaps_us.max()) > 5 * float(gaps_us.double().median()):
        times = int(gaps_us.max()) / float(gaps_us.double().median())
        found.append(
            f"the longest gap between keyframes is {int(gaps_us.max()) / 1000:.0f} ms, {times:.0f} times the median"
        )
    found.extend(_between_two(summary, trajectory))
    found.extend(torn(trajectory))
    if scene.bounds is None:
        found.append(
            "no bounds in scene.json: all of space is contracted around the trajectory, at some cost in detail; if "
            "the scene is a room, give the distance of its farthest wall to ebarf process as --farthest"
        )
    return found


def _view(camera: Camera) -> list[str]:
    """Return a warning if the field of view is implausible."""
    sides = ((camera.width, camera.fx), (camera.height, camera.fy))
    fisheye = camera.model == "equidistant"
    angles = [degrees(side / focal) if fisheye else degrees(2 * atan2(side / 2, focal)) for side, focal in sides]
    widest = _WIDEST_FISHEYE_DEG if fisheye else _WIDEST_DEG
    if _NARROWEST_DEG <= min(angles) and max(angles) <= widest:
        return []
    return [
        f"the camera sees {angles[0]:.3g} by {angles[1]:.3g} degrees, by focal lengths of {camera.fx:.4g} and "
        f"{camera.fy:.4g} px: in another unit, or of another size of sensor?"
    ]


def _between_two(summary: Summary, trajectory: Trajectory) -> list[str]:
    """Return a warning if all events lie between two keyframes: straight motion, or a wrong time unit."""
    if summary.end_us < summary.trajectory_start_us or summary.start_us > summary.trajectory_end_us:
        return []
    edges = torch.tensor([summary.start_us, summary.end_us], dtype=torch.int64)
    left, _ = intervals(trajectory.t_us, edges)
    among = int(within_span(trajectory.t_us, edges).sum())
    if among >= 2:
        return []
    k = int(left[0])
    gap_ms = float(trajectory.t_us[int(left[1]) + 1] - trajectory.t_us[k]) / 1000
    events_ms = (summary.end_us - summary.start_us) / 1000
    return [
        f"all events, {events_ms:.3g} ms of them, lie between keyframes {k} and {int(left[1]) + 1}, {gap_ms:.3g} ms "
        "apart: times in another unit? ebarf process has --event-time-unit and --pose-time-unit"
    ]


def print_summary(summary: Summary, folder: Path) -> None:
    """Print the summary for people, warnings first."""
    console = print_facts(folder, summary.suspicions, _lines(summary))
    console.print("\nplan of training, and the flags of ns-train that override it:")
    for line in summary.plan:
        print_line(console, f"{line.flag} = {line.value}: {line.reason}")


def _range(estimate: Estimate) -> str:
    value, low, high = (f"{one:.3g}" if one < 100 else f"{one:,.0f}" for one in vars(estimate).values())
    return f"{value} ({low} to {high})"


def _timing(sensor: SensorFacts) -> str:
    clock = "microseconds" if sensor.clock_step_us == 1 else f"steps of {sensor.clock_step_us:,} us"
    lamps = f"lamps flicker at {sensor.flicker_hz:.1f} Hz" if sensor.flicker_hz else "no lamp flickers"
    double = (
        f"{sensor.doubles_share:.1%} doubled within {sensor.doubles_us} us"
        if sensor.doubles_us
        else "no doubled events"
    )
    return f"{clock}; {lamps}; {double}"


def _lines(summary: Summary) -> list[tuple[str, str]]:
    column, row, count = summary.busiest_pixel
    seconds = (summary.end_us - summary.start_us) * 1e-6
    threshold = summary.contrast_threshold
    within = summary.events_within_trajectory / summary.events
    return [
        ("sensor", f"{summary.width} x {summary.height}"),
        ("events", f"{summary.events:,} over {seconds:.3f} s, {summary.events_per_second:,.0f} a second"),
        ("time", f"{summary.start_us:,} to {summary.end_us:,} us"),
        ("polarity", f"{summary.brighter_share:.1%} brighter, {1 - summary.brighter_share:.1%} darker"),
        (
            "pixels",
            f"{summary.silent_pixel_share:.1%} silent, the others {summary.events_per_active_pixel:.1f} events each; "
            f"busiest ({column}, {row}) with {count:,}",
        ),
        (
            "trajectory",
            f"{summary.keyframes} keyframes, {summary.keyframes_per_second:.1f} a second, "
            f"{summary.trajectory_start_us:,} to {summary.trajectory_end_us:,} us, length {summary.path_length:.3f}",
        ),
        ("events within it", f"{summary.events_within_trajectory:,} ({within:.1%})"),
        (
            "thresholds",
            f"stated: on {threshold[0]}, off {threshold[1]}"
            if threshold
            else f"not stated; by ON and OFF events that cancel, on / off: {_range(summary.sensor.threshold_ratio)}",
        ),
        ("blind time", f"{_range(summary.sensor.refractory_us)} us after an event, by the shortest intervals"),
        ("clock, lamps, doubles", _timing(summary.sensor)),
        (
            "broken pixels",
            f"{summary.hot_pixels:,} hot, {summary.sensor.dead_pixels:,} dead; "
            f"{summary.sensor.blank_share:.1%} of the others never fired and saw no edge",
        ),
        (
            "distortion",
            summary.distortion,
        ),
        ("bounds", "given" if summary.bounded else "none: unbounded"),
        (
            "references",
            f"{summary.frames} validation frames, {'ground truth' if summary.groundtruth else 'no ground truth'}",
        ),
    ]
