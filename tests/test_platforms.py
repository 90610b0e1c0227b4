"""Other systems than the one that tests: paths, line ends, no calls that only Linux has."""

import ast
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from ebarf_ns import memory
from ebarf_ns.events.recording import read_recording
from ebarf_ns.files import read_picture, write_picture
from ebarf_ns.geometry.trajectory_file import read_tum
from ebarf_ns.scene import read_scene
from tests.cli.test_ebarf_commands import ecd_folder
from tests.conftest import run_command, run_ok

PACKAGE = Path(memory.__file__).parent
ONLY_UNIX_MODULES = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}
ONLY_UNIX = {
    "os": "fork forkpty getuid geteuid getgid getpgid getppid killpg mkfifo nice posix_fadvise posix_fallocate "
    "posix_spawn pread pwrite sched_getaffinity sched_setaffinity setsid statvfs sysconf uname wait4 waitpid O_DIRECT",
    "signal": "SIGALRM SIGCHLD SIGHUP SIGKILL SIGPIPE SIGQUIT SIGSTOP SIGUSR1 SIGUSR2 alarm pause setitimer",
    "mmap": "MAP_PRIVATE MAP_SHARED MADV_HUGEPAGE MADV_SEQUENTIAL",
}
NAMES = {(module, name) for module, names in ONLY_UNIX.items() for name in names.split()}
SOURCES = sorted(PACKAGE.rglob("*.py"))


def unguarded(tree: ast.AST) -> list[str]:
    """Names that Windows lacks, used where neither ``hasattr`` nor ``try`` looks for them first."""
    found: list[str] = []

    def walk(node: ast.AST, guarded: bool) -> None:
        inside = guarded or isinstance(node, ast.Try) or (isinstance(node, ast.IfExp | ast.If) and asks(node.test))
        if not inside:
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                found.extend([f"{node.value.id}.{node.attr}"] if (node.value.id, node.attr) in NAMES else [])
            if isinstance(node, ast.Import):
                found.extend(one.name for one in node.names if one.name in ONLY_UNIX_MODULES)
            if isinstance(node, ast.ImportFrom) and node.module in ONLY_UNIX_MODULES:
                found.append(node.module)
        for child in ast.iter_child_nodes(node):
            walk(child, inside)

    walk(tree, False)
    return found


def asks(test: ast.AST) -> bool:
    return any(isinstance(one, ast.Name) and one.id == "hasattr" for one in ast.walk(test))


@pytest.mark.parametrize(
    ("source", "names"),
    [
        ("import os\nos.sched_getaffinity(0)", ["os.sched_getaffinity"]),
        ("import resource, sys", ["resource"]),
        ("try:\n    import resource\nexcept ImportError:\n    resource = None", []),
        ("size = os.posix_fallocate(1, 0, 2) if hasattr(os, 'posix_fallocate') else 0", []),
    ],
)
def test_the_check_sees_what_it_should(source: str, names: list[str]):
    assert unguarded(ast.parse(source)) == names


def test_nothing_is_called_that_windows_lacks():
    wrong = {path.name: unguarded(ast.parse(path.read_text(encoding="utf-8"))) for path in SOURCES}
    assert {name: names for name, names in wrong.items() if names} == {}


LACKING_WINDOWS = """
import importlib, os, pkgutil, signal, sys
import aedat, cv2, evo.core, h5py, hdf5plugin, matplotlib.pyplot, numba, psutil, rosbags.rosbag2, scipy, torch
import triton, tyro
import ebarf_ns
names = {names}
for module, name in names:
    if module in sys.modules and hasattr(sys.modules[module], name):
        delattr(sys.modules[module], name)
for module in {modules}:
    sys.modules[module] = None
found = [one.name for one in pkgutil.walk_packages(ebarf_ns.__path__, "ebarf_ns.") if ".nerf" not in one.name]
for name in found:
    importlib.import_module(name)
from ebarf_ns.memory import peak_memory_mib
print(len(found), peak_memory_mib())
"""


def test_all_but_the_plugin_is_imported_without_what_windows_lacks():
    # What Python's own library asks for by itself on this system stays.
    names = sorted(NAMES - {("os", name) for name in "waitpid getpid getppid uname sysconf geteuid getuid".split()})
    script = LACKING_WINDOWS.format(names=names, modules=sorted(ONLY_UNIX_MODULES - {"posix", "pwd", "grp"}))
    finished = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stderr[-2000:]
    modules, memory_mib = finished.stdout.split()
    assert int(modules) > 60 and float(memory_mib) >= 0


def test_no_process_is_forked_and_no_picture_opened_by_name():
    """Processes start anew everywhere, and OpenCV opens only the names of one code page on Windows."""
    forbidden = ("multiprocessing", "os.fork", "cv2.imread(", "cv2.imwrite(", "cv2.VideoCapture(", '"fork"')
    for path in SOURCES:
        text = path.read_text(encoding="utf-8")
        assert not [one for one in forbidden if one in text], path


def test_text_files_are_opened_as_utf_8():
    """Windows has another encoding of its own."""
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute | ast.Name):
                name = node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id
                if name in ("read_text", "write_text") and not (isinstance(node.func, ast.Name)):
                    assert any(word.arg == "encoding" for word in node.keywords), f"{path}:{node.lineno}"


def test_memory_is_not_known_where_the_system_does_not_tell(monkeypatch: pytest.MonkeyPatch):
    assert memory.peak_memory_mib() > 50
    monkeypatch.setattr(memory, "Path", lambda _: SimpleNamespace(is_file=lambda: False))
    if memory.resource:
        assert memory.peak_memory_mib() > 50
    monkeypatch.setattr(memory, "resource", None)
    assert memory.peak_memory_mib() == 0


def test_folders_with_spaces_and_letters_beyond_ascii(tmp_path: Path):
    folder = tmp_path / "Aufnahme für 事件 камера"
    folder.mkdir()
    scene = folder / "szene 1"
    run_ok("ebarf", "simulate", scene, "--width=24", "--height=18", "--focal-px=20", "--duration-s=0.2", "--frames=2")
    assert str(scene) in run_ok("ebarf", "inspect", scene)
    source = ecd_folder(folder / "quelle ö", images_txt="0.1 bild ä.png\n")
    write_picture(source / "bild ä.png", np.full((180, 240), 7, np.uint8))
    run_ok("ebarf", "process", "ecd", source, "--output", folder / "szene 2")
    made = read_scene(folder / "szene 2")
    assert [frame.path.name for frame in made.frames] == ["bild ä.png"]
    pixels = read_picture(made.frames[0].path)
    assert pixels is not None and (pixels == 7).all()
    run_ok("ebarf", "inspect", source / "events.txt", "--picture", folder / "bögen.png")
    sheet = read_picture(folder / "bögen.png")
    assert sheet is not None and sheet.ndim == 2


def crlf(folder: Path) -> None:
    for path in folder.rglob("*"):
        if path.suffix in (".txt", ".json", ".yaml", ".csv"):
            path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))


def test_text_with_the_line_ends_of_windows_is_the_same(tmp_path: Path, tiny_scene: Path):
    made = []
    for name in ("lf", "crlf"):
        folder = tmp_path / name
        folder.mkdir()
        source = ecd_folder(folder / "ecd", images_txt="0.1 a.png\n")
        write_picture(source / "a.png", np.full((180, 240), 7, np.uint8))
        (folder / "flags.yaml").write_text("format: ecd\ncontrast-threshold: [0.2, 0.3]\n")
        (folder / "kalibr.yaml").write_text(
            "cam0:\n  intrinsics: [200, 200, 120, 90]\n  distortion_coeffs: []\n  resolution: [240, 180]\n"
        )
        (folder / "poses.csv").write_text(
            "#t, px, py, pz, qw, qx, qy, qz\n0, 0, 0, 0, 1, 0, 0, 0\n0.2, 2, 0, 0, 1, 0, 0, 0\n"
        )
        if name == "crlf":
            crlf(folder)
        run_ok(
            "ebarf", "process", "--config", folder / "flags.yaml", "--source", source, "--output", folder / "scene",
            "--camera", folder / "kalibr.yaml", "--trajectory", folder / "poses.csv",
        )  # fmt: skip
        if name == "crlf":
            crlf(folder / "scene")
        scene = read_scene(folder / "scene")
        made.append((scene, read_recording(scene.events, 240, 180), read_tum(scene.trajectory)))
    (first, events, poses), (second, same_events, same_poses) = made
    assert first.camera == second.camera and first.contrast_threshold == second.contrast_threshold
    assert len(first.frames) == len(second.frames) == 1
    assert (events.t_us == same_events.t_us).all() and (events.x == same_events.x).all()
    assert (poses.poses.position == same_poses.poses.position).all() and poses.poses.position[1, 0] > 0
    scene = shutil.copytree(tiny_scene, tmp_path / "tiny")
    crlf(scene)
    assert run_command("ebarf", "inspect", scene).code == 0
