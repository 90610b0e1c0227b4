"""What is built of the repository, and the files beside the code that say how to build, cite and use it."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from importlib.metadata import Distribution
from pathlib import Path

import pytest
import yaml
from packaging.specifiers import SpecifierSet
from packaging.version import Version

from ebarf_ns.nerf.old_flags import OLD_FLAGS
from tests.conftest import REPOSITORY

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
ENTRY_POINTS = {
    "console_scripts": PROJECT["scripts"],
    **PROJECT["entry-points"],
}


def tracked() -> list[str]:
    listed = subprocess.run(["git", "ls-files"], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a checkout of git")
    return listed.stdout.splitlines()


def run(*words: object, cwd: Path, **environment: str) -> str:
    """Python with these words, which sees no package of the repository unless told to."""
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command, shown = [sys.executable, *map(str, words)], {**clean, **environment}
    finished = subprocess.run(command, cwd=cwd, env=shown, capture_output=True, text=True, check=False)
    assert finished.returncode == 0, finished.stdout[-2000:] + finished.stderr[-2000:]
    return finished.stdout


def build(kind: str, source: Path, output: Path) -> Path:
    pytest.importorskip("setuptools", minversion="77", reason="older ones know no licence expressions")
    output.mkdir()
    run("-c", f"from setuptools import build_meta; build_meta.build_{kind}({str(output)!r})", cwd=source)
    (built,) = output.iterdir()
    return built


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("packaging")
    for name in tracked():
        if (REPOSITORY / name).is_file():
            (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(REPOSITORY / name, folder / "source" / name)
    return build("sdist", folder / "source", folder / "sdist")


@pytest.fixture(scope="module")
def wheel(sdist: Path) -> Path:
    """Of what the sdist holds: nothing that the wheel needs is missing there."""
    folder = sdist.parent.parent
    with tarfile.open(sdist) as archive:
        archive.extractall(folder / "unpacked")
    (source,) = (folder / "unpacked").iterdir()
    return build("wheel", source, folder / "wheel")


def test_the_sdist_holds_what_developing_takes(sdist: Path):
    with tarfile.open(sdist) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames() if "/" in name}
    left_out = {".ci/run", ".gitignore", ".dockerignore"}
    assert set(tracked()) - left_out <= names
    assert not [name for name in names if name.endswith(".pyc")]


def test_the_wheel_is_installed_and_runs_without_the_repository(wheel: Path, tmp_path: Path):
    target = tmp_path / "site packages"
    words = ("-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", target, wheel)
    run(*words, cwd=tmp_path)
    where = run("-c", "import ebarf_ns; print(ebarf_ns.__file__)", cwd=tmp_path, PYTHONPATH=str(target))
    assert Path(where.strip()).is_relative_to(target)
    (script,) = (target / "bin").glob("ebarf*")
    assert "ebarf inspect" in run(script, "--help", cwd=tmp_path, PYTHONPATH=str(target))
    assert run(script, "--version", cwd=tmp_path, PYTHONPATH=str(target)).strip() == PROJECT["version"]
    package = {name for name in tracked() if name.startswith("ebarf_ns/")}
    assert {name for name in package if not (target / name).is_file()} == set()
    (information,) = target.glob("*.dist-info")
    found = Distribution.at(information)
    assert found.metadata["License-Expression"] == "Apache-2.0"
    for group, names in ENTRY_POINTS.items():
        assert {one.name: one.value for one in found.entry_points.select(group=group)} == names
    for one in found.entry_points:
        module = (target / one.module.replace(".", "/")).with_suffix(".py")
        assert re.search(rf"^(def )?{one.attr}\b", module.read_text(encoding="utf-8"), re.M)


def test_tests_and_tools_are_not_installed(wheel: Path):
    with zipfile.ZipFile(wheel) as archive:
        top = {name.split("/")[0] for name in archive.namelist()}
    assert top == {"ebarf_ns", f"ebarf_ns-{PROJECT['version']}.dist-info"}


@pytest.mark.slow
def test_pip_installs_it_from_git(tmp_path: Path):
    assert ".gitmodules" not in tracked()
    target = tmp_path / "target"
    words = ("-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--target", target)
    run(*words, f"git+{REPOSITORY.as_uri()}", cwd=tmp_path)
    assert (target / "ebarf_ns" / "nerf" / "model.py").is_file()


def pinned(file: str) -> dict[str, str]:
    lines = [line.split(";")[0].strip() for line in (REPOSITORY / file).read_text(encoding="utf-8").splitlines()]
    return dict(line.split("==") for line in lines if line and not line.startswith("#"))


def bounds() -> dict[str, str]:
    """The dependencies and what of them is allowed."""
    found = [re.fullmatch(r"([\w-]+)([^;]*)", one) for one in PROJECT["dependencies"]]
    return {one[1]: one[2] for one in found if one}


def test_both_sets_of_versions_lie_within_the_bounds_and_the_oldest_is_at_them():
    tested, oldest = pinned("constraints.txt"), pinned("constraints-oldest.txt")
    assert set(tested) == set(bounds())
    for name, allowed in bounds().items():
        assert SpecifierSet(allowed).contains(tested[name]), name
        lower = [one.version for one in SpecifierSet(allowed) if one.operator in (">=", "==")]
        if lower:
            assert Version(oldest[name]) == Version(lower[0]), name
    assert set(oldest) <= set(bounds())


def test_what_torch_an_environment_has_is_kept():
    """No pin: nerfstudio's users have compiled extensions that another torch breaks."""
    assert bounds()["torch"] == ">=2.4" and bounds()["torchvision"] == ""


def test_the_tested_set_is_what_make_and_ci_install():
    setup = (REPOSITORY / "tools" / "setup.sh").read_text(encoding="utf-8")
    assert "constraints=${2:-constraints.txt}" in setup and '--constraint "$constraints"' in setup
    assert re.search(r"^key=.* constraints\.txt ", (REPOSITORY / ".ci" / "run").read_text(encoding="utf-8"), re.M)
    makefile = (REPOSITORY / "Makefile").read_text(encoding="utf-8")
    assert re.search(r"^\$\(VENV\)/\.installed:.* constraints\.txt ", makefile, re.M)


def test_the_dockerfile_builds_on_a_base_of_choice_from_files_that_exist():
    text = (REPOSITORY / "Dockerfile").read_text(encoding="utf-8")
    joined = re.sub(r"\\\n", " ", text)
    steps = [tuple(line.split(None, 1)) for line in joined.splitlines() if line.strip() and not line.startswith("#")]
    known = {"ARG", "FROM", "RUN", "USER", "WORKDIR", "COPY", "ENV", "EXPOSE", "CMD"}
    assert {word for word, _ in steps} <= known
    assert steps[0][0] == "ARG" and steps[0][1].startswith("BASE=") and steps[1] == ("FROM", "${BASE}")
    for image in re.findall(r"BASE=(\S+)", text):
        assert ":" in image and not image.endswith(":latest"), image
    ignored = (REPOSITORY / ".dockerignore").read_text(encoding="utf-8").splitlines()
    copied = [word for step, rest in steps if step == "COPY" for word in rest.split()[:-1] if not word.startswith("--")]
    assert copied
    for source in copied:
        assert (REPOSITORY / source).exists() and f"!{source}" in ignored, source
    users = [rest for step, rest in steps if step == "USER"]
    assert users and users[-1] not in ("root", "0")
    assert any(step == "RUN" and "--constraint source/constraints.txt" in rest for step, rest in steps)
    for step, rest in steps:
        if step == "RUN" and "apt-get install" in rest:
            assert "apt-get update" in rest and "--no-install-recommends" in rest and "rm -rf /var/lib/apt" in rest


def test_licence_citation_and_changes_agree_with_the_project():
    assert "Apache License" in (REPOSITORY / "LICENSE").read_text(encoding="utf-8")
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["license"] == PROJECT["license"] and citation["version"] == PROJECT["version"]
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    changes = (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (\S+)", changes, re.M)[0] == PROJECT["version"]
    for old, new in OLD_FLAGS.items():
        assert f"| `{old}` | `{new}` |" in changes
