import json
from pathlib import Path

from tests.conftest import run_ok


def test_reading_is_measured_beside_other_libraries(tmp_path: Path):
    output = tmp_path / "recordings.json"
    run_ok("ebarf", "bench", "recordings", "--events", 50_000, "--huge", 60_000, "--output", output)
    figures = {figure["what"]: figure for figure in json.loads(output.read_text())["figures"]}
    ours = [name for name in figures if name.endswith("into a scene")]
    assert {name.split(",")[0] for name in ours} == {"hdf5", "evt3", "aedat4", "bag", "text"}
    assert all(figure["value"] > 0 for figure in figures.values())
    assert any("h5py" in name for name in figures) and any("memory" in name for name in figures)
