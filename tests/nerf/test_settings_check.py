"""What is said of a run's configuration before anything is done."""

import sys
from pathlib import Path

import pytest
from nerfstudio.configs.method_configs import AnnotatedBaseConfigUnion
from tyro import cli

from ebarf_ns.nerf.dataparser import EbarfDataParserConfig
from ebarf_ns.nerf.old_flags import OLD_FLAGS
from ebarf_ns.nerf.settings_check import check_settings
from tests.nerf.test_training import config, trainer


def test_no_data_is_one_line_and_leaves_nothing(tiny_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    made = config(tiny_scene, tmp_path / "out")
    made.pipeline.datamanager.data = None  # pyright: ignore[reportAttributeAccessIssue]
    made.pipeline.datamanager.dataparser = EbarfDataParserConfig()  # pyright: ignore[reportAttributeAccessIssue]
    with pytest.raises(SystemExit) as stopped:
        trainer(made)
    assert stopped.value.code == 2
    assert capsys.readouterr().err == "error: no --data given, expected ns-train ebarf --data SCENE\n"
    assert not (tmp_path / "out").exists()


def test_old_flags_work_and_say_what_they_are_called_now(
    tiny_scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    for old, new in OLD_FLAGS.items():
        words = ["ebarf", "--data", str(tiny_scene), old, "0.7"]
        made = cli(AnnotatedBaseConfigUnion, args=words)
        field = new.rsplit(".", 1)[-1].replace("-", "_")
        assert getattr(made.pipeline.model, field) == 0.7
        monkeypatch.setattr(sys, "argv", ["ns-train", *words])
        made.pipeline.datamanager.data = tiny_scene
        check_settings(made)
        assert capsys.readouterr().err == f"warning: {old} is now called {new}; the next version removes the old name\n"
