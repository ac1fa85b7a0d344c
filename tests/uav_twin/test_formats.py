"""The formats of files: their JSON Schemas, their pages and the command that prints them."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from discrepancy.campaign.schema import parse_campaign
from discrepancy.catalogue.effect_file import effects_of_file
from discrepancy.errors import CampaignFileError, CatalogueError, ModelError
from discrepancy.system.lumped_file import LumpedDescription
from fe.runtime.errors import InvalidDesignError
from fe.structure.design import parse_structure
from fe.wing.design import parse_design
from fmu_asset.client.binding import parse_binding
from fmu_asset.errors import BindingError
from reporting.formats.tables import markdown_of_format, undocumented_keys
from scenarios import binding_files, scenario_files, structure_files
from tests import command_line
from tests.costs import once
from tests.refusals import refused
from twin_master.errors import ScenarioError
from twin_master.scenario.reading import parse_scenario
from uav_twin.cli import app
from uav_twin.formats import FORMATS, schema_line

ROOT = Path(__file__).parents[2]
SHIPPED = {
    "scenario": [*scenario_files().values()],
    "binding": [*binding_files().values()],
    "structure": [*structure_files().values()],
    "wing": [*(ROOT / "fe" / "designs").glob("*.toml")],
    "lumped-model": [*(ROOT / "discrepancy").glob("lumped_models/*.toml")],
    "effects": [*(ROOT / "discrepancy" / "catalogue").glob("[!r]*.toml")],
}
"""The shipped files of each format, whose first line names the schema."""
FILES = {
    **SHIPPED,
    "campaign": [
        ROOT / f"discrepancy/sources/rigs/{name}/campaign.toml" for name in ("pendulum", "two_tanks")
    ],
    "fmu-model": [
        ROOT / "tests" / "discrepancy" / "system" / "inputs" / f"{name}.toml" for name in ("console", "wing")
    ],
}


def content_of(path):
    """Return the content of a TOML file."""
    return tomllib.loads(path.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", FORMATS)
def test_every_key_of_a_format_has_a_description_and_every_number_a_unit(name):
    assert undocumented_keys(FORMATS[name].schema()) == []


def test_a_table_of_keys_has_no_column_that_is_empty():
    schema = {
        "properties": {
            "name": {"type": "string", "description": "Name of the part."},
            "mass": {"type": "number", "unit": "kg", "description": "Its mass."},
        }
    }
    header, _, name, mass = markdown_of_format(schema, "toml").strip().splitlines()[-4:]
    assert header == "| key | meaning | type | unit |"
    assert name == "| `name` | Name of the part. | text |   |"
    assert mass == "| `mass` | Its mass. | number | kg |"


def test_a_key_that_means_the_same_in_several_kinds_of_a_table_is_printed_once():
    port = {"type": "string", "description": "Name of the port."}
    kinds = {
        "spring": {"port": port, "size": {"type": "number", "unit": "N/m", "description": "Stiffness."}},
        "damper": {"port": port, "size": {"type": "number", "unit": "N s/m", "description": "Damping."}},
    }
    tables = [
        {"description": f"A {name}.", "properties": {"kind": {"const": name}, **keys}}
        for name, keys in kinds.items()
    ]
    schema = {"properties": {"law": {"oneOf": tables, "description": "The law."}}}
    lines = markdown_of_format(schema, "toml").splitlines()
    assert lines[4] == "| `law` | The law. | [table](#law) |"
    assert [line for line in lines if "spring" in line] == [
        "| `spring` | A spring. | `port`, `size` [N/m] |",
        "| `size` of `spring` | Stiffness. | number |",
    ]
    assert [line for line in lines if "Name of the port" in line] == ["| `port` | Name of the port. | text |"]


def test_schemas_and_pages_are_those_of_the_classes():
    """If this fails: python -m benchmarks.format_pages."""
    # in a process of its own, since pydantic reads the texts below fields when a class is defined
    command = [sys.executable, "-m", "benchmarks.format_pages", "--check"]
    outcome = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (outcome.returncode, outcome.stderr) == (0, "")


@once
def validator(name: str) -> Any:
    """Return the validator of a format, whose schema is a valid one."""
    jsonschema = pytest.importorskip("jsonschema")
    schema = FORMATS[name].schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize(("name", "path"), [(name, path) for name in FILES for path in FILES[name]])
def test_shipped_files_fit_their_schemas(name, path):
    jsonschema = pytest.importorskip("jsonschema")
    content = content_of(path)
    validator(name).validate(content)
    with pytest.raises(jsonschema.ValidationError, match="no_such_key"):
        validator(name).validate({**content, "no_such_key": 1})


@pytest.mark.parametrize(("name", "path"), [(name, path) for name in SHIPPED for path in SHIPPED[name]])
def test_shipped_files_name_their_schemas_to_editors(name, path):
    directive, _, target = path.read_text(encoding="utf-8").partition("\n")[0].partition(" ")
    assert directive == "#:schema"
    assert (path.parent / target).resolve() == FORMATS[name].schema_file


def schema_command(*words: object) -> Any:
    """Return the result of the command that prints schemas."""
    return CliRunner().invoke(app, ["schema", *map(str, words)])


def test_the_command_lists_formats():
    lines = schema_command().stdout.splitlines()
    assert [line.split()[0] for line in lines] == list(FORMATS)
    assert json.loads(schema_command("--json").stdout).keys() == FORMATS.keys()


def test_the_command_prints_a_schema():
    assert json.loads(schema_command("campaign").stdout) == FORMATS["campaign"].schema()


def test_the_command_writes_a_schema(tmp_path):
    out = tmp_path / "campaign.schema.json"
    message = schema_command("campaign", "--out", out).stdout
    assert out.read_text(encoding="utf-8") == schema_command("campaign").stdout
    assert "#:schema ./campaign.schema.json" in message


def test_the_list_of_formats_is_not_written(tmp_path):
    assert schema_command("--out", tmp_path / "campaign.schema.json").exit_code == 2


def test_an_unknown_format_is_refused_with_the_nearest_one():
    sentence = command_line.refused("schema", "campaigns")

    assert sentence.startswith("There is no format 'campaigns'; the formats are scenario, fleet,")
    assert sentence.endswith("Did you mean `campaign`?")


def test_the_line_for_editors_names_a_shipped_file():
    directive, _, uri = schema_line("binding").strip().partition(" ")
    assert directive == "#:schema"
    assert Path(uri.removeprefix("file://")) == FORMATS["binding"].schema_file


def read_binding(content, source):
    """Return the binding in the content of a file."""
    return parse_binding(content, where=source)


SCENARIO = scenario_files()["level_turns"]
CHAIN = ROOT / "discrepancy" / "lumped_models" / "three_mass_chain.toml"
TANKS = ROOT / "discrepancy" / "sources" / "rigs" / "two_tanks" / "campaign.toml"
READERS = {
    "scenario": (parse_scenario, SCENARIO, ScenarioError),
    "wing": (parse_design, ROOT / "fe" / "designs" / "uav_wing.toml", InvalidDesignError),
    "structure": (parse_structure, structure_files()["bracket"], InvalidDesignError),
    "binding": (read_binding, binding_files()["uav_wing"], BindingError),
    "lumped-model": (LumpedDescription.parse, CHAIN, ModelError),
    "campaign": (parse_campaign, TANKS, CampaignFileError),
}
"""The reader of a format, a good file, and the error that it raises."""


@pytest.mark.parametrize(
    ("name", "place", "wrong", "nearest"),
    [
        ("scenario", ("mission",), "stepps", "steps"),
        ("scenario", ("state", 0), "levels_precent", "levels_percent"),
        ("wing", ("planform",), "semispan", "semi_span"),
        ("structure", ("material", 0), "young_modulos", "young_modulus"),
        ("binding", ("binding",), "step_sise", "step_size"),
        ("lumped-model", ("output", 0), "quantty", "quantity"),
        ("campaign", ("trial", 0), "held_aut", "held_out"),
    ],
)
def test_a_misspelt_key_is_refused_with_the_nearest_one(name, place, wrong, nearest):
    parse, path, error = READERS[name]
    content = content_of(path)
    table = content
    for step in place:
        table = table[step]
    table[wrong] = 1
    with refused(error, rf"{wrong}.*; the nearest is `{nearest}`\.$"):
        parse(content, "the file")


def test_a_misspelt_key_or_word_of_an_effect_is_refused_with_the_nearest_one(tmp_path):
    text = (ROOT / "discrepancy" / "catalogue" / "outflow.toml").read_text(encoding="utf-8")
    path = tmp_path / "effects.toml"
    path.write_text(text.replace("signature", "signatur", 1), encoding="utf-8")
    with refused(CatalogueError, r"'signatur' is not a key of an effect; the nearest is `signature`\.$"):
        effects_of_file(path)
    path.write_text(text.replace('"log_normal"', '"lognormal"', 1), encoding="utf-8")
    with refused(CatalogueError, r"'lognormal' was given; the nearest is 'log_normal'\.$"):
        effects_of_file(path)
