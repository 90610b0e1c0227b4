"""The viewer in a real browser: a finished run and a running training, what is seen, and what is asked of the network.

Needs playwright and chromium, which the project does not install: ``pip install playwright`` and the system's chromium.
With EBARF_SCREENSHOTS, the screenshots are kept in that folder.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.simulation.simulate import Simulation, simulate
from tests.conftest import TINY_TRAINING, free_port, wait_for_page

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")]

PATIENCE_S = 240
NO_ALIGNMENT = "--pipeline.model.camera-optimizer.align-steps=0"
BLUE, ORANGE, GREEN = (31, 119, 180), (255, 127, 14), (44, 160, 44)
# viser's own page asks for a script that counts visits, and draws a gizmo before it has a size.
VISERS_REQUEST = re.compile(r"https://www\.googletagmanager\.com/.*")
VISERS_ERRORS = ("net::ERR_", "THREE.BufferGeometry.computeBoundingSphere")
SOFTWARE_GL = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


class Visit:
    """A page that has been opened, what it asked for, and what it complained of."""

    def __init__(self, page: Any):
        self.page, self.outside, self.errors = page, [], []
        page.on("request", self._note_request)
        page.on("console", lambda said: self._note_error(said.text) if said.type == "error" else None)
        page.on("pageerror", lambda error: self._note_error(str(error)))

    def _note_request(self, request: Any) -> None:
        if not request.url.startswith(("http://127.0.0.1", "data:", "blob:")):
            self.outside.append(request.url)

    def _note_error(self, text: str) -> None:
        if not any(known in text for known in VISERS_ERRORS):
            self.errors.append(text)

    def picture(self, name: str) -> np.ndarray:
        """What is seen of the scene, without the panel; RGB."""
        png = self.page.screenshot()
        if folder := os.environ.get("EBARF_SCREENSHOTS"):
            (Path(folder) / f"{name}.png").write_bytes(png)
        seen = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        assert seen is not None
        return seen[:, :1050, ::-1].astype(int)

    def pictures(self) -> list[str]:
        """The addresses of the panel's pictures."""
        return [one.get_attribute("src") for one in self.page.locator("img[src^='data:image/png']").all()]

    def tick(self, label: str) -> None:
        """Change a box."""
        self.page.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input][1]//input").click(force=True)


@contextmanager
def opened(*command: object) -> Iterator[Visit]:
    """The page of a viewer, from its first moment on."""
    port = free_port()
    script, *arguments = command
    process = subprocess.Popen(
        [Path(sys.executable).parent / str(script), *map(str, arguments), "--viewer.websocket-port", str(port)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        wait_for_page(f"http://127.0.0.1:{port}", process, PATIENCE_S)
        with visited(port, CHROMIUM) as visit:
            # A page opened while nerfstudio was still building its own has asked for its logo.
            visit.outside.clear()
            visit.page.reload()
            visit.page.get_by_text("Event camera").wait_for()
            wait_until(lambda: len(visit.pictures()) == 2)
            yield visit
    finally:
        process.kill()
        process.wait()


@contextmanager
def visited(port: int, browser_path: object) -> Iterator[Visit]:
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=browser_path, args=SOFTWARE_GL)
        visit = Visit(browser.new_page(viewport={"width": 1400, "height": 900}))
        visit.page.set_default_timeout(1000 * PATIENCE_S)
        visit.page.goto(f"http://127.0.0.1:{port}")
        visit.page.get_by_text("Event camera").wait_for()
        yield visit
        browser.close()


def wait_until(true: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end
        time.sleep(0.5)


def pixels_of(picture: np.ndarray, color: tuple[int, int, int]) -> int:
    return int((np.abs(picture - color).max(axis=-1) < 40).sum())


def test_a_finished_run(trained_run: Path, tmp_path: Path):
    with opened("ns-viewer", "--load-config", trained_run / "config.yml") as visit:
        wait_until(lambda: visit.picture("finished").std() > 20)
        visit.page.get_by_text("See all keyframes").click()
        wait_until(lambda: all(pixels_of(visit.picture("all"), color) > 30 for color in (BLUE, ORANGE, GREEN)))

        for label, color in (("initial, blue", BLUE), ("reference, green", GREEN)):
            before = pixels_of(visit.picture("before"), color)
            visit.tick(label)
            wait_until(lambda before=before, color=color: pixels_of(visit.picture("hidden"), color) < before / 3)
            visit.tick(label)

        visit.page.get_by_text("Fly to keyframe").click()
        before, place = visit.pictures()[0], visit.picture("middle")
        slider = visit.page.get_by_text("time [s]").locator("xpath=ancestor::*[.//input[@type='text']][1]")
        slider.locator("input[type='text']").fill("0.05")
        slider.locator("input[type='text']").press("Enter")
        wait_until(lambda: visit.pictures()[0] != before)
        wait_until(lambda: np.abs(visit.picture("moved") - place).mean() > 5)

        with visit.page.expect_download() as download:
            visit.page.get_by_text("Save refined trajectory").click()
        download.value.save_as(tmp_path / "saved.txt")
        saved, on_disk = read_tum(tmp_path / "saved.txt"), read_tum(trained_run / "trajectory_refined.txt")
        assert all(np.array_equal(*pair) for pair in zip(saved.poses, on_disk.poses, strict=True))

        assert not visit.errors
        assert all(VISERS_REQUEST.fullmatch(url) for url in visit.outside)


def test_a_running_training(tiny_scene: Path, tmp_path: Path):
    steps = [flag for flag in TINY_TRAINING if not flag.startswith("--max-num")]
    command = ["ns-train", "ebarf", "--data", tiny_scene, "--output-dir", tmp_path, "--timestamp=run", "--vis=viewer"]
    with opened(*command, *steps, "--max-num-iterations=100000", "--evaluations=0", NO_ALIGNMENT) as visit:
        opened_s = time.monotonic()
        wait_until(lambda: visit.picture("training").std() > 20)
        assert time.monotonic() - opened_s < 60
        before = visit.pictures()
        # Both the moment and the curves follow.
        wait_until(lambda: all(now != then for now, then in zip(visit.pictures(), before, strict=True)))
        visit.page.get_by_text("Freeze poses").click()
        visit.page.get_by_text("Release poses").wait_for()
        visit.picture("training_later")
        assert not visit.errors
        assert all(VISERS_REQUEST.fullmatch(url) for url in visit.outside)


TIMED = """
import sys, time
from nerfstudio.scripts.train import entrypoint
from ebarf_ns.nerf.averaging import Averaging

follow = Averaging.follow
def timed(self, steps_done):
    follow(self, steps_done)
    print("step", steps_done, time.monotonic(), file=sys.stderr, flush=True)
Averaging.follow = timed
entrypoint()
"""
PHASE_S, PHASES = 20, 3


class Timed:
    """A training of the demo scene whose steps are timed."""

    def __init__(self, scene: Path, folder: Path, *flags: object):
        words = ("ebarf", "--data", scene, "--output-dir", folder, "--max-num-iterations=100000", "--evaluations=0")
        # Threads that wait must not take the browser's share of the processor.
        self.process = subprocess.Popen(
            [sys.executable, "-c", TIMED, *map(str, words), NO_ALIGNMENT, *map(str, flags)],
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
            env={**os.environ, "OMP_WAIT_POLICY": "passive"},
        )  # fmt: skip
        self.times_s: list[float] = []
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self) -> None:
        assert self.process.stderr
        for line in self.process.stderr:
            if line.startswith("step "):
                self.times_s.append(float(line.split()[2]))

    def rate(self) -> float:
        """Steps per second over the next seconds."""
        start_s = time.monotonic()
        time.sleep(PHASE_S)
        return sum(start_s <= one < start_s + PHASE_S for one in self.times_s) / PHASE_S

    def __enter__(self) -> "Timed":
        wait_until(lambda: len(self.times_s) > 0)
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()


def test_training_is_hardly_slower_with_a_viewer_and_shows_the_scene_within_20_s(tmp_path: Path):
    """A share of 5 % of the steps without a client and of 25 % with one.

    Without a graphics card, the browser takes one of two cores for the page. It is stopped while steps are counted, as
    if it ran on another computer.
    """
    scene = simulate(Simulation(), tmp_path / "scene").folder
    pid_file, browser = tmp_path / "pid", tmp_path / "browser"
    browser.write_text(f'#!/bin/sh\necho $$ > {pid_file}\nexec {CHROMIUM} "$@"\n')
    browser.chmod(0o755)
    alone, unseen, seen = [], [], []
    for k in range(PHASES):
        with Timed(scene, tmp_path / f"alone{k}", "--vis=tensorboard") as training:
            training.rate()
            alone.append(training.rate())
        port = free_port()
        watched = ("--vis=viewer", "--viewer.websocket-port", port)
        with Timed(scene, tmp_path / f"watched{k}", *watched) as training, visited(port, browser) as visit:
            wait_until(lambda: time.monotonic() > training.times_s[0] + 20)
            assert visit.picture(f"after_20_s_{k}").std() > 20
            processes = int(pid_file.read_text())
            os.killpg(processes, signal.SIGSTOP)
            seen.append(training.rate())
            os.killpg(processes, signal.SIGCONT)
        with Timed(scene, tmp_path / f"unseen{k}", "--vis=viewer", "--viewer.websocket-port", free_port()) as training:
            training.rate()
            unseen.append(training.rate())
    ratios = [[one / without for one, without in zip(rates, alone, strict=True)] for rates in (unseen, seen)]
    sys.stderr.write(f"\n  steps/s alone {alone}, with a viewer {unseen}, with a page open {seen}\n")
    assert np.median(ratios[0]) >= 0.95 and np.median(ratios[1]) >= 0.75
