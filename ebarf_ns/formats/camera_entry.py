"""Convert one entry of a calibration file to a camera."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from ebarf_ns.errors import SceneError
from ebarf_ns.formats.named_values import Entry, numbers_of, plain
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
    "distortion_coeffs", "distortion_coefficients", "distortion_parameters", "distortion_params", "distortion_coefs",
    "dist_coeffs", "dist_coeff", "dist_coefs", "distortion", "dist", "coeffs", "coefficients", "D",
)  # fmt: skip
_NESTED = ("parameters", "params", "coefficients", "coeffs", "coefs", "values")
_RADIAL, _TANGENTIAL = ("radial", "radial_distortion"), ("tangential", "tangential_distortion")
FISHEYE = ("fisheye_model", "use_fisheye_model")
# Keys (as :func:`plain` makes them) that look like distortion.
_LIKE_DISTORTION = re.compile(r"dist(?!ance)|coef|radial|tangential|[kp]\d+$")
_SIZE = ("resolution", "image_size")
_WIDTH, _HEIGHT = ("image_width", "img_width", "width"), ("image_height", "img_height", "height")
_PROJECTION = ("camera_model", "model_type", "camera_type", "type")
_LENS = ("distortion_model", "distortion_type", "model")
_OF_RADTAN, _OF_EQUIDISTANT = "radtan's k1 k2 p1 p2 [k3] and no more", "equidistant's k1 k2 k3 k4"
_LARGEST_SIDE = 100_000
# A skew below this in pixels moves nothing by more than about a tenth of one.
_SMALL_SKEW, _ROUNDING = 0.1, 1e-6
# Shares of a side.
_IN_THE_MIDDLE = 0.05
Size = tuple[int, int]


def camera_of(entry: Entry, size: Size | None) -> tuple[Camera, list[str]]:
    """The camera of an entry in any layout, and a note if the model of its lens is assumed.

    Raises :class:`SceneError` for anything in the entry that would change the camera but is not known.
    """
    # The model is read first, since it defines the coefficients.
    model, told = _model(entry)
    _check_pixels(entry)
    fx, fy, cx, cy = _intrinsics(entry)
    coefficients, named = _coefficients(entry, model, told)
    notes = []
    if len(coefficients) == 4 and any(coefficients) and not (told or named):
        notes = [
            f"{entry.path.name}: 4 coefficients and no model of the lens: read as OpenCV's k1 k2 p1 p2, not as the "
            "k1 k2 k3 k4 of a fisheye (distortion_model: equidistant)"
        ]
    # An equidistant lens with zero coefficients is still not a pinhole.
    if model != "equidistant" and not any(coefficients):
        model, coefficients = "pinhole", []
    width, height = _size(entry, size)
    if _turned(width, height, cx, cy):
        raise SceneError(
            f"{entry.path}: the sensor is {width} columns by {height} rows, but the centre {cx:g} {cy:g} is in the "
            f"middle of {height} by {width}; expected the width first"
        )
    return Camera(model, width, height, fx, fy, cx, cy, tuple(coefficients)), notes


def _turned(width: int, height: int, cx: float, cy: float) -> bool:
    """Whether the principal point is far from the middle, and in it if width and height are exchanged."""
    off, exchanged = (
        max(abs((cx + 0.5) / columns - 0.5), abs((cy + 0.5) / rows - 0.5))
        for columns, rows in ((width, height), (height, width))
    )
    return exchanged < _IN_THE_MIDDLE and off > 2 * _IN_THE_MIDDLE


def _model(entry: Entry) -> tuple[CameraModel, bool]:
    """Model from the projection and distortion keys, else OpenCV's radtan, and whether the file names the lens."""
    said: list[CameraModel] = []
    key = entry.key(_COEFFICIENTS)
    nested = entry.inner(key) if _is_named(entry.content.get(key)) else None
    places = [(entry, _LENS), (entry, _PROJECTION), *([(nested, (*_LENS, "type"))] if nested else [])]
    for place, spellings in places:
        key = place.key(spellings)
        # DV writes "type: camera".
        if key is None or place.content[key] == "camera":
            continue
        name = plain(place.content[key]) if isinstance(place.content[key], str) else None
        if name not in _MODELS:
            raise place.wrong(key, f"one of {_KNOWN_MODELS}")
        said.append(_MODELS[name])
    fisheye = entry.key(FISHEYE)
    if fisheye is not None and str(entry.content[fisheye]).lower() in ("1", "true"):
        return "equidistant", True
    bent: list[CameraModel] = [model for model in said if model != "pinhole"]
    if bent:
        return bent[0], True
    # A declared distortion model of none gives a pinhole without coefficients; that of OpenCV's flag is radtan.
    declared = entry.key(_LENS) is not None or (nested is not None and nested.key((*_LENS, "type")) is not None)
    return ("pinhole", True) if declared else ("radtan", fisheye is not None)


def _check_pixels(entry: Entry) -> None:
    """Raise :class:`SceneError` if the camera is of pixels other than those that are recorded (ROS' camera_info)."""
    for name in ("binning_x", "binning_y"):
        if (key := entry.key((name,))) is not None and entry.number((name,)) not in (0, 1):
            raise entry.wrong(key, "0 or 1, for a camera whose pixels are those of the events")
    roi = entry.key(("roi",))
    if roi is None:
        return
    part = entry.inner(roi)
    for name, whole in (("x_offset", ()), ("y_offset", ()), ("width", _WIDTH), ("height", _HEIGHT)):
        key, of = part.key((name,)), entry.key(whole)
        if key is None or part.number((name,)) in (0, entry.number(whole) if of is not None else 0):
            continue
        raise part.wrong(key, "a region of interest that is the whole image, as that of the events")


def _intrinsics(entry: Entry) -> tuple[float, float, float, float]:
    """Focal lengths and principal point in pixels, from a list, a matrix or named values."""
    expected = "4 numbers fx fy cx cy, or a matrix of 3 x 3"
    key = entry.key(INTRINSICS)
    inner, matrix = None if key is None else entry.content[key], []
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
        matrix = values if len(values) == 9 else matrix
    if not min(fx, fy) > 0:
        raise entry.wrong(key, "focal lengths above 0")
    if matrix:
        _check_matrix(entry, key, matrix)
    return fx, fy, cx, cy


def _pair(entry: Entry, name: str) -> list[float]:
    key = entry.key((name,)) or name
    values = entry.numbers(key, "2 numbers")
    if len(values) != 2:
        raise entry.wrong(key, "2 numbers")
    return values


def _check_matrix(entry: Entry, key: Any, values: list[float]) -> None:
    """Raise :class:`SceneError` if a 3 x 3 matrix holds more than fx fy cx cy."""
    rows = "rows of fx 0 cx, 0 fy cy and 0 0 1"
    _, skew, cx, below, _, cy, *last = values
    if not any((skew, cx, cy)) and any(last[:2]):
        raise entry.wrong(key, f"{rows}: this is transposed, as MATLAB has it, whose cx and cy also count from 1")
    if max(abs(below), abs(last[0]), abs(last[1]), abs(last[2] - 1)) > _ROUNDING:
        raise entry.wrong(key, rows)
    if abs(skew) > _SMALL_SKEW:
        raise entry.wrong(key, f"{rows}, without the skew of {skew:g}")


def _coefficients(entry: Entry, model: CameraModel, told: bool) -> tuple[list[float], bool]:
    """Coefficients of the model, and whether their names tell that they are radtan's.

    Raises :class:`SceneError` for those that are missing or not used.
    """
    expected = _OF_EQUIDISTANT if model == "equidistant" else _OF_RADTAN
    key = entry.key(_COEFFICIENTS)
    mapping = key if key is not None else entry.key(INTRINSICS)
    places = [entry.inner(mapping)] if _is_named(entry.content.get(mapping)) else []
    values, used = [], []
    if key is None:
        places, key = [*places, entry], "distortion_coeffs"
    elif not places:
        values, used = [] if entry.content[key] == "" else entry.numbers(key, expected), [key]
    for place in places:
        if not used:
            values, used = _by_name(place, model)
    for place in (entry, *places):
        _check_unused(place, [key, *used], values)
    if model == "pinhole":
        if any(values):
            raise entry.wrong(key, "none, or a distortion_model that has coefficients")
        return [], False
    if not used and (told or key in entry.content):
        raise entry.wrong(key, f"{expected}, or the distortion_model none")
    if model == "radtan":
        # OpenCV has up to 14; those after the fifth belong to unsupported models.
        values = values if any(values[5:]) else values[:5]
        if len(values) not in (0, 4, 5) and any(values):
            raise entry.wrong(key, expected)
    elif len(values) != 4:
        raise entry.wrong(key, expected)
    return values, any(plain(one).startswith(("p1", "tangential")) for one in used)


def _check_unused(entry: Entry, used: list[Any], values: list[float]) -> None:
    """Raise :class:`SceneError` for numbers that look like distortion and are not among those that were read."""
    for name, key in entry.keys.items():
        if key in used or not _LIKE_DISTORTION.match(name):
            continue
        numbers = numbers_of(entry.content[key]) or []
        # P1 may be a matrix of projection.
        if set(numbers) - {0.0, *values} and not (len(name) == 2 and len(numbers) > 1):
            raise entry.wrong(key, "0 or no such key: it is not among the distortion that is read here")


def _is_named(value: Any) -> bool:
    """Whether a value holds named numbers, not a list or an OpenCV matrix."""
    return isinstance(value, Mapping) and "data" not in value


def _by_name(entry: Entry, model: CameraModel) -> tuple[list[float], list[Any]]:
    """A list, or k1, k2 and so on, as far as present, with their keys; VINS numbers fisheye coefficients from k2."""
    key, radial, tangential = (entry.key(names) for names in (_NESTED, _RADIAL, _TANGENTIAL))
    if key is not None:
        return entry.numbers(key, "coefficients of the distortion"), [key]
    if model != "equidistant" and radial is not None:
        along = entry.numbers(radial, "2 or 3 numbers k1 k2 [k3]")
        if len(along) not in (2, 3):
            raise entry.wrong(radial, "2 or 3 numbers k1 k2 [k3]")
        across = [0.0, 0.0] if tangential is None else _pair(entry, tangential)
        return [*along[:2], *across, *along[2:]], [radial, tangential]
    if model != "equidistant":
        names = [name for name in ("k1", "k2", "p1", "p2", "k3") if name in entry.keys]
        names = names and ["k1", "k2", "p1", "p2", *(["k3"] if "k3" in entry.keys else [])]
    elif "k1" in entry.keys:
        names = ["k1", "k2", "k3", "k4"]
    else:
        names = ["k2", "k3", "k4", "k5"] if "k2" in entry.keys else []
    return [entry.number((name,)) for name in names], [entry.keys.get(name) for name in names]


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
        raise SceneError(f"{entry.path}: does not say how large the sensor is, expected --sensor-size WIDTH HEIGHT")
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
