"""What nerfstudio's viewer shows besides renders: trajectories, keyframes, the events of a moment, and progress.

nerfstudio finds the panel as an attribute of the pipeline and hands it its viewer, in ns-train and ns-viewer alike.
Nothing is read, drawn or rendered before somebody looks.
"""

from __future__ import annotations

import base64
import json
import math
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.viewer.viewer_elements import ViewerControl

from ebarf_ns.geometry.so3 import quat_wxyz_conjugate, rotate
from ebarf_ns.geometry.trajectory import Poses
from ebarf_ns.nerf.pipeline import EbarfPipeline
from ebarf_ns.nerf.viewer_pictures import curves, half_window_us, recorded, rendered, side_by_side
from ebarf_ns.nerf.viewer_scene import SCALE, DrawnScene, vertical_fov_rad

if TYPE_CHECKING:
    import viser
    from nerfstudio.viewer.viewer import Viewer
    from torch import Tensor


# A chore that took a second comes again after so many.
_REST, _LEAST_REST_S = 50.0, 1.0
_MOST_RECORDS = 400
_CPU_MAX_RES = 256


@dataclass
class _Chore:
    """Something to be kept up to date while training goes on, at a small share of the time."""

    do: Callable[[], None]
    due_s: float = 0.0

    def run(self) -> None:
        started = time.monotonic()
        self.do()
        ended = time.monotonic()
        self.due_s = ended + max(_LEAST_REST_S, _REST * (ended - started))


class ViewerPanel(ViewerControl):
    """The panel "Event camera" of nerfstudio's viewer."""

    def __init__(self, pipeline: EbarfPipeline):
        # nerfstudio looks through what is public.
        self._pipeline = pipeline
        self._viewer: Viewer | None = None
        self._records: list[dict[str, Any]] = []
        self._losses: list[tuple[int, Tensor]] = []
        self._every = 1
        self._step = 0
        self._drawing = threading.Lock()
        self._looked_at = False
        self._wanted = self._shown = 0

    def _setup(self, viewer: Viewer) -> None:
        """Called by nerfstudio when its viewer is built, but for the scene."""
        super()._setup(viewer)
        # Their buttons are there before the scene is.
        viewer.camera_handles = {}
        config = viewer.config
        self._drawn = DrawnScene(
            self._pipeline, self.viser_server, config.max_num_display_images, config.camera_frustum_scale
        )
        # nerfstudio's own frustums have the horizontal field of view for the vertical one, and stay where they began.
        viewer.config = replace(config, max_num_display_images=0)
        for button in (viewer.hide_images, viewer.show_images, *([] if viewer.trainer else [viewer.pause_train])):
            button.visible = False
        # Without its logo, which is fetched from the network.
        self.viser_server.gui.configure_theme(control_layout="collapsible", dark_mode=True, brand_color=(255, 211, 105))
        chores = (self._drawn.draw_lines, self._draw_curves, self._pipeline.fit_display_range, self._show_moment_again)
        self._chores = [_Chore(do) for do in chores]
        # Fog before the camera would hide the trajectories, and a coarse picture's depth cuts them to pieces.
        viewer.control_panel._layer_depth.value = False
        if viewer.trainer and self._pipeline.device.type == "cpu":
            # A picture of 512 pixels takes seconds there, and training gets nine tenths of the time.
            viewer.control_panel._max_res.value = _CPU_MAX_RES
        self._build()
        self._viewer = viewer
        self.viser_server.on_client_connect(self._welcome)

    def _build(self) -> None:
        gui, scene = self.viser_server.gui, self.viser_server.scene
        model = self._pipeline.model
        times = model.camera_optimizer.keyframe_t_us
        self._given = model.camera_optimizer.given.cpu()
        shown = {
            "initial": "initial, blue",
            "refined": "refined, orange",
            "reference": "reference, green",
            "keyframes": "keyframes",
        }
        if self._pipeline.scene.groundtruth is None:
            del shown["reference"]
        with gui.add_folder("Event camera", order=-1):
            length_s = max(round(1e-6 * float(times[-1] - times[0]), 3), 0.001)
            self._time = gui.add_slider("time [s]", 0.0, length_s, 0.001, round(length_s / 2, 3))
            self._picture = gui.add_markdown("", image_root=Path())
            self._follow = gui.add_checkbox("look from there", True)
            last = len(self._given) - 1
            self._keyframe = gui.add_number("keyframe", last // 2, min=0, max=last, step=1)
            gui.add_button("Fly to keyframe").on_click(self._fly_to_keyframe)
            gui.add_button("See all keyframes").on_click(lambda event: self._step_back(event.client))
            gui.add_button("Save refined trajectory").on_click(self._save)
            if model.camera_optimizer.config.mode == "refine" and self.viewer.trainer:
                self._freeze = gui.add_button("Freeze poses")
                self._release = gui.add_button("Release poses", visible=False)
                self._freeze.on_click(lambda _: self._let_poses_move(False))
                self._release.on_click(lambda _: self._let_poses_move(True))
            with gui.add_folder("Show"):
                for name, label in shown.items():
                    node = scene.add_frame(f"/{name}", show_axes=False)
                    box = gui.add_checkbox(label, True)
                    box.on_update(lambda event, node=node: setattr(node, "visible", event.target.value))
                if len(self._drawn.keyframes) < len(self._given):
                    gui.add_markdown(f"{len(self._drawn.keyframes):,} of {len(self._given):,} keyframes are drawn.")
            with gui.add_folder("Brightness"):
                exposure = gui.add_slider("exposure [stops]", -5.0, 5.0, 0.1, model.exposure)
                gamma = gui.add_slider("gamma", 0.4, 3.0, 0.1, model.gamma)
                exposure.on_update(lambda event: self._display(exposure=event.target.value))
                gamma.on_update(lambda event: self._display(gamma=event.target.value))
            with gui.add_folder("Progress"):
                self._curves = gui.add_markdown("", image_root=Path())
        self._time.on_update(lambda _: self._go_to_time())

    def after_step(self, step: int) -> None:
        """Note the loss, and bring up to date what is due, if anybody looks; nerfstudio holds its lock meanwhile."""
        self._step = step + 1
        if self._viewer is None:
            return
        if step % self._every == 0 and self._pipeline.last_loss is not None:
            self._losses.append((step + 1, self._pipeline.last_loss))
            if len(self._losses) > _MOST_RECORDS:
                self._losses, self._every = self._losses[::2], 2 * self._every
        now = time.monotonic()
        due = [chore for chore in self._chores if chore.due_s <= now]
        if due and self._looked_at and self.viser_server.get_clients():
            min(due, key=lambda chore: chore.due_s).run()

    # Who comes, and where they look from.

    def _welcome(self, client: viser.ClientHandle) -> None:
        # viser holds a lock that training may wait for: what takes time is done elsewhere.
        client.camera.fov = vertical_fov_rad(self._pipeline)
        self._look(client, self._pose_at(self._t_us()))
        client.camera.on_update(self._drawn.clear_the_view)
        threading.Thread(target=self._draw_all, args=(client,), daemon=True).start()

    def _look(self, client: viser.ClientHandle, pose: Poses) -> None:
        with client.atomic():
            client.camera.position = SCALE * pose.position.numpy()
            client.camera.wxyz = pose.quat_wxyz.numpy()

    @torch.no_grad()
    def _pose_at(self, t_us: int) -> Poses:
        poses = self._pipeline.model.camera_optimizer.poses_at(torch.tensor(t_us, device=self._pipeline.device))
        return Poses(poses.position.double().cpu(), poses.quat_wxyz.double().cpu())

    def _t_us(self) -> int:
        times = self._pipeline.model.camera_optimizer.keyframe_t_us
        return min(int(times[0]) + round(1e6 * self._time.value), int(times[-1]))

    def _fly_to_keyframe(self, event: viser.GuiEvent) -> None:
        self._fly(int(self._given[int(self._keyframe.value)]), event.client)

    def _fly(self, keyframe: int, client: viser.ClientHandle | None) -> None:
        times = self._pipeline.model.camera_optimizer.keyframe_t_us
        self._time.value = 1e-6 * float(times[keyframe] - times[0])
        if client is not None and not self._follow.value:
            self._look(client, self._pose_at(self._t_us()))

    def _step_back(self, client: viser.ClientHandle | None) -> None:
        """Look as the camera does now, from so far behind that all keyframes are in view."""
        if client is None:
            return
        position, quat_wxyz = self._pose_at(self._t_us())
        places = self._drawn.places()
        turned = rotate(quat_wxyz_conjugate(quat_wxyz).expand(len(places), 4), places - position)
        aside = turned[:, :2].abs().amax(dim=-1) / math.tan(vertical_fov_rad(self._pipeline) / 2)
        back = torch.zeros(3, dtype=torch.float64)
        back[2] = -1.2 * (aside - turned[:, 2]).amax()
        self._look(client, Poses(position + rotate(quat_wxyz, back), quat_wxyz))

    def _go_to_time(self) -> None:
        if self._follow.value:
            pose = self._pose_at(self._t_us())
            for client in self.viser_server.get_clients().values():
                self._look(client, pose)
        self._show_moment()

    def _draw_all(self, client: viser.ClientHandle) -> None:
        """What the first to look needs, and nobody before."""
        with self._drawing:
            if not self._looked_at:
                self._drawn.draw_keyframes(self._fly)
                self._drawn.draw_lines()
                with self._lock():
                    self._pipeline.fit_display_range()
                    self._draw_curves()
                self._looked_at = True
        self._drawn.clear_the_view(client.camera)
        self._show_moment()

    def _lock(self) -> threading.Lock:
        lock = self.viewer.train_lock
        assert lock is not None
        return lock

    # What is shown in the panel.

    def _show_moment(self) -> None:
        """The pictures of the time on the slider; of times passed over meanwhile, only the last."""
        self._wanted += 1
        while self._wanted != self._shown and self._drawing.acquire(blocking=False):
            try:
                self._shown = self._wanted
                self._show_pictures(self._lock())
            finally:
                self._drawing.release()

    def _show_moment_again(self) -> None:
        if self._drawing.acquire(blocking=False):
            try:
                self._show_pictures(None)
            finally:
                self._drawing.release()

    def _show_pictures(self, lock: Any) -> None:
        """With a lock to be taken for rendering, or without one where it is held."""
        t_us = self._t_us()
        half_us = half_window_us(self._pipeline.model.camera_optimizer.keyframe_t_us)
        moment = recorded(self._pipeline, t_us, half_us)
        if lock:
            lock.acquire()
        try:
            training = self._pipeline.model.training
            self._pipeline.model.eval()
            pictures = rendered(self._pipeline, t_us, half_us)
            self._pipeline.model.train(training)
        finally:
            if lock:
                lock.release()
        first, *rest = moment.pictures.items()
        png = side_by_side({first[0]: first[1], **pictures, **dict(rest)})
        self._picture.content = f"{moment.says} on the clock of the events\n\n{_as_markdown(png)}"

    def _draw_curves(self) -> None:
        self._curves.content = _as_markdown(curves([*self._evaluated(), *self._live()]))

    def _evaluated(self) -> list[dict[str, Any]]:
        """What a finished run has on record."""
        path = self.viewer.log_filename.parent / "metrics.jsonl"
        if self.viewer.trainer is not None or not path.is_file():
            return []
        return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()[1:]]

    def _live(self) -> list[dict[str, Any]]:
        if self.viewer.trainer is None:
            return []
        self._records.append({"step": self._step, **self._pipeline.numbers()})
        if len(self._records) > _MOST_RECORDS:
            self._records = self._records[::2]
        losses = [{"step": step, "loss": float(loss)} for step, loss in self._losses]
        return [*losses, *self._records]

    # What buttons and sliders do.

    def _display(self, **settings: float) -> None:
        for name, value in settings.items():
            setattr(self._pipeline.model, name, value)
        self.viewer._trigger_rerender()
        self._show_moment()

    def _let_poses_move(self, move: bool) -> None:
        self._pipeline.model.camera_optimizer.frozen = not move
        self._freeze.visible, self._release.visible = move, not move

    def _save(self, event: viser.GuiEvent) -> None:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "trajectory_refined.txt"
            self._pipeline.write_refined(path)
            content = path.read_bytes()
        if event.client is not None:
            event.client.send_file_download(path.name, content)


def _as_markdown(png: bytes) -> str:
    return f"![](data:image/png;base64,{base64.b64encode(png).decode()})"


class ViewedPipeline(EbarfPipeline):
    """The pipeline with a panel in nerfstudio's viewer."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.viewer_panel = ViewerPanel(self)

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """The viewer is told of every step."""
        after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
        shown = TrainingCallback(after, self.viewer_panel.after_step)
        return [*super().get_training_callbacks(training_callback_attributes), shown]
