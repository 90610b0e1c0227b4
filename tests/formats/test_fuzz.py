"""A fuzz target for each reader: any bytes result in events, or in one line that names the file."""

from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from ebarf_ns.errors import RecordingError
from ebarf_ns.formats.intake import Intake, take_in
from ebarf_ns.formats.recognise import RecordingFormat, open_recording
from tests.conftest import DATA
from tests.formats.test_recognise import MADE, SINGLE, SIZE

FORMATS: list[RecordingFormat] = ["hdf5", "aedat4", "bag", "raw", "dat", "npz", "npy", "mat", "text"]
EDIT = st.tuples(
    st.sampled_from(["flip", "remove", "insert", "repeat", "zero"]), st.floats(0, 1), st.binary(min_size=1, max_size=24)
)


def edited(content: bytes, edits: list[tuple[str, float, bytes]]) -> bytes:
    """Content with some bytes flipped, deleted, inserted, duplicated or zeroed."""
    for kind, place, some in edits:
        # The beginning, with the header, is hit more often than the rest.
        first, length = int(place**2 * len(content)), len(some)
        before, within, after = content[:first], content[first : first + length], content[first + length :]
        changed = {
            "flip": bytes(a ^ b for a, b in zip(within, some, strict=False)),
            "remove": b"",
            "insert": some + within,
            "repeat": within * (1 + some[0]),
            "zero": bytes(len(within)),
        }
        content = before + changed[kind] + after
    return content


def ends_well(path: Path, known: RecordingFormat | None = None) -> None:
    """Read a file to the end into a scene's events."""
    output = path.with_name("out.h5")
    output.unlink(missing_ok=True)
    try:
        source = open_recording(path, known)
        report = take_in(source, SIZE, Intake(unsorted="sort"), output)
        # Incomplete events are never read.
        assert report.kept + sum(report.left_out.values()) == report.read + sum(source.dropped.values())
    except RecordingError as error:
        assert path.name in str(error) and "\n" not in str(error)
        assert not output.exists()


@pytest.mark.parametrize("name", SINGLE)
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(edits=st.lists(EDIT, min_size=1, max_size=6))
@example(edits=[("flip", 0.984375, b"\x01")])  # a bag whose message definition rosbags quotes in full, line by line
def test_edited_files(tmp_path: Path, name: str, edits: list[tuple[str, float, bytes]]):
    whole = tmp_path / name
    if not whole.exists():
        MADE[name](whole)
    changed = tmp_path / f"edited-{name}"
    changed.write_bytes(edited(whole.read_bytes(), edits))
    ends_well(changed)


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(edits=st.lists(EDIT, min_size=1, max_size=6))
def test_edited_aedat4(tmp_path: Path, edits: list[tuple[str, float, bytes]]):
    whole = DATA / "readers" / "dvxplorer.aedat4"
    if not whole.is_file():
        pytest.skip(f"no recordings at {DATA}; set EBARF_TEST_DATA to their folder")
    changed = tmp_path / "edited.aedat4"
    # Only header and first packets, since a whole sample takes a second.
    changed.write_bytes(edited(whole.read_bytes()[:60_000], edits))
    ends_well(changed)


@pytest.mark.parametrize("known", FORMATS)
@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.binary(max_size=400))
def test_noise(tmp_path: Path, known: RecordingFormat, content: bytes):
    path = tmp_path / "noise"
    path.write_bytes(content)
    ends_well(path, known)


@pytest.mark.parametrize("name", SINGLE)
@pytest.mark.parametrize("known", FORMATS)
def test_one_format_taken_for_another(tmp_path: Path, name: str, known: RecordingFormat):
    ends_well(MADE[name](tmp_path / name), known)
