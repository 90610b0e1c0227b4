"""Scenes by name: surroundings and camera motion."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from ebarf_ns.simulation.motion import HandheldMotion, Motion, OrbitMotion
from ebarf_ns.simulation.room import Room

SceneName = Literal["handheld-room", "slide", "orbit", "hdr-window", "fast-rotation", "low-texture"]


@dataclass(frozen=True)
class Place:
    """A room, a camera motion in it, and the position of an optional mesh."""

    room: Room
    motion: Motion
    middle: tuple[float, float, float] = (1.1, 0.0, -0.3)


def _handheld_room(seed: int) -> Place:
    return Place(Room(seed=seed), HandheldMotion(seed=seed))


def _slide(seed: int) -> Place:
    """Forward-facing translation along a line without rotation, so that depth errors show."""
    motion = HandheldMotion(sway_m=(0.0, 0.6, 0.0), turn_rad=0.0, seed=seed)
    return Place(Room(seed=seed), motion)


def _orbit(seed: int) -> Place:
    boxes = ((-0.4, -0.35, -1.0, 0.3, 0.35, -0.55), (-0.15, -0.5, -0.55, 0.1, 0.0, -0.25))
    balls = ((0.0, 0.2, -0.3, 0.25), (0.55, -0.3, -0.8, 0.2), (-0.5, 0.6, -0.8, 0.2))
    return Place(Room(boxes=boxes, balls=balls, seed=seed), OrbitMotion(seed=seed), OrbitMotion().centre)


def _hdr_window(seed: int) -> Place:
    return Place(Room(window=(-1.2, -0.4, 0.6, 1.0), seed=seed), HandheldMotion(seed=seed))


def _fast_rotation(seed: int) -> Place:
    motion = HandheldMotion(sway_m=(0.12, 0.2, 0.1), turn_rad=0.3, frequency_hz=(0.8, 1.6), seed=seed)
    return Place(Room(seed=seed), motion)


def _low_texture(seed: int) -> Place:
    return Place(Room(log_contrast=0.12, seed=seed), HandheldMotion(seed=seed))


CATALOGUE: dict[SceneName, Callable[[int], Place]] = {
    "handheld-room": _handheld_room,
    "slide": _slide,
    "orbit": _orbit,
    "hdr-window": _hdr_window,
    "fast-rotation": _fast_rotation,
    "low-texture": _low_texture,
}
