"""A run's configuration is read, whatever its file says, and nothing of it is run."""

from pathlib import Path

import pytest
import yaml

from ebarf_ns.errors import EvaluationError
from ebarf_ns.nerf.method import ebarf, ebarf_paper, enerf
from ebarf_ns.nerf.run_config import read_run_config


@pytest.mark.parametrize("method", [ebarf, ebarf_paper, enerf], ids=lambda method: method.config.method_name)
def test_it_is_what_nerfstudio_would_read(method, tmp_path: Path):
    path = tmp_path / "config.yml"
    path.write_text(yaml.dump(method.config))
    assert yaml.dump(read_run_config(path)) == path.read_text()


def test_a_folder_of_another_system_is_a_path(tmp_path: Path):
    path = tmp_path / "config.yml"
    dumped = yaml.dump(ebarf.config)
    posix = "!!python/object/apply:pathlib.PosixPath\n- outputs"
    assert posix in dumped
    path.write_text(dumped.replace(posix, "!!python/object/apply:pathlib.WindowsPath\n- outputs"))
    assert read_run_config(path).output_dir == Path("outputs")


@pytest.mark.parametrize(
    "hostile",
    [
        "!!python/object/apply:os.system ['touch {0}']",
        "!!python/object/apply:subprocess.check_output [['touch', '{0}']]",
        "!!python/object/new:os.system ['touch {0}']",
        "!!python/object/apply:nerfstudio.utils.scripts.run_command ['touch {0}']",
        "!!python/name:os.system ''",
        "!!python/name:nerfstudio.utils.scripts.run_command ''",
        "!!python/module:os ''",
        "!!python/object:os._wrap_close {{}}",
        "!!python/object:pathlib.PosixPath {{}}",
        "!!python/object/apply:ebarf_ns.nerf.trainer_config.EbarfTrainerConfig []",
        "!!python/object/apply:nerfstudio.utils.writer.EventName ['no such event']",
        "!!python/object/apply:pathlib.PosixPath [1, 2]",
        "!!python/name:ebarf_ns.nowhere.nothing ''",
        "!!python/name:pathlib ''",
    ],
)
def test_nothing_is_run_that_the_file_names(hostile: str, tmp_path: Path):
    path, made = tmp_path / "config.yml", tmp_path / "made"
    path.write_text(yaml.dump(ebarf.config).replace("max_num_iterations:", f"x: {hostile.format(made)}\ny:"))
    with pytest.raises(EvaluationError, match=r"config\.yml: cannot be read .* expected the config\.yml"):
        read_run_config(path)
    assert not made.exists()


@pytest.mark.parametrize(
    "content, said",
    [
        ("", "holds a NoneType"),
        ("[1, 2]", "holds a list"),
        ("!!python/object:ebarf_ns.nerf.model.EbarfModelConfig {}", "has a target of another configuration"),
        ("!!python/name:ebarf_ns.nerf.model.EbarfModelConfig ''", "holds a type"),
        ("a: [", "cannot be read"),
        ("[" * 5000, "cannot be read"),
        ("\x00", "cannot be read"),
    ],
)
def test_other_files_are_one_line(content: str, said: str, tmp_path: Path):
    path = tmp_path / "config.yml"
    path.write_text(content)
    with pytest.raises(EvaluationError, match=said) as error:
        read_run_config(path)
    assert "\n" not in str(error.value)
    with pytest.raises(EvaluationError, match="No such file"):
        read_run_config(tmp_path / "none.yml")
