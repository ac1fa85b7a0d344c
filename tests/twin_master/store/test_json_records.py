"""The JSON files of a run have the keys, and no others, that their formats list."""

import json
from pathlib import Path

import pytest

from calibration.result.file import plain_record, run_record
from tests.conftest import synthetic_calibration
from twin_master.feeds.rejected import REJECTED_NAME, RejectedFile
from twin_master.mission.decision_record import decision_from_line
from twin_master.mission.journal import JOURNAL_NAME, encode_line, records
from twin_master.mission.knowledge_file import load_knowledge
from twin_master.mission.recent_parts import RECENT_NAMES
from twin_master.run_folder import read_config, read_scenario
from uav_twin import fly
from uav_twin.formats import FORMATS

jsonschema = pytest.importorskip("jsonschema")


@pytest.fixture(scope="module")
def run(library_file, tmp_path_factory):
    """Return the folder of a flown mission."""
    folder = tmp_path_factory.mktemp("run") / "run"
    return fly("growing_damage", folder, {"strain_library": library_file}, report=False).folder


def without_further_keys(schema):
    """Return a JSON Schema in which no table may have a key that it does not list."""
    if isinstance(schema, list):
        return [without_further_keys(entry) for entry in schema]
    if not isinstance(schema, dict):
        return schema
    closed = {key: without_further_keys(entry) for key, entry in schema.items()}
    return {**closed, "additionalProperties": False} if "properties" in closed else closed


def check(record, name):
    """Check a record against the JSON Schema of its format."""
    plain = json.loads(json.dumps(record))
    jsonschema.validate(plain, without_further_keys(FORMATS[name].schema()))


@pytest.mark.parametrize("name", ["summary", "config", "timing"])
def test_a_file_of_a_run_has_the_keys_of_its_format(run, name):
    check(json.loads((run / f"{name}.json").read_text(encoding="utf-8")), name)


def test_the_figures_of_a_calibration_have_the_keys_of_their_format():
    synthetic = synthetic_calibration()
    check(plain_record(synthetic), "calibration")
    check(run_record(synthetic, "young_modulus_factor"), "calibration")


@pytest.mark.parametrize(("name", "file_format"), [(JOURNAL_NAME, "journal"), (RECENT_NAMES[0], "recent")])
def test_lines_of_a_journal_have_the_keys_of_their_format(run, name, file_format):
    lines = (run / name).read_bytes().splitlines()
    assert len(lines) >= 50
    for line in lines:
        check(json.loads(line[65:]), file_format)


def test_the_first_line_of_a_journal_has_its_format(run):
    header = (run / JOURNAL_NAME).read_bytes().splitlines(keepends=True)[0]
    record = json.loads(header[65:])
    assert encode_line(record) == header
    assert record.keys() == {"config_hash", "format"}


def test_a_decision_has_the_keys_of_its_format(run):
    scenario = read_scenario(run)
    model = load_knowledge(run, scenario).model
    for line in records(run / JOURNAL_NAME):
        check(decision_from_line(line.record, scenario, model), "decision")


def test_a_refused_message_has_the_keys_of_its_format(tmp_path: Path):
    RejectedFile(tmp_path / REJECTED_NAME).append(3, "it has no step", "{}")
    check(json.loads((tmp_path / REJECTED_NAME).read_text(encoding="utf-8")), "rejected")


def test_what_a_publisher_may_send_fits_the_format_of_messages():
    message = {"step": 12, "control": "3g", "strain_1_microstrain": 812.5, "strain_2_microstrain": None}
    jsonschema.validate(message, FORMATS["message"].schema())
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({"step": "twelve"}, FORMATS["message"].schema())


def test_a_changed_configuration_is_found(run):
    with pytest.raises(jsonschema.ValidationError, match="unexpected"):
        check({**read_config(run), "further": 1}, "config")
