"""Cameras as other programs' calibration files describe them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from reprlib import Repr
from typing import Any
from xml.etree import ElementTree

import h5py
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from ebarf_ns.errors import SceneError, did_you_mean
from ebarf_ns.files import opened_npz
from ebarf_ns.geometry.cameras import Camera, CameraModel

# Without their underscores and dashes, in lower case.
_MODELS: dict[str, CameraModel] = {
    "pinhole": "pinhole", "perspective": "pinhole", "none": "pinhole", "": "pinhole", "radtan": "radtan",
    "radialtangential": "radtan", "plumbbob": "radtan", "rationalpolynomial": "radtan", "equidistant": "equidistant",
    "equi": "equidistant", "kb4": "equidistant", "kannalabrandt": "equidistant", "kannalabrandt8": "equidistant",
    "fisheye": "equidistant",
}  # fmt: skip
_KNOWN_MODELS = "pinhole, radtan (plumb_bob, radial-tangential) or equidistant (kb4, fisheye, KANNALA_BRANDT)"
_KNOWN_LAYOUTS = (
    "a camera as kalibr, DSEC, EuRoC, ROS, OpenCV (yaml, xml), VINS, ORB-SLAM, DV, basalt (TUM-VIE) or a scene.json "
    "write it"
)
# Every program spells its keys in its own way.
_INTRINSICS = ("intrinsics", "camera_matrix", "K", "projection_parameters", "intrinsic_matrix")
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
ECD_EXPECTED = "9 numbers 'fx fy cx cy k1 k2 p1 p2 k3'"
Size = tuple[int, int]


@dataclass(frozen=True)
class Calibrated:
    """A camera, and where it sits on the rig where the file says so."""

    camera: Camera
    rig_from_camera: np.ndarray | None = None
    """4x4, of the IMU or whatever else the file refers to."""


def read_calibration(path: Path, which: str | None = None, sensor_size: Size | None = None) -> Calibrated:
    """The camera named or numbered ``which``, the only one where not given; raises :class:`SceneError`.

    TUM-VIE's (basalt's) JSON, kalibr's camchain and DSEC's YAML, EuRoC's sensor.yaml, ROS' camera_info, OpenCV's YAML
    and XML, the cameras of VINS and ORB-SLAM, Robust e-NeRF's npz, M3ED's h5, a scene.json, and the event camera
    dataset's calib.txt. ``sensor_size`` is for those that do not say it.
    """
    cameras = _cameras(path, sensor_size)
    if which is None and len(cameras) == 1:
        return next(iter(cameras.values()))()
    if which not in cameras:
        chosen = "not chosen" if which is None else repr(which)
        raise SceneError(f"{path}: camera {chosen}, expected --camera-name with one of {', '.join(cameras)}")
    return cameras[which]()


def read_cameras(path: Path, sensor_size: Size | None = None) -> dict[str, Calibrated]:
    """All cameras of a calibration file by name, see :func:`read_calibration`; raises :class:`SceneError`."""
    return {name: read() for name, read in _cameras(path, sensor_size).items()}


def _cameras(path: Path, size: Size | None) -> dict[str, Callable[[], Calibrated]]:
    """What reads each camera: that one cannot be read does not matter to who wants another."""
    if not path.is_file():
        what = "a folder" if path.is_dir() else "no such file"
        raise SceneError(f"{path}: {what}, expected a calibration file{did_you_mean(path)}")
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return {"camera": lambda: _robust_e_nerf(path)}
    if suffix in (".h5", ".hdf5"):
        return _m3ed(path)
    text = _text(path)
    if suffix == ".txt":
        return {"camera": lambda: Calibrated(_nine_numbers(path, text, size))}
    return _of_content(path, _parsed(path, text), size)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: byte {error.start} is not UTF-8 text, expected {_KNOWN_LAYOUTS}") from None
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror}), expected a calibration file") from None


class _AnyTag(yaml.SafeLoader):
    """Plain values whatever their tags, such as OpenCV's, say."""


def _untagged(loader: yaml.SafeLoader, _: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return node.value


_AnyTag.add_multi_constructor("", _untagged)


def _parsed(path: Path, text: str) -> Any:
    """The content of JSON, XML or YAML, of which the first document."""
    try:
        if path.suffix.lower() == ".json":
            return json.loads(text)
        if text.lstrip().startswith("<"):
            return _of_element(ElementTree.fromstring(text.lstrip().encode()))
        loader = _AnyTag(re.sub(r"^%YAML.*$", "", text, flags=re.MULTILINE))
        return loader.get_data() if loader.check_data() else None
    except json.JSONDecodeError as error:
        raise SceneError(f"{path}:{error.lineno}: not valid JSON ({error.msg})") from None
    except ElementTree.ParseError as error:
        raise SceneError(f"{path}:{error.position[0]}: not valid XML") from None
    except yaml.MarkedYAMLError as error:
        line = f":{error.problem_mark.line + 1}" if error.problem_mark else ""
        raise SceneError(f"{path}{line}: not valid YAML ({error.problem or error.context})") from None
    except yaml.reader.ReaderError as error:
        raise SceneError(f"{path}: not valid YAML (character {error.position} is none that text has)") from None
    except (RecursionError, ValueError, TypeError, LookupError, AttributeError):
        # What YAML takes for a date, or a key, may be none.
        raise SceneError(f"{path}: cannot be read as names and values, expected {_KNOWN_LAYOUTS}") from None


def _of_element(element: ElementTree.Element) -> Any:
    """What OpenCV's XML says: text, or what is named in it; a list's parts have no name."""
    parts = list(element)
    if not parts:
        return (element.text or "").strip().strip('"')
    if all(part.tag == "_" for part in parts):
        return [_of_element(part) for part in parts]
    return {part.tag: _of_element(part) for part in parts}


def _of_content(path: Path, content: Any, size: Size | None) -> dict[str, Callable[[], Calibrated]]:
    """The cameras at whatever level they are."""
    top = _Entry(path, "", content)
    if "value0" in top.content:
        return _basalt(top.inner("value0"))
    if isinstance(top.content.get("cameras"), list):
        cameras = [_Entry(path, f"cameras[{k}]", one) for k, one in enumerate(top.content["cameras"])]
        return {str(one.content.get("name", k)): _reader(one, size) for k, one in enumerate(cameras)}
    if any(str(key).startswith(("Camera.", "Camera1.")) for key in top.content):
        return {"camera": _reader(_orb_slam(top), size)}
    # kalibr's camchain at top level, DSEC's under "intrinsics".
    inner = top.content.get("intrinsics")
    if isinstance(inner, Mapping) and any(isinstance(one, Mapping) for one in inner.values()):
        top = top.inner("intrinsics")
    if _is_camera(top.content):
        return {"camera": _reader(top, size)}
    entries = {str(name): top.inner(name) for name, one in top.content.items() if _is_camera(one)}
    if not entries:
        keys = _shown(", ".join(map(str, list(top.content)[:20])))
        raise SceneError(f"{path}: holds {keys if top.content else 'nothing'}, expected {_KNOWN_LAYOUTS}")
    return {name: _chained(entries, name, size) for name in entries}


def _is_camera(content: Any) -> bool:
    if not isinstance(content, Mapping):
        return False
    keys = {_plain(key) for key in content}
    return any(_plain(key) in keys for key in (*_INTRINSICS, "camera_model", "distortion_model", "model_type", "fx"))


def _shown(value: object) -> str:
    """For messages: a beginning, whatever is in a file."""
    beginning = Repr()
    beginning.maxlevel = 2
    return beginning.repr(value)


def _plain(name: object) -> str:
    return re.sub(r"[^a-z0-9]", "", str(name).lower())


class _Entry:
    """A mapping that knows where it stands, so that every complaint names file and key; keys have many spellings."""

    def __init__(self, path: Path, place: str, content: object):
        if not isinstance(content, Mapping):
            held = "nothing" if content is None else _shown(content)
            expected = "names with values" if place else _KNOWN_LAYOUTS
            raise SceneError(f"{path}: {f'{place} is' if place else 'holds'} {held}, expected {expected}")
        self.path, self.place, self.content = path, place, content
        self.keys = {_plain(key): key for key in content}

    def name(self, key: object) -> str:
        """Where a key stands."""
        return f"{self.place}.{key}" if self.place else str(key)

    def key(self, spellings: Sequence[str]) -> Any:
        """The key as it is spelled here; None where it has no value."""
        found = (self.keys[_plain(one)] for one in spellings if _plain(one) in self.keys)
        return next((key for key in found if self.content[key] is not None), None)

    def inner(self, key: Any) -> _Entry:
        """What a key holds."""
        return _Entry(self.path, self.name(key), self.content.get(key))

    def wrong(self, key: Any, expected: str) -> SceneError:
        """The complaint about a key's value."""
        found = f"is {_shown(self.content[key])}" if key in self.content else "is missing"
        return SceneError(f"{self.path}: {self.name(key)} {found}, expected {expected}")

    def numbers(self, key: Any, expected: str) -> list[float]:
        """Finite ones, of a list, of a list of lists, or of an OpenCV matrix."""
        found = _numbers(self.content.get(key))
        if found is None or not np.isfinite(found).all():
            raise self.wrong(key, expected)
        return found

    def number(self, spellings: Sequence[str], expected: str = "a number") -> float:
        """A finite one."""
        key = self.key(spellings)
        values = self.numbers(spellings[0] if key is None else key, expected)
        if len(values) != 1:
            raise self.wrong(key, expected)
        return values[0]


def _numbers(value: Any, depth: int = 0) -> list[float] | None:
    if isinstance(value, Mapping):
        value = value.get("data")
    if isinstance(value, str) and depth < 2:
        # XML's, and those that YAML takes for text, such as 1e-05.
        try:
            return [float(word) for word in value.split()] or None
        except ValueError:
            return None
    if isinstance(value, list | tuple) and depth < 2 and len(value) <= 64:
        parts = [_numbers(one, depth + 1) for one in value]
        return None if any(part is None for part in parts) else [one for part in parts for one in part or ()]
    if isinstance(value, int | float) and not isinstance(value, bool):
        return [float(value)] if abs(value) < 1e300 else [np.inf]
    return None


def _reader(entry: _Entry, size: Size | None) -> Callable[[], Calibrated]:
    def read() -> Calibrated:
        body = entry.key(("T_BS",))
        return Calibrated(_camera(entry, size), None if body is None else _matrix(entry, body))

    return read


def _camera(entry: _Entry, size: Size | None) -> Camera:
    """A camera of any layout; the model comes first, which says what its numbers are."""
    model = _model(entry)
    fx, fy, cx, cy = _intrinsics(entry)
    coefficients = _coefficients(entry, model)
    # Without any coefficient, an equidistant lens is still no pinhole.
    if model != "equidistant" and not any(coefficients):
        model, coefficients = "pinhole", []
    return Camera(model, *_size(entry, size), fx, fy, cx, cy, tuple(coefficients))


def _model(entry: _Entry) -> CameraModel:
    """By projection and lens, where the file says so; else what OpenCV's coefficients are."""
    said: list[CameraModel] = []
    for spellings in (_LENS, _PROJECTION):
        key = entry.key(spellings)
        # DV writes "type: camera".
        if key is None or entry.content[key] == "camera":
            continue
        name = _plain(entry.content[key]) if isinstance(entry.content[key], str) else None
        if name not in _MODELS:
            raise entry.wrong(key, f"one of {_KNOWN_MODELS}")
        said.append(_MODELS[name])
    fisheye = entry.key(("fisheye_model", "use_fisheye_model"))
    if fisheye is not None and str(entry.content[fisheye]).lower() in ("1", "true"):
        return "equidistant"
    bent: list[CameraModel] = [model for model in said if model != "pinhole"]
    if bent:
        return bent[0]
    # A lens that is said to have no distortion is left without coefficients, see there.
    return "radtan" if entry.key(_LENS) is None else "pinhole"


def _intrinsics(entry: _Entry) -> tuple[float, float, float, float]:
    """Focal lengths and principal point, in pixels, from a list, a matrix or by their names."""
    expected = "4 numbers fx fy cx cy, or a matrix of 3 x 3"
    key = entry.key(_INTRINSICS)
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


def _pair(entry: _Entry, name: str) -> list[float]:
    key = entry.key((name,)) or name
    values = entry.numbers(key, "2 numbers")
    if len(values) != 2:
        raise entry.wrong(key, "2 numbers")
    return values


def _coefficients(entry: _Entry, model: CameraModel) -> list[float]:
    """As the model has them, from a list or by their names."""
    expected = _OF_EQUIDISTANT if model == "equidistant" else _OF_RADTAN
    key = entry.key(_COEFFICIENTS)
    if key is not None:
        if _is_named(entry.content[key]):
            values = _by_name(entry.inner(key), model)
        else:
            values = [] if entry.content[key] == "" else entry.numbers(key, expected)
    else:
        inner = entry.key(_INTRINSICS)
        values = _by_name(entry.inner(inner) if _is_named(entry.content.get(inner)) else entry, model)
        key = "distortion_coeffs"
    if model == "pinhole":
        if any(values):
            raise entry.wrong(key, "none, or a distortion_model that has coefficients")
        return []
    if model == "radtan":
        # OpenCV has up to 14, those after the fifth of models that are not known here.
        values = values if any(values[5:]) else values[:5]
        if len(values) not in (0, 4, 5) and any(values):
            raise entry.wrong(key, expected)
    elif len(values) != 4:
        raise entry.wrong(key, expected)
    return values


def _is_named(value: Any) -> bool:
    """Whether numbers are told by their names, not a list or an OpenCV matrix."""
    return isinstance(value, Mapping) and "data" not in value


def _by_name(entry: _Entry, model: CameraModel) -> list[float]:
    """k1, k2 and so on, as far as there are any; VINS begins to count its fisheye's at k2."""
    if model != "equidistant":
        names = [name for name in ("k1", "k2", "p1", "p2", "k3") if name in entry.keys]
        names = names and ["k1", "k2", "p1", "p2", *(["k3"] if "k3" in entry.keys else [])]
    elif "k1" in entry.keys:
        names = ["k1", "k2", "k3", "k4"]
    else:
        names = ["k2", "k3", "k4", "k5"] if "k2" in entry.keys else []
    return [entry.number((name,)) for name in names]


def _size(entry: _Entry, given: Size | None) -> Size:
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


def _orb_slam(top: _Entry) -> _Entry:
    """Keys such as Camera.fx; of two cameras, the first."""
    prefix = (
        "Camera." if any(str(key).startswith("Camera.") and "fx" in str(key) for key in top.content) else "Camera1."
    )
    named = {key: value for key, value in top.content.items() if str(key).startswith((prefix, "Camera."))}
    return _Entry(top.path, prefix[:-1], {str(key).split(".", 1)[1]: value for key, value in named.items()})


def _basalt(top: _Entry) -> dict[str, Callable[[], Calibrated]]:
    parts = [top.content.get(name) for name in ("intrinsics", "resolution", "T_imu_cam")]
    if not all(isinstance(part, list) and len(part) == len(parts[0] or ()) for part in parts):
        raise SceneError(
            f"{top.path}: {top.place} is not as basalt writes it, expected intrinsics, resolution and T_imu_cam "
            "in lists of one length"
        )
    return {str(k): _of_basalt(top, k, *those) for k, those in enumerate(zip(*parts, strict=True))}  # pyright: ignore[reportArgumentType]


def _of_basalt(top: _Entry, number: int, lens: Any, size: Any, pose: Any) -> Callable[[], Calibrated]:
    def read() -> Calibrated:
        entry = _Entry(top.path, f"{top.name('intrinsics')}[{number}]", lens)
        camera = _camera(_Entry(top.path, entry.place, {**entry.content, "resolution": size}), None)
        placed = _Entry(top.path, f"{top.name('T_imu_cam')}[{number}]", pose)
        values = {one: placed.number((one,)) for one in ("px", "py", "pz", *_TURN)}
        if not any(values[one] for one in _TURN):
            raise placed.wrong("qw", "a quaternion that is not 0")
        return Calibrated(camera, pose_matrix(values))

    return read


_TURN = ("qx", "qy", "qz", "qw")


def pose_matrix(entry: Mapping[str, float]) -> np.ndarray:
    """4x4 of px py pz qx qy qz qw."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat([entry[name] for name in _TURN]).as_matrix()
    matrix[:3, 3] = [entry[name] for name in ("px", "py", "pz")]
    return matrix


def _matrix(entry: _Entry, key: str) -> np.ndarray:
    expected = "a 4 x 4 matrix of a pose"
    values = entry.numbers(key, expected)
    if len(values) != 16 or abs(np.linalg.det(np.reshape(values, (4, 4)))) < 1e-9:
        raise entry.wrong(key, expected)
    return np.reshape(values, (4, 4))


def _chained(entries: Mapping[str, _Entry], name: str, size: Size | None) -> Callable[[], Calibrated]:
    """kalibr's cameras are on the IMU where it says so of all, else as seen from the first."""

    def read() -> Calibrated:
        entry = entries[name]
        camera = _camera(entry, size)
        if all("T_cam_imu" in one.content for one in entries.values()):
            return Calibrated(camera, np.linalg.inv(_matrix(entry, "T_cam_imu")))
        if entry.content.get("T_BS") is not None:
            return Calibrated(camera, _matrix(entry, "T_BS"))
        pose = np.eye(4)
        before = list(entries)[1 : list(entries).index(name) + 1]
        for one in (entries[other] for other in before):
            if one.content.get("T_cn_cnm1") is None:
                return Calibrated(camera)
            pose = pose @ np.linalg.inv(_matrix(one, "T_cn_cnm1"))
        return Calibrated(camera, pose if len(entries) > 1 else None)

    return read


def _nine_numbers(path: Path, text: str, sensor_size: Size | None) -> Camera:
    values = _numbers(text) or []
    if len(values) != 9 or not np.isfinite(values).all() or min(values[:2]) <= 0:
        raise SceneError(f"{path}: holds {' '.join(text[:400].split())[:80]!r}, expected {ECD_EXPECTED}")
    if sensor_size is None:
        raise SceneError(f"{path}: does not say how large the sensor is, expected --sensor-size")
    fx, fy, cx, cy, *distortion = values
    return Camera("radtan", *sensor_size, fx, fy, cx, cy, tuple(distortion))


def _m3ed(path: Path) -> dict[str, Callable[[], Calibrated]]:
    """The cameras among the groups with a ``calib``, by the groups' names; the rig is the left event camera."""
    needed = {"intrinsics", "resolution", "distortion_model", "distortion_coeffs"}
    found: dict[str, Callable[[], Calibrated]] = {}
    try:
        with h5py.File(path, "r") as file:
            groups: list[str] = []
            file.visit(lambda name: groups.append(name) if name.endswith("/calib") else None)
            for name in groups:
                group: Any = file[name]
                content = {key: _value(one) for key, one in group.items()} if isinstance(group, h5py.Group) else {}
                if needed <= content.keys():
                    found[name.removesuffix("/calib")] = _of_m3ed(_Entry(path, name, content))
    except (OSError, RuntimeError, KeyError):
        raise SceneError(f"{path}: cannot be read as an HDF5 file, expected a whole one") from None
    if not found:
        raise SceneError(f"{path}: holds no calibration, expected groups named calib with {', '.join(sorted(needed))}")
    return found


def _value(node: Any) -> Any:
    """A list, number or text; None of what is none."""
    if not isinstance(node, h5py.Dataset) or node.size is None or node.size > 64:
        return None
    value = np.asarray(node).tolist()
    return value.decode(errors="replace") if isinstance(value, bytes) else value


def _of_m3ed(entry: _Entry) -> Callable[[], Calibrated]:
    def read() -> Calibrated:
        pose = entry.key(("T_to_prophesee_left",))
        return Calibrated(_camera(entry, None), None if pose is None else _matrix(entry, pose))

    return read


def _robust_e_nerf(path: Path) -> Calibrated:
    try:
        with opened_npz(path) as file:
            content = {name: file[name].tolist() for name in file.files}
    except (OSError, ValueError):
        raise SceneError(f"{path}: cannot be read as an npz file, expected Robust e-NeRF's calibration") from None
    return Calibrated(_camera(_Entry(path, "", content), None))
