"""The panel in nerfstudio's viewer: trajectories, keyframes, events around a time, and training progress.

nerfstudio finds the panel as an attribute of the pipeline and passes it the viewer, in both ns-train and ns-viewer.
Nothing is read, drawn or rendered before a client connects.
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
from ebarf_ns.nerf.viewer_lock import mend_viser
from ebarf_ns.nerf.viewer_pictures import curves, half_window_us, recorded, rendered, side_by_side
from ebarf_ns.nerf.viewer_scene import SCALE, DrawnScene, vertical_fov_rad

if TYPE_CHECKING:
    import viser
    from nerfstudio.viewer.viewer import Viewer
    from torch import Tensor


# A task that took a second is repeated after this many seconds.
_PAUSE_FACTOR, _LEAST_PAUSE_S = 50.0, 1.0
_MOST_RECORDS = 400
_CPU_MAX_RES = 256


@dataclass
class _RecurringTask:
    """A task repeated during training, in a small share of its time."""

    do: Callable[[], None]
    due_s: float = 0.0

    def run(self) -> None:
        started = time.monotonic()
        self.do()
        ended = time.monotonic()
        self.due_s = ended + max(_LEAST_PAUSE_S, _PAUSE_FACTOR * (ended - started))


class ViewerPanel(ViewerControl):
    """The "Event camera" panel in nerfstudio's viewer."""

    def __init__(self, pipeline: EbarfPipeline):
        # nerfstudio searches the public attributes for viewer elements.
        self._pipeline = pipeline
        self._viewer: Viewer | None = None
        self._records: list[dict[str, Any]] = []
        self._losses: list[tuple[int, Tensor]] = []
        self._record_interval = 1
        self._step = 0
        self._drawing = threading.Lock()
        self._scene_drawn = False
        self._requested = self._shown = 0

    def _setup(self, viewer: Viewer) -> None:
        """Set up the panel; nerfstudio calls this after building its viewer, before the scene."""
        super()._setup(viewer)
        mend_viser()
        # The buttons that use these handles exist before the scene does.
        viewer.camera_handles = {}
        config = viewer.config
        self._drawn = DrawnScene(
            self._pipeline, self.viser_server, config.max_num_display_images, config.camera_frustum_scale
        )
        # nerfstudio's own frustums use the horizontal field of view as the vertical one, and never move.
        viewer.config = replace(config, max_num_display_images=0)
        for button in (viewer.hide_images, viewer.show_images, *([] if viewer.trainer else [viewer.pause_train])):
            button.visible = False
        # The default theme has a logo that is fetched from the network.
        self.viser_server.gui.configure_theme(control_layout="collapsible", dark_mode=True, brand_color=(255, 211, 105))
        tasks = (self._drawn.draw_lines, self._draw_curves, self._pipeline.fit_display_range, self._show_moment_again)
        self._tasks = [_RecurringTask(do) for do in tasks]
        # With depth, fog near the camera would hide the trajectories, and coarse renders would cut through them.
        viewer.control_panel._layer_depth.value = False
        if viewer.trainer and self._pipeline.device.type == "cpu":
            # A render of 512 pixels takes seconds on a CPU, and training gets nine tenths of the time.
            viewer.control_panel._max_res.value = _CPU_MAX_RES
        self._build()
        self._viewer = viewer
        self.viser_server.on_client_connect(self._on_connect)

    def _build(self) -> None:
        gui, scene = self.viser_server.gui, self.viser_server.scene
        model = self._pipeline.model
        times = model.camera_optimizer.keyframe_t_us
        self._given = model.camera_optimizer.given.cpu()
        labels = {
            "initial": "initial, blue",
            "refined": "refined, orange",
            "reference": "reference, green",
            "keyframes": "keyframes",
        }
        if self._pipeline.scene.groundtruth is None:
            del labels["reference"]
        with gui.add_folder("Event camera", order=-1):
            length_s = max(round(1e-6 * float(times[-1] - times[0]), 3), 0.001)
            self._time = gui.add_slider("time [s]", 0.0, length_s, 0.001, round(length_s / 2, 3))
            self._picture = gui.add_markdown("", image_root=Path())
            self._follow = gui.add_checkbox("follow the camera", True)
            last = len(self._given) - 1
            self._keyframe = gui.add_number("keyframe", last // 2, min=0, max=last, step=1)
            gui.add_button("Fly to keyframe").on_click(self._fly_to_keyframe)
            gui.add_button("See all keyframes").on_click(lambda event: self._step_back(event.client))
            gui.add_button("Save refined trajectory").on_click(self._save)
            if model.camera_optimizer.config.mode == "refine" and self.viewer.trainer:
                self._freeze = gui.add_button("Freeze poses")
                self._release = gui.add_button("Release poses", visible=False)
                self._freeze.on_click(lambda _: self._set_poses_free(False))
                self._release.on_click(lambda _: self._set_poses_free(True))
            with gui.add_folder("Show"):
                for name, label in labels.items():
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
        """Record the loss and, with a client connected, run one due task; nerfstudio holds its train lock meanwhile."""
        self._step = step + 1
        if self._viewer is None:
            return
        if step % self._record_interval == 0 and self._pipeline.last_loss is not None:
            self._losses.append((step + 1, self._pipeline.last_loss))
            if len(self._losses) > _MOST_RECORDS:
                self._losses, self._record_interval = self._losses[::2], 2 * self._record_interval
        now = time.monotonic()
        due = [task for task in self._tasks if task.due_s <= now]
        if due and self._scene_drawn and self.viser_server.get_clients():
            min(due, key=lambda task: task.due_s).run()

    # Clients and their cameras.

    def _on_connect(self, client: viser.ClientHandle) -> None:
        # viser holds a lock that training may wait for, so slow work is done in another thread.
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
        """Keep the camera's orientation and move it back until all keyframes are in view."""
        if client is None:
            return
        position, quat_wxyz = self._pose_at(self._t_us())
        places = self._drawn.places()
        turned = rotate(quat_wxyz_conjugate(quat_wxyz).expand(len(places), 4), places - position)
        needed_depth = turned[:, :2].abs().amax(dim=-1) / math.tan(vertical_fov_rad(self._pipeline) / 2)
        back = torch.zeros(3, dtype=torch.float64)
        back[2] = -1.2 * (needed_depth - turned[:, 2]).amax()
        self._look(client, Poses(position + rotate(quat_wxyz, back), quat_wxyz))

    def _go_to_time(self) -> None:
        if self._follow.value:
            pose = self._pose_at(self._t_us())
            for client in self.viser_server.get_clients().values():
                self._look(client, pose)
        self._show_moment()

    def _draw_all(self, client: viser.ClientHandle) -> None:
        """Draw the scene when the first client connects, and the current images for every client."""
        with self._drawing:
            if not self._scene_drawn:
                self._drawn.draw_keyframes(self._fly)
                self._drawn.draw_lines()
                with self._lock():
                    self._pipeline.fit_display_range()
                    self._draw_curves()
                self._scene_drawn = True
        self._drawn.clear_the_view(client.camera)
        self._show_moment()

    def _lock(self) -> threading.Lock:
        lock = self.viewer.train_lock
        assert lock is not None
        return lock

    # Contents of the panel.

    def _show_moment(self) -> None:
        """Show the images at the slider's time; of changes meanwhile, only the last is shown."""
        self._requested += 1
        while self._requested != self._shown and self._drawing.acquire(blocking=False):
            try:
                self._shown = self._requested
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
        """Render and show the images, under the given lock; None if the caller already holds it."""
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
        """Return the recorded metrics of a finished run."""
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

    # Actions of buttons and sliders.

    def _display(self, **settings: float) -> None:
        for name, value in settings.items():
            setattr(self._pipeline.model, name, value)
        self.viewer._trigger_rerender()
        self._show_moment()

    def _set_poses_free(self, free: bool) -> None:
        self._pipeline.model.camera_optimizer.frozen = not free
        self._freeze.visible, self._release.visible = free, not free

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
    """A pipeline with a panel in nerfstudio's viewer."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.viewer_panel = ViewerPanel(self)

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """Return the callbacks, including one that updates the panel after every step."""
        after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
        update = TrainingCallback(after, self.viewer_panel.after_step)
        return [*super().get_training_callbacks(training_callback_attributes), update]
