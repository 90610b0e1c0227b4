"""The event sensor: log brightness in, threshold crossings out (Eq. 1), with configurable imperfections.

The imperfections are those of v2e (Hu, Liu, Delbruck 2021). Deblur e-NeRF (Low & Lee 2024) models the
intensity-dependent bandwidth in more detail.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from ebarf_ns.compiled import njit

_NARROWEST, _WIDEST = 0.1, 3.0
"""Bounds of the intensity-dependent bandwidth, relative to ``cutoff_hz``."""


@dataclass(frozen=True)
class SensorModel:
    """Pixel parameters; the defaults are an ideal sensor."""

    threshold_on: float = 0.25
    """Contrast threshold of ON events, in log brightness."""
    threshold_off: float = 0.25
    threshold_mismatch: float = 0.0
    """Standard deviation of the pixels' thresholds relative to their mean, independent per polarity."""
    threshold_drift: float = 0.0
    """Growth of the thresholds from start to end, relative to their mean."""
    refractory_us: float = 0.0
    """Refractory period after an event; at its end, the current brightness becomes the reference."""
    cutoff_hz: float = 0.0
    """Bandwidth of the pixels, a first-order low-pass filter on log brightness; 0: unlimited."""
    cutoff_reference: float = 0.0
    """Linear intensity at which the bandwidth is ``cutoff_hz``; the bandwidth is then
    cutoff_hz * clip(intensity / cutoff_reference, 0.1, 3); 0: independent of intensity."""
    shot_noise_hz: float = 0.0
    """Rate of noise events of random polarity per pixel."""
    leak_hz: float = 0.0
    """Rate of positive leak events per pixel at constant brightness."""
    hot_pixels: int = 0
    hot_pixel_hz: float = 2000.0
    """Rate of noise events of random polarity per hot pixel."""
    jitter_us: float = 0.0
    """Standard deviation of the timestamps."""

    @property
    def widest_hz(self) -> float:
        """Bandwidth of the fastest pixels; 0: unlimited."""
        return self.cutoff_hz * (_WIDEST if self.cutoff_reference else 1)


class Crossings(NamedTuple):
    """Events with the samples between which each crossed its level; noise events have NaN samples."""

    pixel: Int64[np.ndarray, "events"]
    t_us: Float[np.ndarray, "events"]
    polarity: Int64[np.ndarray, "events"]
    level: Float[np.ndarray, "events"]
    before_us: Float[np.ndarray, "events"]
    before: Float[np.ndarray, "events"]
    after_us: Float[np.ndarray, "events"]
    after: Float[np.ndarray, "events"]


class EventSensor:
    """Compares each pixel's log brightness with ``level``, its value at the last event.

    Between two samples of a pixel, log brightness is assumed linear in time, and the bandwidth is that at the midpoint.
    """

    def __init__(self, model: SensorModel, end_us: float, seed: int, log_brightness: Float[np.ndarray, "pixels"]):
        """Start at time 0 with the log brightness of all pixels."""
        self.model, self.end_us = model, end_us
        self._random = np.random.default_rng([seed, 41])
        self._leak_per_us = model.threshold_on * model.leak_hz * 1e-6
        count = len(log_brightness)
        mismatch = np.maximum(1 + model.threshold_mismatch * self._random.standard_normal((2, count)), 0.1)
        self.threshold_on, self.threshold_off = model.threshold_on * mismatch[0], model.threshold_off * mismatch[1]
        self._noise_hz = np.full(count, model.shot_noise_hz)
        self._noise_hz[self._random.permutation(count)[: model.hot_pixels]] += model.hot_pixel_hz
        # The last sample of each pixel: time, input and low-pass output.
        self._t_us, self._input, self._output = np.zeros(count), log_brightness.copy(), log_brightness.copy()
        # As if switched on long ago: levels are spread within a threshold of the brightness, equally for all seeds.
        phase = np.random.default_rng(0).uniform(-1, 1, count)
        self.level = log_brightness + phase * self._growth(0) * np.where(
            phase > 0, self.threshold_off, self.threshold_on
        )
        self._blind_until_us = np.full(count, -np.inf)

    def leak(self, t_us: Float[np.ndarray, "samples"]) -> Float[np.ndarray, "samples"]:
        """Accumulated leak at a time, in log brightness."""
        return self._leak_per_us * t_us

    def see(
        self,
        pixel: Int64[np.ndarray, "samples"],
        t_us: Float[np.ndarray, "samples"],
        log_brightness: Float[np.ndarray, "samples"],
    ) -> Crossings:
        """Process new samples, sorted by pixel, then time; returns their events in the same order."""
        until_us = float(t_us.max())
        noise_pixel, noise_us, noise_polarity = self._noise(float(self._t_us.min()), until_us)
        growth = self._growth(until_us)
        columns = _observe(
            pixel, t_us, log_brightness + self.leak(t_us),
            self._t_us, self._input, self._output, self.level, self._blind_until_us,
            self.threshold_on * growth, self.threshold_off * growth,
            2e-6 * np.pi * self.model.cutoff_hz, float(self.model.cutoff_reference), self._leak_per_us,
            float(self.model.refractory_us),
            noise_pixel, noise_us, noise_polarity,
        )  # fmt: skip
        return Crossings(*columns)

    def _growth(self, t_us: float) -> float:
        return 1 + self.model.threshold_drift * (t_us / self.end_us - 0.5)

    def jitter(self, t_us: Float[np.ndarray, "events"]) -> Int64[np.ndarray, "events"]:
        """Integer timestamps with jitter."""
        if self.model.jitter_us:
            t_us = t_us + self.model.jitter_us * self._random.standard_normal(len(t_us))
        return np.clip(np.rint(t_us), 0, self.end_us).astype(np.int64)

    def _noise(self, since_us: float, until_us: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Noise events, sorted by pixel, then time."""
        counts = self._random.poisson(self._noise_hz * (until_us - since_us) * 1e-6)
        pixel = np.repeat(np.arange(len(counts)), counts)
        t_us = self._random.uniform(since_us, until_us, len(pixel))
        return pixel, t_us[np.lexsort((t_us, pixel))], self._random.choice(np.array([-1, 1]), len(pixel))


@njit(cache=True)
def _observe(
    pixels, times_us, inputs, last_us, last_input, last_output, level, blind_until_us, threshold_on, threshold_off,
    cutoff_rad_us, cutoff_reference, leak_per_us, refractory_us, noise_pixel, noise_us, noise_polarity,
):  # fmt: skip
    """Process the samples of each pixel; the per-pixel state arrays are updated in place."""
    capacity = 1024
    whole, real = np.empty((2, capacity), np.int64), np.empty((6, capacity))
    events = noise = 0
    for i in range(len(pixels)):
        p = pixels[i]
        before_us, after_us = last_us[p], times_us[i]
        if after_us <= before_us:
            continue
        before, after = last_output[p], inputs[i]
        if cutoff_rad_us > 0:
            rad_us = cutoff_rad_us
            if cutoff_reference > 0:
                # Remove the leak from the inputs to get the light.
                light = np.exp((last_input[p] + inputs[i] - leak_per_us * (before_us + after_us)) / 2)
                rad_us *= min(max(light / cutoff_reference, _NARROWEST), _WIDEST)
            # Exact for an input that is linear between samples.
            lag = (inputs[i] - last_input[p]) / (after_us - before_us) / rad_us
            fade = np.exp(-rad_us * (after_us - before_us))
            after = inputs[i] - lag + (before - last_input[p] + lag) * fade
        slope = (after - before) / (after_us - before_us)
        while noise < len(noise_pixel) and noise_pixel[noise] < p:
            noise += 1
        now_us = before_us
        while True:
            if blind_until_us[p] > now_us:
                if blind_until_us[p] >= after_us:
                    break
                now_us = blind_until_us[p]
                level[p] = before + slope * (now_us - before_us)
            polarity, target, at_us = 0, level[p], np.inf
            if after - level[p] >= threshold_on[p]:
                polarity, target = 1, level[p] + threshold_on[p]
            elif level[p] - after >= threshold_off[p]:
                polarity, target = -1, level[p] - threshold_off[p]
            if polarity:
                # With shrinking thresholds, the level may already be crossed when it is set.
                at_us = max(now_us, min(after_us, before_us + (target - before) / slope)) if slope else now_us
            while noise < len(noise_pixel) and noise_pixel[noise] == p and noise_us[noise] <= now_us:
                noise += 1
            by_chance = noise < len(noise_pixel) and noise_pixel[noise] == p and noise_us[noise] < min(at_us, after_us)
            if by_chance:
                at_us, polarity = noise_us[noise], noise_polarity[noise]
                target = before + slope * (at_us - before_us)
            if not polarity:
                break
            if events == capacity:
                whole, real = np.concatenate((whole, whole), 1), np.concatenate((real, real), 1)
                capacity *= 2
            whole[0, events], whole[1, events] = p, polarity
            real[:, events] = at_us, target, before_us, before, after_us, after
            if by_chance:
                real[2:, events] = np.nan
            events += 1
            level[p] = target
            now_us = at_us
            if refractory_us > 0:
                blind_until_us[p] = at_us + refractory_us
        last_us[p], last_input[p], last_output[p] = after_us, inputs[i], after
    whole, real = whole[:, :events], real[:, :events]
    return whole[0], real[0], whole[1], real[1], real[2], real[3], real[4], real[5]
