"""The formats of all files that users write or read, each with the class that describes it."""

import json
from dataclasses import dataclass
from pathlib import Path

from reporting.choices import did_you_mean
from reporting.errors import InvalidChoiceError
from reporting.formats.tables import Notation
from reporting.json_file import JsonObject

SCHEMA_FOLDER = Path(__file__).with_name("schemas")
"""The folder of the JSON Schemas that are shipped, for editors."""


@dataclass(frozen=True)
class FileFormat:
    """A format of files.

    Attributes
    ----------
    name : str
        The name of the format on the command line.
    title : str
        What a file of it is, for people.
    sources : tuple of str
        The classes that describe it, `module:name`, of which a file is one; or the one function
        that returns its JSON Schema.
    notation : {"toml", "json"}
        The language of its files.
    page : str
        The page that explains it, relative to `docs`.
    """

    name: str
    title: str
    sources: tuple[str, ...]
    notation: Notation
    page: str

    @property
    def schema_file(self) -> Path:
        """The file with the JSON Schema, which `benchmarks.format_pages` makes from the classes."""
        return SCHEMA_FOLDER / f"{self.name}.schema.json"

    def schema_text(self) -> str:
        """Return the JSON Schema of the format as text."""
        return self.schema_file.read_text(encoding="utf-8")

    def schema(self) -> JsonObject:
        """Return the JSON Schema of the format."""
        schema: JsonObject = json.loads(self.schema_text())
        return schema


def _toml(name: str, title: str, page: str, *models: str) -> FileFormat:
    """Return a format of TOML files."""
    return FileFormat(name, title, models, "toml", page)


def _json(name: str, title: str, page: str, *models: str) -> FileFormat:
    """Return a format of JSON files or messages."""
    return FileFormat(name, title, models, "json", page)


_RECORDS = "twin_master.json_records"
_FORMATS = (
    _toml("scenario", "scenario", "how_to/scenarios.md", "twin_master.scenario.schema:Scenario"),
    _toml("fleet", "fleet", "how_to/fleets.md", "twin_master.fleet.plan:FleetFile"),
    _toml(
        "learnt",
        "what a fleet has learnt, `learnt.toml`",
        "how_to/fleets.md",
        "twin_master.assets.resolution:LearntFile",
    ),
    _toml("binding", "binding of an FMU", "reference/fmu.md", "fmu_asset.client.binding:Binding"),
    _toml("wing", "wing design", "how_to/calibrate_a_wing.md", "fe.wing.design:WingDesign"),
    _toml(
        "structure",
        "structure from a mesh or matrices",
        "how_to/structures.md",
        "fe.structure.design:MeshDesign",
        "fe.structure.matrix_design:MatrixDesign",
    ),
    _toml(
        "campaign",
        "measurement campaign, `campaign.toml`",
        "reference/campaign.md",
        "discrepancy.campaign.schema:CampaignSection",
    ),
    _toml(
        "lumped-model",
        "lumped model",
        "how_to/lumped_models.md",
        "discrepancy.system.lumped_file:LumpedDescription",
    ),
    _toml(
        "fmu-model",
        "FMU as the model of a campaign",
        "how_to/fmu_models.md",
        "discrepancy.fmu_models.description:FmuModelDescription",
    ),
    _toml(
        "effects",
        "file of effects",
        "how_to/add/effect.md",
        "discrepancy.catalogue.effect_in_setting:EffectSection",
        "discrepancy.catalogue.effect_in_setting:EffectsFile",
    ),
    _json(
        "patch",
        "patch, `patch.json`",
        "reference/verdict.md",
        "discrepancy.files.verdict:patch_schema",
    ),
    _json(
        "verdict",
        "verdict, `verdict.json`",
        "reference/verdict.md",
        "discrepancy.files.verdict:verdict_schema",
    ),
    _json(
        "verdict-so-far",
        "results of an interrupted search, `verdict_so_far.json`",
        "reference/verdict.md",
        "discrepancy.verdict_so_far:so_far_schema",
    ),
    _json(
        "self-calibration",
        "results on simulated campaigns, `self_calibration.json`",
        "how_to/discrepancy.md",
        "discrepancy.self_calibration_file:self_calibration_schema",
    ),
    _json(
        "calibration",
        "figures of a calibration, `calibration.json`",
        "how_to/calibrate_a_wing.md",
        "calibration.result.json_record:CalibrationRecord",
    ),
    _json("message", "message to a watch", "how_to/watch.md", f"{_RECORDS}:ObservationMessage"),
    _json("decision", "decision of a watch", "how_to/watch.md", f"{_RECORDS}:DecisionRecord"),
    _json("heartbeat", "heartbeat of a watch", "how_to/watch.md", f"{_RECORDS}:HeartbeatRecord"),
    _json(
        "rejected",
        "line of `rejected.jsonl`",
        "how_to/watch.md",
        f"{_RECORDS}:RejectedRecord",
    ),
    _json(
        "journal", "line of `journal.jsonl`", "reference/run_folder.md", f"{_RECORDS}:JournalRecord"
    ),
    _json(
        "recent",
        "line of `recent_0.jsonl` or `recent_1.jsonl`",
        "reference/run_folder.md",
        f"{_RECORDS}:RecentRecord",
    ),
    _json(
        "summary",
        "summary of a run, `summary.json`",
        "reference/run_folder.md",
        f"{_RECORDS}:SummaryRecord",
    ),
    _json(
        "config",
        "configuration of a run, `config.json`",
        "reference/run_folder.md",
        f"{_RECORDS}:ConfigRecord",
    ),
    _json(
        "timing",
        "times of a run, `timing.json`",
        "reference/run_folder.md",
        f"{_RECORDS}:TimingRecord",
    ),
)
FORMATS = {file_format.name: file_format for file_format in _FORMATS}
"""All formats by their names."""


def schema_line(name: str) -> str:
    """Return the first line of a TOML file that names the shipped schema of a format to editors."""
    return f"#:schema {FORMATS[name].schema_file.as_uri()}\n"


def find_format(name: str) -> FileFormat:
    """Return the format with a name.

    Raises
    ------
    InvalidChoiceError
        If there is no such format; the message lists all of them.
    """
    if name not in FORMATS:
        raise InvalidChoiceError(
            f"There is no format {name!r}; the formats are {', '.join(FORMATS)}."
            f"{did_you_mean(name, FORMATS)}"
        )
    return FORMATS[name]
