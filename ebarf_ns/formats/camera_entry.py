"""Convert one entry of a calibration file to a camera."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ebarf_ns.errors import SceneError
from ebarf_ns.formats.named_values import Entry, plain
from ebarf_ns.geometry.cameras import Camera, CameraModel

# Model names in lower case, without underscores and dashes.
_MODELS: dict[str, CameraModel] = {
    "pinhole": "pinhole", "perspective": "pinhole", "none": "pinhole", "": "pinhole", "radtan": "radtan",
    "radialtangential": "radtan", "plumbbob": "radtan", "rationalpolynomial": "radtan", "equidistant": "equidistant",
    "equi": "equidistant", "kb4": "equidistant", "kannalabrandt": "equidistant", "kannalabrandt8": "equidistant",
    "fisheye": "equidistant",
}  # fmt: skip
_KNOWN_MODELS = "pinhole, radtan (plumb_bob, radial-tangential) or equidistant (kb4, fisheye, KANNALA_BRANDT)"
# Spellings of keys by different programs.
INTRINSICS = ("intrinsics", "camera_matrix", "K", "projection_parameters", "intrinsic_matrix")
_COEFFICIENTS = (
    "distortion_coeffs", "distortion_coefficients", "distortion_parameters", "distortion_params", "dist_coeffs",
    "distortion", "D",
)  # fmt: skip
_SIZE = ("resolution", "image_size")
_WIDTH, _HEIGHT = ("image_width", "img_width", "width"), ("image_height", "img_height", "height")
_PROJECTION = ("camera_model", "model_type", "camera_type", "type")
_LENS = ("distortion_model", "distortion_type", "model")
_OF_RADTAN, _OF_EQUIDISTANT = "radtan's k1 k2 p1 p2 [k3] and no more", "equidistant's k1 k2 k3 k4"
_LARGEST_SIDE = 100_000
Size = tuple[int, int]


def camera_of(entry: Entry, size: Size | None) -> Camera:
    """The camera of an entry in any layout; the model is read first, since it defines the coefficients."""
    model = _model(entry)
    fx, fy, cx, cy = _intrinsics(entry)
    coefficients = _coefficients(entry, model)
    # An equidistant lens with zero coefficients is still not a pinhole.
    if model != "equidistant" and not any(coefficients):
        model, coefficients = "pinhole", []
    return Camera(model, *_size(entry, size), fx, fy, cx, cy, tuple(coefficients))


def _model(entry: Entry) -> CameraModel:
    """Model from the projection and distortion keys, else OpenCV's radtan."""
    said: list[CameraModel] = []
    for spellings in (_LENS, _PROJECTION):
        key = entry.key(spellings)
        # DV writes "type: camera".
        if key is None or entry.content[key] == "camera":
            continue
        name = plain(entry.content[key]) if isinstance(entry.content[key], str) else None
        if name not in _MODELS:
            raise entry.wrong(key, f"one of {_KNOWN_MODELS}")
        said.append(_MODELS[name])
    fisheye = entry.key(("fisheye_model", "use_fisheye_model"))
    if fisheye is not None and str(entry.content[fisheye]).lower() in ("1", "true"):
        return "equidistant"
    bent: list[CameraModel] = [model for model in said if model != "pinhole"]
    if bent:
        return bent[0]
    # A declared distortion model of none gives a pinhole without coefficients.
    return "radtan" if entry.key(_LENS) is None else "pinhole"


def _intrinsics(entry: Entry) -> tuple[float, float, float, float]:
    """Focal lengths and principal point in pixels, from a list, a matrix or named values."""
    expected = "4 numbers fx fy cx cy, or a matrix of 3 x 3"
    key = entry.key(INTRINSICS)
    inner = None if key is None else entry.content[key]
    if entry.key(("focal_length",)) is not None:
        values = [_pair(entry, one) for one in ("focal_length", "principal_point")]
        fx, fy, cx, cy = (*values[0], *values[1])
        key = entry.key(("focal_length",))
    elif key is None and entry.key(("fx",)) is None:
        raise entry.wrong("intrinsics", expected)
    elif key is None or _is_named(inner):
        named = entry if key is None else entry.inner(key)
        spelled = (("fx", "mu"), ("fy", "mv"), ("cx", "u0"), ("cy", "v0"))
        fx, fy, cx, cy = (named.number(one) for one in spelled)
        entry, key = named, named.key(("fx", "mu"))
    else:
        values = entry.numbers(key, expected)
        if len(values) not in (4, 9):
            raise entry.wrong(key, expected)
        fx, fy, cx, cy = values if len(values) == 4 else (values[k] for k in (0, 4, 2, 5))
    if not min(fx, fy) > 0:
        raise entry.wrong(key, "focal lengths above 0")
    return fx, fy, cx, cy


def _pair(entry: Entry, name: str) -> list[float]:
    key = entry.key((name,)) or name
    values = entry.numbers(key, "2 numbers")
    if len(values) != 2:
        raise entry.wrong(key, "2 numbers")
    return values


def _coefficients(entry: Entry, model: CameraModel) -> list[float]:
    """Coefficients of the model, from a list or named values."""
    expected = _OF_EQUIDISTANT if model == "equidistant" else _OF_RADTAN
    key = entry.key(_COEFFICIENTS)
    if key is not None:
        if _is_named(entry.content[key]):
            values = _by_name(entry.inner(key), model)
        else:
            values = [] if entry.content[key] == "" else entry.numbers(key, expected)
    else:
        inner = entry.key(INTRINSICS)
        values = _by_name(entry.inner(inner) if _is_named(entry.content.get(inner)) else entry, model)
        key = "distortion_coeffs"
    if model == "pinhole":
        if any(values):
            raise entry.wrong(key, "none, or a distortion_model that has coefficients")
        return []
    if model == "radtan":
        # OpenCV has up to 14; those after the fifth belong to unsupported models.
        values = values if any(values[5:]) else values[:5]
        if len(values) not in (0, 4, 5) and any(values):
            raise entry.wrong(key, expected)
    elif len(values) != 4:
        raise entry.wrong(key, expected)
    return values


def _is_named(value: Any) -> bool:
    """Whether a value holds named numbers, not a list or an OpenCV matrix."""
    return isinstance(value, Mapping) and "data" not in value


def _by_name(entry: Entry, model: CameraModel) -> list[float]:
    """k1, k2 and so on, as far as present; VINS numbers fisheye coefficients from k2."""
    if model != "equidistant":
        names = [name for name in ("k1", "k2", "p1", "p2", "k3") if name in entry.keys]
        names = names and ["k1", "k2", "p1", "p2", *(["k3"] if "k3" in entry.keys else [])]
    elif "k1" in entry.keys:
        names = ["k1", "k2", "k3", "k4"]
    else:
        names = ["k2", "k3", "k4", "k5"] if "k2" in entry.keys else []
    return [entry.number((name,)) for name in names]


def _size(entry: Entry, given: Size | None) -> Size:
    expected = "a width and a height in pixels"
    key = entry.key(_SIZE)
    if key is not None and isinstance(entry.content[key], Mapping):
        entry, key = entry.inner(key), None
    if key is not None:
        width, height = _pair(entry, key)
    elif entry.key(_WIDTH) is not None or entry.key(_HEIGHT) is not None:
        width, height = entry.number(_WIDTH, expected), entry.number(_HEIGHT, expected)
        key = entry.key(_WIDTH)
    elif given is not None:
        return given
    else:
        raise SceneError(f"{entry.path}: does not say how large the sensor is, expected --sensor-size")
    if not all(1 <= side <= _LARGEST_SIDE and side == int(side) for side in (width, height)):
        raise entry.wrong(key, expected)
    return int(width), int(height)


def matrix_of(entry: Entry, key: str) -> np.ndarray:
    """A 4x4 pose matrix; raises :class:`SceneError`."""
    expected = "a 4 x 4 matrix of a pose"
    values = entry.numbers(key, expected)
    if len(values) != 16 or abs(np.linalg.det(np.reshape(values, (4, 4)))) < 1e-9:
        raise entry.wrong(key, expected)
    return np.reshape(values, (4, 4))
