"""Validation frames as linear radiance, and how well renders match them."""

import os
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float

from ebarf_ns.errors import EvaluationError
from ebarf_ns.scene import Frame

_DARKEST = 1e-3


def read_frame(frame: Frame) -> Float[np.ndarray, "height width"]:
    """Linear radiance of a frame, 0 to 1 for integer formats; raises :class:`EvaluationError`."""
    pixels = _read_pixels(frame.path)
    if pixels.shape != (frame.camera.height, frame.camera.width):
        raise EvaluationError(
            f"{frame.path}: {pixels.shape[1]}x{pixels.shape[0]} pixels, expected the camera's "
            f"{frame.camera.width}x{frame.camera.height}"
        )
    if frame.intensity == "log":
        return np.exp(pixels)
    if frame.intensity == "srgb":
        return np.where(pixels <= 0.04045, pixels / 12.92, ((np.maximum(pixels, 0.04045) + 0.055) / 1.055) ** 2.4)
    return pixels


def _read_pixels(path: Path) -> Float[np.ndarray, "height width"]:
    # OpenCV reads EXR only when asked to; it looks here at its first image.
    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")
    try:
        pixels = np.load(path, allow_pickle=False) if path.suffix == ".npy" else cv2.imread(str(path), -1)
    except (cv2.error, ValueError, OSError, EOFError) as error:
        raise EvaluationError(f"{path}: cannot be read as an image ({str(error).splitlines()[0]:.80})") from None
    if pixels is None or pixels.ndim not in (2, 3):
        raise EvaluationError(f"{path}: cannot be read as an image")
    white = {"uint8": 255.0, "uint16": 65535.0}
    scale = white.get(pixels.dtype.name, 1.0)
    grey = pixels[..., :3].mean(axis=-1) if pixels.ndim == 3 else pixels
    return grey.astype(np.float64) / scale


def fit_brightness(
    rendered_log: list[Float[np.ndarray, "height width"]], reference: list[Float[np.ndarray, "height width"]]
) -> list[Float[np.ndarray, "height width"]]:
    """Renders as linear radiance after one affine fit in log brightness over the whole set.

    Events leave gain and offset of log brightness open: log reference ~ a * rendered_log + b, least squares over the
    pixels where the reference is not black.
    """
    x = np.concatenate([image.ravel() for image in rendered_log])
    y = np.concatenate([image.ravel() for image in reference])
    bright = y > _DARKEST
    if not bright.any() or np.ptp(x[bright]) == 0:
        gain, offset = 0.0, float(np.log(np.maximum(y, _DARKEST)).mean())
    else:
        gain, offset = np.polyfit(x[bright], np.log(y[bright]), 1)
    return [np.exp(gain * image + offset) for image in rendered_log]


def image_errors(
    rendered_log: list[Float[np.ndarray, "height width"]], reference: list[Float[np.ndarray, "height width"]]
) -> dict[str, float]:
    """Mean PSNR and SSIM of log-brightness renders against linear references, on [0, 1] after the joint fit."""
    from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure

    white = max(float(image.max()) for image in reference)
    psnr, ssim = [], []
    for fitted, truth in zip(fit_brightness(rendered_log, reference), reference, strict=True):
        ours, theirs = (torch.from_numpy(np.clip(image / white, 0, 1))[None, None].float() for image in (fitted, truth))
        psnr.append(float(peak_signal_noise_ratio(ours, theirs, data_range=1.0)))
        similarity = structural_similarity_index_measure(ours, theirs, data_range=1.0)
        assert isinstance(similarity, torch.Tensor)
        ssim.append(float(similarity))
    return {"psnr": float(np.mean(psnr)), "ssim": float(np.mean(ssim))}
