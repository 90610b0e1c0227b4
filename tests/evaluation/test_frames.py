from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import torchvision

from ebarf_ns.errors import EvaluationError
from ebarf_ns.evaluation.frames import (
    depth_error,
    fit_brightness,
    image_errors,
    lpips_missing,
    read_depth,
    read_frame,
)
from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.scene import Frame

CAMERA = Camera("pinhole", 32, 24, 30, 30, 15.5, 11.5)


def frame(path: Path, intensity: str = "linear") -> Frame:
    return Frame(path, 0, CAMERA, (), intensity)  # pyright: ignore[reportArgumentType]


def picture(seed: int = 0) -> np.ndarray:
    smooth = cv2.GaussianBlur(np.random.default_rng(seed).random((24, 32)), (0, 0), 2)
    return 0.05 + 0.9 * (smooth - smooth.min()) / np.ptp(smooth)


@pytest.mark.parametrize(("dtype", "white"), [(np.uint8, 255), (np.uint16, 65535)])
def test_png_of_either_depth_is_read_as_zero_to_one(tmp_path: Path, dtype: type, white: int):
    cv2.imwrite(str(tmp_path / "a.png"), (picture() * white).round().astype(dtype))
    assert np.allclose(read_frame(frame(tmp_path / "a.png")), picture(), atol=1 / white)


def test_intensity_says_how_to_get_to_linear(tmp_path: Path):
    np.save(tmp_path / "log.npy", np.log(picture()).astype(np.float32))
    assert np.allclose(read_frame(frame(tmp_path / "log.npy", "log")), picture(), rtol=1e-5)
    srgb = np.where(picture() <= 0.0031308, 12.92 * picture(), 1.055 * picture() ** (1 / 2.4) - 0.055)
    np.save(tmp_path / "srgb.npy", srgb)
    assert np.allclose(read_frame(frame(tmp_path / "srgb.npy", "srgb")), picture(), rtol=1e-6)


@pytest.mark.parametrize(("intensity", "value"), [("linear", np.nan), ("linear", np.inf), ("log", 1e4)])
def test_pixels_that_are_not_finite_are_counted(tmp_path: Path, intensity: str, value: float):
    pixels = picture()
    pixels[3, 4:6] = value
    np.save(tmp_path / "a.npy", pixels)
    with pytest.raises(EvaluationError, match=f"a.npy: 2 pixels are not finite as {intensity} intensity"):
        read_frame(frame(tmp_path / "a.npy", intensity))


def test_exr_is_read(tmp_path: Path):
    cv2.imwrite(str(tmp_path / "a.exr"), (5 * picture()).astype(np.float32))
    assert np.allclose(read_frame(frame(tmp_path / "a.exr")), 5 * picture(), rtol=1e-3)


def test_wrong_size_or_no_image_is_named(tmp_path: Path):
    np.save(tmp_path / "small.npy", np.zeros((3, 4)))
    with pytest.raises(EvaluationError, match=r"4x3 pixels, expected the camera's 32x24"):
        read_frame(frame(tmp_path / "small.npy"))
    (tmp_path / "a.png").write_text("no image")
    (tmp_path / "a.npy").write_text("no array")
    (tmp_path / "a.exr").write_text("no image")
    for name in ("a.png", "a.npy", "a.exr"):
        with pytest.raises(EvaluationError, match="cannot be read"):
            read_frame(frame(tmp_path / name))


def test_gain_and_offset_of_log_brightness_are_no_error():
    references = [picture(0), picture(1)]
    renders = [1.7 * np.log(image) - 3 for image in references]
    assert image_errors(renders, references)["psnr"] > 80
    noisy = [render + 0.1 * np.random.default_rng(0).standard_normal(render.shape) for render in renders]
    errors = image_errors(noisy, references)
    again = image_errors([0.3 * image + 9 for image in noisy], references)
    assert 15 < errors["psnr"] < 40 and again["psnr"] == pytest.approx(errors["psnr"], abs=1e-4)


def test_an_inverted_render_is_said_to_be_and_is_not_turned_over():
    references = [picture(0), picture(1)]
    right, inverted, grey = (
        image_errors(renders, references)
        for renders in (
            [np.log(image) for image in references],
            [-0.7 * np.log(image) for image in references],
            [0.0 * image for image in references],
        )
    )
    assert right["inverted"] == 0 and inverted["inverted"] == 1
    assert inverted["psnr"] < grey["psnr"] and inverted["log_correlation"] < -0.9 < 0.99 < right["log_correlation"]


def test_high_passed_correlation_sees_detail_through_a_ramp_and_no_detail_in_one():
    random = np.random.default_rng(0)
    detail = cv2.GaussianBlur(random.standard_normal((90, 120)), (0, 0), 1)
    reference = np.exp(0.5 * detail / detail.std() - 2)
    ramp = np.linspace(-3, 3, 120)[None, :] + np.zeros((90, 1))
    sharp = image_errors([np.log(reference) + ramp], [reference])
    empty = image_errors([ramp], [reference])
    assert (
        sharp["log_correlation"] < 0.5 and sharp["log_correlation_16px"] > 0.8 and sharp["log_correlation_4px"] > 0.98
    )
    assert abs(empty["log_correlation_4px"]) < 0.2


def test_one_fit_for_the_whole_set():
    references = [picture(0), picture(1)]
    renders = [np.log(references[0]), np.log(references[1]) + 2]
    assert image_errors(renders, references)["psnr"] < 30


def test_a_constant_grey_render_scores_badly_and_finitely():
    errors = image_errors([np.full((24, 32), 0.3)], [picture()])
    assert 5 < errors["psnr"] < 20 and errors["ssim"] < 0.5
    assert np.isfinite(fit_brightness([np.zeros((24, 32))], [np.zeros((24, 32))])[0][0]).all()
    assert errors["log_correlation"] == errors["log_correlation_4px"] == 0 and not errors["inverted"]


def test_saturated_pixels_leave_the_fit_and_do_not_count_where_the_render_is_brighter():
    truth = 3 * picture()
    reference = np.minimum(truth, 1.0)
    assert (reference == 1).mean() > 0.2
    assert image_errors([0.5 * np.log(truth) + 1], [reference])["psnr"] > 60


def test_depth_error_is_relative_and_over_known_pixels():
    truth = np.array([[1.0, 2.0], [np.nan, 0.0]])
    assert depth_error(np.array([[1.1, 1.6], [5.0, 5.0]]), truth) == pytest.approx((0.1 + 0.2) / 2)
    assert depth_error(truth, np.full((2, 2), np.inf)) is None


def test_depth_of_a_wrong_shape_or_kind_is_named(tmp_path: Path):
    path = tmp_path / "depth.npy"
    assert read_depth(frame(tmp_path / "a.png")) is None
    with_depth = replace(frame(tmp_path / "a.png"), depth=path)
    for content in (np.zeros((3, 4)), np.zeros((24, 32), int)):
        np.save(path, content)
        with pytest.raises(EvaluationError, match=r"depth.npy: .*expected floats of \(24, 32\)"):
            read_depth(with_depth)
    path.write_text("nothing")
    with pytest.raises(EvaluationError, match="depth.npy: cannot be read"):
        read_depth(with_depth)
    np.save(path, np.full((24, 32), 2, np.float32))
    depth = read_depth(with_depth)
    assert depth is not None and depth.dtype == np.float64 and (depth == 2).all()


def test_lpips_says_why_it_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    assert "lpips" not in image_errors([np.log(picture())], [picture()])
    assert "alexnet" in str(lpips_missing()) and str(tmp_path) in str(lpips_missing())


@pytest.mark.slow
def test_lpips_is_computed_where_the_weights_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    torch.manual_seed(0)
    weights = tmp_path / "hub" / "checkpoints" / "alexnet-owt-7be5be79.pth"
    weights.parent.mkdir(parents=True)
    torch.save(torchvision.models.alexnet().state_dict(), weights)
    large = np.kron(picture(), np.ones((4, 4)))
    same, other = (image_errors([np.log(render)], [large])["lpips"] for render in (large, large[:, ::-1]))
    assert same < 1e-3 < other


def test_frames_smaller_than_a_window_have_no_ssim():
    small = image_errors([np.log(picture()[:5, :5])], [picture()[:5, :5]])
    assert "psnr" in small and "ssim" not in small and small["log_correlation"] == pytest.approx(1)
