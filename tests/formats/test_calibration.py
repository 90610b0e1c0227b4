"""Foreign calibration files are read, and errors are one line that names file and key."""

from pathlib import Path

import numpy as np
import pytest

from ebarf_ns.errors import SceneError
from ebarf_ns.formats.calibration import camera_notes, read_calibration, read_cameras
from ebarf_ns.formats.process import ProcessSettings, process
from ebarf_ns.geometry.cameras import Camera

MATRIX = "[ 60., 0., 32., 0., 61., 24., 0., 0., 1. ]"
OPENCV = (
    "%YAML:1.0\n---\n{width}: 64\n{height}: 48\n{more}{matrix}: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    f"   data: {MATRIX}\n{{distortion}}: !!opencv-matrix\n   rows: 4\n   cols: 1\n   dt: d\n"
    "   data: [ -1.0e-01, 2e-02, 0., 0. ]\n"
)
XML_MATRIX = '<{0} type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt><data>\n {1}</data></{0}>'
XML_CAMERA = (
    "<image_width>64</image_width><image_height>48</image_height>"
    + XML_MATRIX.format("camera_matrix", "60. 0. 32. 0. 61. 24. 0. 0. 1.")
    + XML_MATRIX.format("distortion_coefficients", "-0.1 0.02 0. 0.")
)
KALIBR = (
    "{name}:\n  camera_model: {model}\n  intrinsics: [60.0, 61.0, 32.0, 24.0]\n  distortion_model: {lens}\n"
    "  distortion_coeffs: [-0.1, 0.02, 0.0, 0.0]\n  resolution: [64, 48]\n"
)
VINS = "%YAML:1.0\n---\nmodel_type: {model}\ncamera_name: left\nimage_width: 64\nimage_height: 48\n"
ORB_SLAM = (
    '%YAML:1.0\nCamera.type: "{model}"\n{camera}.fx: 60.0\n{camera}.fy: 61.0\n{camera}.cx: 32.0\n{camera}.cy: 24.0\n'
    "{camera}.k1: -0.1\n{camera}.k2: 0.02\n{rest}Camera.width: 64\nCamera.height: 48\nORBextractor.nLevels: 8\n"
)
EUROC = (
    "sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [1, 0, 0, 0.5, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
    "resolution: [64, 48]\ncamera_model: pinhole\nintrinsics: [60.0, 61.0, 32.0, 24.0]\n"
    "distortion_model: radial-tangential\ndistortion_coefficients: [-0.1, 0.02, 0.0, 0.0]\n"
)
DV = (
    '{"cameras": [{"name": "DVX", "resolution": [64, 48], "focalLength": [60, 61], "principalPoint": [32, 24], '
    '"distortion": [-0.1, 0.02, 0, 0], "distortionModel": "RADIAL_TANGENTIAL"}]}'
)
SPELLED = {"width": "image_width", "height": "image_height", "matrix": "camera_matrix", "more": ""}
OLD = {"width": "image_Width", "height": "image_Height", "matrix": "Camera_Matrix", "more": ""}
READ = {
    "a name of one's own.yaml": (KALIBR.format(name="dvs_left", model="pinhole", lens="radtan"), "radtan"),
    "euroc.yaml": (EUROC, "radtan"),
    "vins.yaml": (
        VINS.format(model="PINHOLE") + "distortion_parameters:\n   k1: -0.1\n   k2: 0.02\n   p1: 0.0\n   p2: 0.0\n"
        "projection_parameters:\n   fx: 60.0\n   fy: 61.0\n   cx: 32.0\n   cy: 24.0\n"
        "body_T_cam0: !!opencv-matrix\n   rows: 1\n   cols: 1\n   dt: d\n   data: [1.]\n",
        "radtan",
    ),
    "vins fisheye.yaml": (
        VINS.format(model="KANNALA_BRANDT") + "projection_parameters:\n   k2: -0.1\n   k3: 0.02\n   k4: 0.0\n"
        "   k5: 0.0\n   mu: 60.0\n   mv: 61.0\n   u0: 32.0\n   v0: 24.0\n",
        "equidistant",
    ),
    "opencv.yaml": (OPENCV.format(**SPELLED, distortion="distortion_coefficients"), "radtan"),
    "opencv old.yml": (OPENCV.format(**OLD, distortion="Distortion_Coefficients"), "radtan"),
    "opencv own.yml": (OPENCV.format(**SPELLED | {"matrix": "cameraMatrix"}, distortion="distCoeffs"), "radtan"),
    "opencv fisheye.yml": (
        OPENCV.format(**SPELLED | {"more": "fisheye_model: 1\n"}, distortion="distortion_coefficients"),
        "equidistant",
    ),
    "opencv.xml": (f'<?xml version="1.0"?>\n<opencv_storage>\n{XML_CAMERA}</opencv_storage>\n', "radtan"),
    "dv.xml": (f"<opencv_storage><type>camera</type><DVX_1>{XML_CAMERA}</DVX_1></opencv_storage>", "radtan"),
    "dv.json": (DV, "radtan"),
    "of a topic.yaml": (
        "header:\n  seq: 1\nheight: 48\nwidth: 64\ndistortion_model: plumb_bob\nD: [-0.1, 0.02, 0.0, 0.0]\n"
        f"K: {MATRIX}\nR: {MATRIX}\n---\n",
        "radtan",
    ),
    "trailing zeros.yaml": (
        "image_width: 64\nimage_height: 48\ndistortion_model: rational_polynomial\n"
        f"camera_matrix: {{data: {MATRIX}}}\ndistortion_coefficients: {{data: [-0.1, 0.02, 0, 0, 0, 0, 0, 0]}}\n",
        "radtan",
    ),
    "orb slam.yaml": (
        ORB_SLAM.format(model="PinHole", camera="Camera", rest="Camera.p1: 0.0\nCamera.p2: 0.0\n"), "radtan"
    ),
    "orb slam 3.yaml": (
        ORB_SLAM.format(model="KannalaBrandt8", camera="Camera1", rest="Camera1.k3: 0.0\nCamera1.k4: 0.0\n"),
        "equidistant",
    ),
}  # fmt: skip


def camera_of(tmp_path: Path, name: str, text: str) -> Camera:
    (tmp_path / name).write_text(text)
    return read_calibration(tmp_path / name).camera


@pytest.mark.parametrize("name", list(READ))
def test_files_of_other_programs_are_read(tmp_path: Path, name: str):
    text, model = READ[name]
    camera = camera_of(tmp_path, name, text)
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (64, 48, 60, 61, 32, 24)
    assert camera.model == model and camera.distortion[:4] == (-0.1, 0.02, 0, 0) and not any(camera.distortion[4:])


def test_the_pose_in_eurocs_file_is_that_of_the_camera_on_its_body(tmp_path: Path):
    (tmp_path / "sensor.yaml").write_text(EUROC)
    pose = read_calibration(tmp_path / "sensor.yaml").rig_from_camera
    assert pose is not None and pose[0, 3] == 0.5


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("omni.yaml", KALIBR.format(name="cam0", model="omni", lens="radtan"), "cam0.camera_model is 'omni', expected"),
        ("fov.yaml", KALIBR.format(name="cam0", model="pinhole", lens="fov"), "distortion_model is 'fov', expected"),
        ("mei.yaml", VINS.format(model="MEI") + "mirror_parameters:\n   xi: 1.2\n", "model_type is 'MEI', expected"),
        (
            "ds.json",
            '{"value0": {"intrinsics": [{"camera_type": "ds", "intrinsics": {}}], "resolution": [[64, 48]], '
            '"T_imu_cam": [{}]}}',
            r"value0.intrinsics\[0\].camera_type is 'ds', expected",
        ),
    ],
)
def test_an_unknown_model_is_reported_with_the_known_ones(tmp_path: Path, name: str, text: str, words: str):
    with pytest.raises(SceneError, match=rf"{words} .*pinhole, radtan .* equidistant"):
        camera_of(tmp_path, name, text)


GOOD = "cam0: {camera_model: pinhole, intrinsics: [60, 61, 32, 24], resolution: [64, 48], distortion_coeffs: [0]}"
LAYOUTS = "expected a camera as kalibr, DSEC, EuRoC, ROS, OpenCV"


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.yaml", GOOD.replace("intrinsics", "intrinsic"), "cam0.intrinsics is missing, expected 4 numbers fx fy cx"),
        ("a.yaml", GOOD.replace("60, 61", "f, 61"), r"cam0.intrinsics is \['f', 61, 32, 24\], expected 4 numbers"),
        ("a.yaml", GOOD.replace("[60, 61, 32, 24]", "some"), "cam0.intrinsics is 'some', expected 4 numbers"),
        ("a.yaml", GOOD.replace("60, 61", "61"), r"cam0.intrinsics is \[61, 32, 24\], expected 4 numbers"),
        ("a.yaml", GOOD.replace("60, 61", "-60, 61"), "cam0.intrinsics is .*, expected focal lengths above 0"),
        ("a.yaml", GOOD.replace("60, 61", ".inf, 61"), "cam0.intrinsics is .*, expected 4 numbers"),
        ("a.yaml", GOOD.replace("[64, 48]", "[64.5, 48]"), r"cam0.resolution is \[64.5, 48\], expected a width and a"),
        ("a.yaml", GOOD.replace("[64, 48]", "64"), "cam0.resolution is 64, expected 2 numbers"),
        ("a.yaml", GOOD.replace("[64, 48]", "[0, 48]"), "cam0.resolution is .*, expected a width and a height"),
        ("a.yaml", GOOD.replace(" resolution: [64, 48],", ""), "not say how large the sensor is, expected --sensor-s"),
        ("a.yaml", GOOD.replace("pinhole", "[pinhole]"), r"cam0.camera_model is \['pinhole'\], expected one of"),
        ("a.yaml", GOOD.replace("[0]", "[1, 2, 3]"), r"cam0.distortion_coeffs is \[1, 2, 3\], expected radtan's k1 k2"),
        ("a.yaml", GOOD.replace("[0]", "[1, 0, 0, 0, 0, 1, 0, 0]"), "cam0.distortion_coeffs is .* and no more"),
        ("a.yaml", GOOD.replace("[0]}", "[0], T_cam_imu: [[1, 2]]}"), r"T_cam_imu is \[\[1, 2\]\], expected a 4 x 4"),
        ("a.yaml", "cam0:\n", f"holds 'cam0', {LAYOUTS}"),
        ("a.yaml", "imu0:\n  rate: 200\n", f"holds 'imu0', {LAYOUTS}"),
        ("a.yaml", "", f"holds nothing, {LAYOUTS}"),
        ("a.yaml", "- 1\n- 2\n", rf"holds \[1, 2\], {LAYOUTS}"),
        ("a.yaml", "hello\n", f"holds 'hello', {LAYOUTS}"),
        ("a.yaml", "cam0: [1, 2\nb: }", r"a.yaml:2: not valid YAML"),
        ("a.yaml", "cam0: !!python/object/apply:os.system [ls]\n", f"holds 'cam0', {LAYOUTS}"),
        ("a.yaml", "cam0: 2024-99-99\n", LAYOUTS),
        ("a.json", '{"camera": ', r"a.json:1: not valid JSON"),
        ("a.json", "[" * 100_000, LAYOUTS),
        ("a.json", '{"value0": [1]}', r"value0 is \[1\], expected names with values"),
        ("a.json", '{"value0": {"intrinsics": []}}', "value0 is not as basalt writes it"),
        ("a.json", DV.replace("60, 61", "60"), r"cameras\[0\].focalLength is \[60\], expected 2 numbers"),
        ("a.xml", "<opencv_storage><K", r"a.xml:1: not valid XML"),
        ("a.xml", "<opencv_storage>hello</opencv_storage>", f"holds 'hello', {LAYOUTS}"),
        ("calib.txt", "60 61 32 24 k1", "holds '60 61 32 24 k1', expected 9 numbers"),
        ("a.npz", "no zip", "cannot be read as an npz file, expected Robust e-NeRF's"),
        ("a.h5", "no HDF5", "cannot be read as an HDF5 file"),
    ],
)
def test_errors_give_their_place_without_library_jargon(tmp_path: Path, name: str, text: str, words: str):
    with pytest.raises(SceneError, match=words) as raised:
        camera_of(tmp_path, name, text)
    said = str(raised.value)
    assert said.startswith(f"{tmp_path / name}:") and "Error" not in said and "\n" not in said and len(said) < 400


def test_other_files_are_no_calibrations(tmp_path: Path):
    (tmp_path / "picture.yaml").write_bytes(b"\x89PNG\r\n")
    with pytest.raises(SceneError, match="byte 0 is not UTF-8 text"):
        read_calibration(tmp_path / "picture.yaml")
    np.savez(tmp_path / "other.npz", events=np.zeros(3))
    with pytest.raises(SceneError, match="intrinsics is missing, expected 4 numbers"):
        read_calibration(tmp_path / "other.npz")
    with pytest.raises(SceneError, match="a folder, expected a calibration file"):
        read_calibration(tmp_path)


def test_only_the_requested_camera_needs_a_known_model(tmp_path: Path):
    path = tmp_path / "chain.yaml"
    path.write_text(
        KALIBR.format(name="left", model="pinhole", lens="radtan")
        + KALIBR.format(name="right", model="ds", lens="none").replace("[60.0,", "[0.5, 0.6, 60.0,")
    )
    assert read_calibration(path, "left").camera.model == "radtan"
    with pytest.raises(SceneError, match="camera not chosen, expected --camera-name with one of left, right"):
        read_calibration(path)
    with pytest.raises(SceneError, match="right.camera_model is 'ds', expected|right.distortion_model"):
        read_calibration(path, "right")


def test_a_sensor_size_missing_in_the_file_can_be_given(tmp_path: Path):
    path = tmp_path / "intrinsics.yaml"
    path.write_text(f"camera_matrix: {MATRIX}\n")
    camera = next(iter(read_cameras(path, (64, 48)).values())).camera
    assert (camera.width, camera.height, camera.model) == (64, 48, "pinhole")


NAMED = "fx: 60\nfy: 61\ncx: 32\ncy: 24\nwidth: 64\nheight: 48\n"
PLAIN = f"camera_matrix: {{data: {MATRIX}}}\nimage_width: 64\nimage_height: 48\n"


@pytest.mark.parametrize(
    "text",
    [
        *(NAMED + f"{key}: [-0.1, 0.02, 0, 0]\n" for key in ("dist", "dist_coeff", "distortion_coefs", "coeffs")),
        PLAIN + "dist: [[-0.1, 0.02, 0, 0, 0]]\n",
        NAMED + "radial: [-0.1, 0.02]\ntangential: [0, 0]\n",
        NAMED + "RadialDistortion: [-0.1, 0.02, 0]\n",
        NAMED + "distortion: {type: radtan, parameters: [-0.1, 0.02, 0, 0]}\n",
        NAMED + "distortion: {coefficients: [-0.1, 0.02, 0, 0]}\n",
        "cam0: {intrinsics: {fx: 60, fy: 61, cx: 32, cy: 24}, resolution: {width: 64, height: 48}, "
        "distortion: {model: plumb_bob, coeffs: [-0.1, 0.02, 0, 0]}}\n",
        NAMED + "distortion: {k1: -0.1, k2: 0.02, p1: 0, p2: 0}\nk1: 0\n",
        NAMED + "k1: -0.1\nk2: 0.02\np1: 0\np2: 0\nk4: 0\ndistance: 5\n",
        PLAIN
        + "D: [-0.1, 0.02, 0, 0]\ndist_coeffs: [-0.1, 0.02, 0, 0, 0]\nP1: [60, 0, 32, 0, 0, 61, 24, 0, 0, 0, 1, 0]\n",
    ],
)
def test_distortion_is_read_under_any_of_its_names(tmp_path: Path, text: str):
    camera = camera_of(tmp_path, "a.yaml", text)
    assert camera.model == "radtan" and camera.distortion[:4] == (-0.1, 0.02, 0, 0)


@pytest.mark.parametrize("lens", ["equidistant", "fisheye"])
def test_a_nested_model_of_the_lens_counts(tmp_path: Path, lens: str):
    text = NAMED + f"distortion: {{type: {lens}, parameters: [-0.1, 0.02, 0, 0]}}\n"
    assert camera_of(tmp_path, "a.yaml", text).model == "equidistant"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (NAMED + "k1: -0.1\nk2: 0.02\np1: 0\np2: 0\nk3: 0\nk4: 0.1\n", "k4 is 0.1, expected 0 or no such key"),
        (NAMED + "distortion_of_mine: [-0.1, 0.02, 0, 0]\n", "distortion_of_mine is .* expected 0 or no such key"),
        (NAMED + "distortion: {mine: [-0.1, 0.02, 0, 0]}\n", "distortion is .*, expected radtan's"),
        (NAMED + "distortion_model: radtan\n", "distortion_coeffs is missing, expected radtan's .* none"),
        (NAMED + "distortion: {type: fov, parameters: [0.9]}\n", "distortion.type is 'fov', expected one of"),
        (PLAIN.replace("60., 0.", "60., 5."), "camera_matrix is .* without the skew of 5"),
        (PLAIN.replace(MATRIX, "[60, 0, 0, 0, 61, 0, 32, 24, 1]"), "camera_matrix is .*transposed, as MATLAB"),
        (PLAIN.replace(MATRIX, "[60, 0, 32, 0, 61, 24, 0, 0, 2]"), "expected rows of fx 0 cx, 0 fy cy and 0 0 1"),
        (PLAIN.replace("64", "48", 1).replace("height: 48", "height: 64"), "middle of 64 by 48; expected the width f"),
        (PLAIN + "binning_x: 2\nbinning_y: 2\n", "binning_x is 2, expected 0 or 1"),
        (PLAIN + "roi: {x_offset: 10, y_offset: 0}\n", "roi.x_offset is 10, expected"),
        (PLAIN + "roi: {x_offset: 0, y_offset: 0, height: 20, width: 64}\n", "roi.height is 20, expected"),
    ],
)
def test_what_would_change_the_camera_is_not_passed_over(tmp_path: Path, text: str, words: str):
    with pytest.raises(SceneError, match=words):
        camera_of(tmp_path, "a.yaml", text)


@pytest.mark.parametrize(
    "more",
    [
        "distortion_model: plumb_bob\nD: []\nbinning_x: 0\nbinning_y: 1\nroi: {x_offset: 0, height: 48, width: 64}\n",
        "roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}\n",
        "distortion_model: none\n",
    ],
)
def test_cameras_as_recorded_without_distortion_are_pinholes(tmp_path: Path, more: str):
    assert camera_of(tmp_path, "a.yaml", PLAIN + more).model == "pinhole"


@pytest.mark.parametrize("size", ["", "<image_width>64</image_width>"])
@pytest.mark.parametrize(("flag", "model"), [("1", "equidistant"), ("0", "radtan")])
def test_dvs_fisheye_flag_stands_beside_the_camera(tmp_path: Path, flag: str, model: str, size: str):
    text = f"<opencv_storage><DVX_1>{XML_CAMERA}</DVX_1><use_fisheye_model>{flag}</use_fisheye_model>{size}"
    assert camera_of(tmp_path, "dv.xml", f"{text}<type>camera</type></opencv_storage>").model == model


def test_an_assumed_model_is_noted(tmp_path: Path):
    (tmp_path / "a.yaml").write_text(PLAIN + "D: [[-0.1], [0.02], [0.001], [0]]\n")
    (note,) = read_calibration(tmp_path / "a.yaml").notes
    assert "4 coefficients and no model of the lens" in note and "fisheye" in note
    (tmp_path / "a.yaml").write_text(PLAIN + "distortion_model: plumb_bob\nD: [-0.1, 0.02, 0.001, 0]\n")
    assert read_calibration(tmp_path / "a.yaml").notes == ()


def test_a_camera_is_shown_in_one_line():
    camera = Camera("radtan", 48, 36, 42, 43, 23.5, 17.5, (-0.1, 0.02, 0, 0, 0))
    assert camera_notes(camera) == ["camera: radtan 48 x 36, f 42 43, c 23.5 17.5, 5 coefficients"]
    assert camera_notes(Camera("pinhole", 48, 36, 42, 43, 12, 26)) == [
        "camera: pinhole 48 x 36, f 42 43, c 12 26, no distortion"
    ]


@pytest.mark.parametrize("centre", [(313, 233), (0, 0), (0.49, 0.486), (42, 17.5)])
def test_a_principal_point_far_from_the_middle_is_suspicious(centre: tuple[float, float]):
    notes = camera_notes(Camera("pinhole", 48, 36, 42, 43, *centre))
    assert len(notes) == 2 and notes[1].startswith("suspicious: the principal point")


def test_process_shows_the_camera_and_what_is_assumed_of_it(tmp_path: Path):
    (tmp_path / "cam.yaml").write_text(PLAIN.replace("32.", "62.") + "D: [-0.1, 0.02, 0, 0]\n")
    t_us = np.arange(0, 100_000, 100)
    np.savez(tmp_path / "ev.npz", t=t_us, x=t_us // 100 % 64, y=t_us // 700 % 48, p=t_us // 300 % 2)
    notes = process("auto", tmp_path / "ev.npz", tmp_path / "scene", ProcessSettings(camera=tmp_path / "cam.yaml"))
    assert "camera: radtan 64 x 48, f 60 61, c 62 24, 4 coefficients" in notes
    assert any(note.startswith("suspicious: the principal point 62 24") for note in notes)
    assert any("4 coefficients and no model of the lens" in note for note in notes)
