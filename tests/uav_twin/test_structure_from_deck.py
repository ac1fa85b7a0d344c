"""`uav-twin structure from-deck` as a user calls it: shipped decks, refusals, and a mission."""

import json
import shutil
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy.validation import validate_fmu

from tests.calculix_decks import needs_calculix
from tests.command_line import refused, said
from twin_master.scenario.reading import LoadedScenario, parse_scenario
from uav_twin import fly, open_run

DECKS = Path(__file__).parents[2] / "docs" / "how_to" / "decks"
OPTIONS = {
    "stiffened_skin": ("--region", "BAY", "--output", "TIP:z"),
    "bolted_joint": ("--region", "JOINT", "--output", "GAUGE_JOINT"),
}


@pytest.fixture(scope="session")
def decks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the shipped decks and missions."""
    return Path(shutil.copytree(DECKS, tmp_path_factory.mktemp("decks") / "decks"))


@pytest.fixture(scope="session")
def skin_report(decks: Path) -> str:
    """What the command prints of the stiffened skin, whose structure it writes beside the deck."""
    deck = decks / "stiffened_skin.inp"
    return said("structure", "from-deck", deck, *OPTIONS["stiffened_skin"])


@pytest.fixture(scope="session")
def joint_record(decks: Path) -> dict[str, Any]:
    """What the command prints of the bolted joint as data."""
    deck = decks / "bolted_joint.inp"
    words = ("structure", "from-deck", deck, *OPTIONS["bolted_joint"], "--json", "--quiet")
    record: dict[str, Any] = json.loads(said(*words))
    return record


@needs_calculix
def test_the_stiffened_skin_agrees_with_calculix(skin_report):
    rows = [line.split() for line in skin_report.splitlines() if "1e-05" in line]
    deviations = [float(row[-2]) for row in rows]
    assert [row[0] for row in rows] == ["displacements", "displacements", "6"]
    assert max(deviations) < 2e-6


@needs_calculix
def test_the_bolted_joint_agrees_with_calculix(joint_record):
    assert joint_record["displacement_deviation"]["force"] < 2e-6
    assert joint_record["frequency_deviation"] < 2e-6
    assert joint_record["frequencies"][0] == pytest.approx(417.4, abs=0.1)


@needs_calculix
def test_a_tie_is_said_to_hold_in_tension(joint_record):
    assert joint_record["regions"] == {"z_joint": 10}
    assert joint_record["remarks"] == ["surfaces that are tied stay together, also in tension and shear"]


@needs_calculix
def test_the_structure_stands_beside_the_deck(decks, skin_report):
    folder = decks / "stiffened_skin"
    assert f"{folder / 'stiffened_skin.toml'}: 610 unknowns" in skin_report
    assert "region z_bay: 8 elements of BAY" in skin_report
    files = {path.name for path in folder.iterdir()}
    assert files == {
        "stiffened_skin.toml",
        "stiffness.npz",
        "mass.npz",
        "unknowns.dof",
        "z_bay.npz",
        "force.txt",
        "gravity.npy",
        "tip_z.txt",
    }


@needs_calculix
def test_info_reads_the_structure_with_its_gauge(decks, joint_record):
    text = said("structure", "info", joint_record["structure"], "--modes", "1")
    assert "gauge_joint" in text


@needs_calculix
def test_a_second_conversion_is_refused(decks, skin_report):
    sentence = refused("structure", "from-deck", decks / "stiffened_skin.inp")
    assert "stiffened_skin exists and is not an empty folder: choose another --out." in sentence


def skin_deck(*changes: tuple[str, str]) -> str:
    """Return the deck of the stiffened skin in which pieces are exchanged."""
    text = (DECKS / "stiffened_skin.inp").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text


ELASTIC = "*ELASTIC\n70000., 0.33\n"


@needs_calculix
@pytest.mark.parametrize(
    ("text", "words", "sentence"),
    [
        ("", (), "deck.inp: a deck with *NODE, *ELEMENT and *MATERIAL is expected, but it has no keyword."),
        ("** a comment\n", (), "but it has no keyword."),
        (
            skin_deck((ELASTIC, "")),
            (),
            "deck.inp: a material with *ELASTIC is expected, but the deck has none;",
        ),
        (
            skin_deck((ELASTIC, "*CONDUCTIVITY\n50.\n")),
            (),
            "a material with *ELASTIC is expected, but the deck has *CONDUCTIVITY;",
        ),
        (
            skin_deck(("ROOT, 1, 6", "ROOT, 3, 3")),
            (),
            "before its matrices are written (in a deck: *BOUNDARY).",
        ),
        (
            skin_deck(),
            ("--region", "WING"),
            "deck.inp: a set of elements is expected as --region, but there is no WING; there are BAY, ",
        ),
        (skin_deck(), ("--region", "BAY", "--region", "EVERYTHING"), "BAY and EVERYTHING share elements."),
        (skin_deck(), ("--output", "ROOT"), "--output ROOT: a set with nodes that can move is expected"),
        (skin_deck(), ("--output", "TIP:q"), "--output TIP:q: a set of nodes is expected"),
        (
            skin_deck(("9810., 0., 0., -1.", "9810., 0., 0., 0.")),
            (),
            "gravity needs a direction, but its three components are zero.",
        ),
        (
            skin_deck((ELASTIC, f"{ELASTIC}*MPC\nplane,1,2,3,4\n")),
            (),
            "*MPC PLANE keeps nodes in one plane, whose direction changes with their motion, and cannot",
        ),
        (skin_deck(), ("--tolerance", "1e-9"), "the matrices and CalculiX must agree to 1e-09, but the"),
    ],
    ids=[
        "empty",
        "comment",
        "no elastic",
        "conductivity",
        "mechanism",
        "unknown region",
        "regions overlap",
        "held output",
        "unknown axis",
        "gravity without direction",
        "nonlinear constraint",
        "deviation",
    ],
)
def test_a_refused_deck_leaves_nothing(tmp_path, text, words, sentence):
    deck = tmp_path / "deck.inp"
    deck.write_text(text)
    assert sentence in refused("structure", "from-deck", deck, *words, "--quiet")
    assert list(tmp_path.iterdir()) == [deck]


@needs_calculix
def test_a_missing_deck_is_refused(tmp_path):
    sentence = refused("structure", "from-deck", tmp_path / "deck.inp")
    assert "deck.inp cannot be read: No such file or directory." in sentence
    assert list(tmp_path.iterdir()) == []


def test_without_calculix_one_sentence_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", "")
    sentence = refused("structure", "from-deck", DECKS / "bolted_joint.inp", "--out", tmp_path / "joint")
    assert "is not installed; on Debian and Ubuntu: apt-get install calculix-ccx." in sentence
    assert list(tmp_path.iterdir()) == []


@needs_calculix
def test_the_structure_becomes_an_fmu_in_which_fmpy_finds_nothing(decks, skin_report, tmp_path):
    target = tmp_path / "skin.fmu"
    file = decks / "stiffened_skin" / "stiffened_skin.toml"
    said("structure", "fmu", file, "--out", target, "--kind", "python")
    assert validate_fmu(str(target)) == []


@needs_calculix
def test_the_shipped_mission_flies_and_finds_the_crack(decks, skin_report, tmp_path):
    """Half of the flights of the mission; the bay loses 5 % in each from the third on."""
    mission = tomllib.loads((decks / "stiffened_skin_mission.toml").read_text())
    mission["mission"]["steps"] = 6
    mission["mission"]["prediction_steps"] = 1
    mission["truth"]["gains"][0]["last_step"] = 6
    loaded = LoadedScenario(
        parse_scenario(mission, "mission"), decks / "stiffened_skin_mission.toml", "0" * 64
    )
    tree = open_run(fly(loaded, tmp_path / "run", report=False).folder)
    loss = tree["truth"]["state"].values[-1]
    assert loss > 0.1
    np.testing.assert_allclose(tree["filtered"]["mean"].values[-1], loss, atol=0.1)
