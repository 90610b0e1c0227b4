"""Validation frames as linear radiance and depth, and errors of renders against them."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float

from ebarf_ns.errors import EvaluationError
from ebarf_ns.files import read_picture
from ebarf_ns.scene import Frame

_DARKEST = 1e-3
_BLACK = 5 / 255
_HIGH_PASS_PX = (16, 4)
_FLAT = 1e-12
_SMALLEST_FOR_SSIM, _SMALLEST_FOR_LPIPS = 11, 64
_FRAMES_TOO_SMALL = f"LPIPS left out: frames are smaller than {_SMALLEST_FOR_LPIPS} pixels"
_WEIGHTS_CAME_LATER = "AlexNet's weights came after the evaluation: ns-eval has it now"


def read_frame(frame: Frame) -> Float[np.ndarray, "height width"]:
    """Linear radiance of a frame, 0 to 1 for integer formats; raises :class:`EvaluationError`."""
    pixels = read_pixels(frame.path)
    if pixels.shape != (frame.camera.height, frame.camera.width):
        raise EvaluationError(
            f"{frame.path}: {pixels.shape[1]}x{pixels.shape[0]} pixels, expected the camera's "
            f"{frame.camera.width}x{frame.camera.height}"
        )
    if frame.intensity == "log":
        with np.errstate(over="ignore"):
            pixels = np.exp(pixels)
    elif frame.intensity == "srgb":
        pixels = np.where(pixels <= 0.04045, pixels / 12.92, ((np.maximum(pixels, 0.04045) + 0.055) / 1.055) ** 2.4)
    if not np.isfinite(pixels).all():
        raise EvaluationError(
            f"{frame.path}: {np.count_nonzero(~np.isfinite(pixels))} pixels are not finite as {frame.intensity} "
            "intensity, expected numbers"
        )
    return pixels


def read_pixels(path: Path) -> Float[np.ndarray, "height width"]:
    """Grey values as stored, 0 to 1 for integer formats; raises :class:`EvaluationError`."""
    # OpenCV reads EXR only if this is set before its first image.
    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")
    try:
        pixels = np.load(path, allow_pickle=False) if path.suffix == ".npy" else read_picture(path)
    except (cv2.error, ValueError, OSError, EOFError) as error:
        raise EvaluationError(f"{path}: cannot be read as an image ({str(error).splitlines()[0]:.80})") from None
    if pixels is None or pixels.ndim not in (2, 3):
        raise EvaluationError(f"{path}: cannot be read as an image")
    white = {"uint8": 255.0, "uint16": 65535.0}
    scale = white.get(pixels.dtype.name, 1.0)
    grey = pixels[..., :3].mean(axis=-1) if pixels.ndim == 3 else pixels
    return grey.astype(np.float64) / scale


def read_depth(frame: Frame) -> Float[np.ndarray, "height width"] | None:
    """Distances along the pixels' rays in the reference's unit, None if unknown; raises :class:`EvaluationError`."""
    if frame.depth is None:
        return None
    try:
        depth = np.load(frame.depth, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise EvaluationError(f"{frame.depth}: cannot be read as an array ({str(error).splitlines()[0]:.80})") from None
    expected = (frame.camera.height, frame.camera.width)
    if depth.shape != expected or depth.dtype.kind != "f":
        raise EvaluationError(f"{frame.depth}: {depth.dtype} of shape {depth.shape}, expected floats of {expected}")
    return depth.astype(np.float64)


def depth_error(
    rendered: Float[np.ndarray, "height width"], reference: Float[np.ndarray, "height width"]
) -> float | None:
    """Mean of |rendered - true| / true over pixels with known true depth (AbsRel)."""
    known = np.isfinite(reference) & (reference > 0)
    return float(np.mean(np.abs(rendered - reference)[known] / reference[known])) if known.any() else None


def fit_brightness(
    rendered_log: list[Float[np.ndarray, "height width"]], reference: list[Float[np.ndarray, "height width"]]
) -> tuple[list[Float[np.ndarray, "height width"]], bool]:
    """Renders as linear radiance after one affine fit in log brightness over the whole set, and whether it is inverted.

    Events do not determine gain and offset of log brightness: log reference ~ a * rendered_log + b is fitted by least
    squares over pixels where the reference is neither black nor saturated (1). The gain is positive: if the renders are
    bright where the references are dark, they are inverted, and keep their sign but get the references' mean and
    contrast.
    """
    x = np.concatenate([image.ravel() for image in rendered_log])
    y = np.concatenate([image.ravel() for image in reference])
    bright = (y > _DARKEST) & (y != 1)
    if not bright.any() or np.ptp(x[bright]) == 0:
        grey = np.exp(np.log(np.maximum(y, _DARKEST)).mean())
        return [np.full_like(image, grey) for image in rendered_log], False
    x, y = x[bright], np.log(y[bright])
    gain, offset = np.polyfit(x, y, 1)
    inverted = bool(gain < 0)
    if inverted:
        gain = y.std() / x.std()
        offset = y.mean() - gain * x.mean()
    return [np.exp(gain * image + offset) for image in rendered_log], inverted


def log_correlation(
    fitted: Float[np.ndarray, "height width"], reference: Float[np.ndarray, "height width"]
) -> dict[str, float]:
    """Correlation of the log brightness of a fitted render and a linear reference, unfiltered and high-passed.

    The high-pass subtracts a Gaussian blur with a standard deviation of 16 or 4 pixels, so that shading across the
    image, which events hardly determine, counts little or not at all. Values below 5/255 of the reference's format are
    clipped to it. 0 if either image is flat.
    """
    ours, theirs = (np.log(np.maximum(image, _BLACK)) for image in (fitted, reference))
    found = {"log_correlation": _correlation(ours, theirs)}
    for width_px in _HIGH_PASS_PX:
        passed = (image - cv2.GaussianBlur(image, (0, 0), width_px) for image in (ours, theirs))
        found[f"log_correlation_{width_px}px"] = _correlation(*passed)
    return found


def _correlation(ours: Float[np.ndarray, "height width"], theirs: Float[np.ndarray, "height width"]) -> float:
    ours, theirs = ours - ours.mean(), theirs - theirs.mean()
    scale = np.linalg.norm(ours) * np.linalg.norm(theirs)
    return float((ours * theirs).sum() / scale) if scale > _FLAT * ours.size else 0.0


def image_errors(
    rendered_log: list[Float[np.ndarray, "height width"]], reference: list[Float[np.ndarray, "height width"]]
) -> dict[str, float]:
    """Mean PSNR, SSIM, LPIPS and log correlation of log-brightness renders against linear references, after the fit.

    The first three are computed on [0, 1]. LPIPS (Zhang et al. 2018, AlexNet) is omitted if :func:`lpips_missing` gives
    a reason, and SSIM if a frame is smaller than its window. ``inverted`` is 1 for inverted renders, else 0.
    """
    from torchmetrics.functional.image import (
        learned_perceptual_image_patch_similarity,
        peak_signal_noise_ratio,
        structural_similarity_index_measure,
    )

    white = max(float(image.max()) for image in reference)
    errors: dict[str, list[float]] = {}
    with_lpips = lpips_missing(reference) is None
    all_fitted, inverted = fit_brightness(rendered_log, reference)
    for fitted, truth in zip(all_fitted, reference, strict=True):
        ours, theirs = (torch.from_numpy(np.clip(image / white, 0, 1))[None, None].float() for image in (fitted, truth))
        frame = {"psnr": float(peak_signal_noise_ratio(ours, theirs, data_range=1.0))}
        if min(truth.shape) >= _SMALLEST_FOR_SSIM:
            similarity = structural_similarity_index_measure(ours, theirs, data_range=1.0)
            assert isinstance(similarity, torch.Tensor)
            frame["ssim"] = float(similarity)
        if with_lpips:
            ours, theirs = (image.expand(-1, 3, -1, -1) for image in (ours, theirs))
            distance = learned_perceptual_image_patch_similarity(ours, theirs, net_type="alex", normalize=True)
            frame["lpips"] = float(distance)
        for name, value in {**frame, **log_correlation(fitted, truth)}.items():
            errors.setdefault(name, []).append(value)
    return {name: float(np.mean(values)) for name, values in errors.items()} | {"inverted": float(inverted)}


def lpips_note(evaluation: dict[str, Any]) -> str | None:
    """A sentence on why a recorded evaluation has no LPIPS; None if it has, or has no frames."""
    if "psnr" not in evaluation or evaluation.get("lpips") is not None:
        return None
    return lpips_missing() or f"{_FRAMES_TOO_SMALL}, or {_WEIGHTS_CAME_LATER}"


def lpips_missing(reference: Sequence[Float[np.ndarray, "height width"]] = ()) -> str | None:
    """A sentence on why LPIPS is unavailable; None if it is available. Nothing is downloaded."""
    weights = Path(torch.hub.get_dir()) / "checkpoints" / "alexnet-owt-7be5be79.pth"
    if not weights.is_file():
        fetch = "import torchvision; torchvision.models.alexnet(weights='DEFAULT')"
        return f'LPIPS left out: AlexNet\'s weights are not at {weights}; python -c "{fetch}" fetches them'
    if any(min(image.shape) < _SMALLEST_FOR_LPIPS for image in reference):
        return _FRAMES_TOO_SMALL
    return None
