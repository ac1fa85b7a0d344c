"""`uav-twin init rig`: measurements of a rig, and the model that is compared with them."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from discrepancy.campaign.importing import LaboratoryImport
from discrepancy.campaign.sheet import read_sheets
from discrepancy.campaign.writing import write_campaign
from discrepancy.catalogue.entry import Setting
from discrepancy.catalogue.library import effect_by_identifier, load_catalogue
from discrepancy.model_choice import choose_model
from discrepancy.sources.examples import example_campaign, usual_plan, write_example
from uav_twin.formats import schema_line
from uav_twin.projects.project import Project, filled_in, rounded_to

MODEL_NAME = "model.toml"
CAMPAIGN_FOLDER = "measured"
_OUTPUT = "x"
"""The model's name of what the sensor measures."""
_HZ = 5.0
"""Natural frequency of the rig without a file of the user [Hz]."""
_FRICTION_RATIO = 0.02
"""Friction that is hidden in the measurements of that rig, as a share of the elastic force."""

_MEANINGS = {
    "": {
        "format": "the version of this format",
        "name": "the title of the campaign",
        "force_unit": "the unit of the column `force` of all tables",
        "reference_temperature": "°C, at which the model holds",
        "remarks": "Sentences for people.",
        "provenance": "Where the tables come from.",
    },
    "noise": {
        "file": "samples of all channels at rest, before the first trial",
        "interval": "s between two samples",
    },
    "channel": {
        "name": "what measures; the name of its column in the tables",
        "quantity": "what it measures",
        "unit": "of its column",
        "output": "the output of model.toml that it is compared with",
        "gain_deviation": "how well its gain is known: standard deviation, as a fraction",
        "offset_deviation": "how well its zero is known: standard deviation, in its unit",
    },
    "channel.noise": {
        "standard_deviation": "of a reading at rest, in the unit of the channel",
        "degrees_of_freedom": "how well it is known, as a number of readings",
        "source": "where it is from",
    },
    "trial": {
        "name": "what was done once",
        "kind": "released and left to ring down",
        "file": "its table: time in s, then the channels",
        "run": "trials of one set-up have one run",
        "load_place": "the place or input of model.toml at which it was held",
        "release": "m at the release, and how well it is known as a fraction",
        "start": "s since the first trial, by the clock of the laboratory",
        "held_out": "not fitted: it proves what was found",
    },
}
"""What each key of the campaign means, by its table, as a comment where it stands first."""


def rig_project(name: str, ring_down: Path | None) -> Project:
    """Return the project of a rig, from a ring-down or from a simulated mass with friction.

    Parameters
    ----------
    ring_down : Path or None
        A CSV file whose first column is time and whose second one is a displacement.

    Raises
    ------
    CampaignFileError, CampaignDataError
        If the table cannot be read as a ring-down.
    """
    with TemporaryDirectory(prefix="uav_twin_") as temporary_folder:
        folder = Path(temporary_folder)
        frequency = _HZ if ring_down is None else _frequency_of(ring_down)
        model_text = filled_in(
            "model.toml",
            schema="lumped-model",
            name=name,
            output=_OUTPUT,
            stiffness=rounded_to((2.0 * np.pi * frequency) ** 2, 4),
            frequency=rounded_to(frequency, 3),
        )
        model_file = folder / MODEL_NAME
        model_file.write_text(model_text, encoding="utf-8")
        campaign_folder = folder / CAMPAIGN_FOLDER
        if ring_down is None:
            _write_simulated_campaign(model_file, campaign_folder)
        else:
            _write_campaign_of(ring_down, model_file, campaign_folder, name)
        texts = {MODEL_NAME: model_text}
        for path in sorted(campaign_folder.iterdir()):
            text = path.read_text(encoding="utf-8")
            if path.name == "campaign.toml":
                text = _with_comments(text)
            texts[f"{CAMPAIGN_FOLDER}/{path.name}"] = text
    return Project(
        title="Measurements of a rig, and the model that is compared with them.",
        texts=texts,
        files={
            f"{CAMPAIGN_FOLDER}/": "the measurements; campaign.toml says how they were made",
            MODEL_NAME: "what the rig is believed to be: masses, springs, what is uncertain",
        },
        commands=(
            (
                f"uav-twin discrepancy check {CAMPAIGN_FOLDER} --model {MODEL_NAME}",
                "See from which size on an effect can be found in these measurements.",
            ),
            (
                f"uav-twin discrepancy run {CAMPAIGN_FOLDER} --model {MODEL_NAME} --out verdict",
                "Find what the model lacks; the report is verdict/report.html.",
            ),
            (
                "uav-twin discrepancy effects",
                "List the effects that can be named.",
            ),
            (
                "uav-twin discrepancy effects --show coulomb_friction",
                "Read what one of them is, and how it is told from others.",
            ),
            (
                f"uav-twin calibrate campaign {CAMPAIGN_FOLDER} --model {MODEL_NAME} "
                "--out calibrated",
                "Estimate the parameters of the model, where it lacks nothing.",
            ),
        ),
    )


def _with_comments(campaign: str) -> str:
    """Return the text of a campaign file with a schema line and comments.

    A comment tells the meaning of a key where it first occurs in a table.
    """
    lines = [
        schema_line("campaign").rstrip("\n"),
        "# What was measured, and how. Further records stand beside this file, each a [[trial]].",
    ]
    unexplained = {table: dict(meanings) for table, meanings in _MEANINGS.items()}
    table = ""
    for line in campaign.splitlines():
        if line.startswith("#:schema"):
            continue
        if line.startswith("["):
            table = line.strip("[]")
        meaning = unexplained[table].pop(line.partition(" = ")[0], None)
        if meaning is None:
            lines.append(line)
        elif line.endswith("["):  # a list over several lines
            lines += [f"# {meaning}", line]
        else:
            lines.append(f"{line}  # {meaning}")
    return "\n".join([*lines, ""])


def _write_simulated_campaign(model_file: Path, folder: Path) -> None:
    """Write a campaign of simulated ring-downs of the model, with friction hidden at its slide."""
    model = choose_model(str(model_file)).model
    plan = usual_plan(model)
    plan = replace(plan, duration=0.5 * plan.duration)
    plain_campaign = example_campaign(model, "ringdown", 1, plan)
    setting = Setting(plain_campaign, model, model.scales(plain_campaign))
    friction = effect_by_identifier("coulomb_friction", load_catalogue())
    patch = friction.patch(
        setting, {"friction_ratio": _FRICTION_RATIO}, friction.places(setting)[0]
    )
    write_example(model, folder, "ringdown", 1, plan, patch)


def _frequency_of(ring_down: Path) -> float:
    """Return the frequency [Hz] of the largest spectral peak of the second column."""
    sheet = read_sheets(ring_down)[0]
    time, displacement = (np.array(sheet.columns[column], dtype=np.float64) for column in (0, 1))
    spectrum = np.abs(np.fft.rfft(displacement - displacement.mean()))
    frequencies = np.fft.rfftfreq(len(time), float(np.median(np.diff(time))))
    return float(frequencies[1 + np.argmax(spectrum[1:])])


def _write_campaign_of(ring_down: Path, model_file: Path, folder: Path, name: str) -> None:
    """Write the campaign of a ring-down, whose second column measures the model's output."""
    model = choose_model(str(model_file)).model
    sheets = read_sheets(ring_down)
    release = f"{float(sheets[0].columns[1][0]):g}{sheets[0].units[1]}"
    answers = {"kind": {"": "ringdown"}, "release": {"": release}}
    imported = LaboratoryImport(
        sheets, answers, model.output_quantity, model.outputs_with_quantities
    )
    write_campaign(
        imported.campaign(name),
        folder,
        si=True,
        units=imported.units(),
        left_out_as_empty=True,
    )
