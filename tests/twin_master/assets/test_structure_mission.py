"""A structure from a mesh as the asset of a mission and as what the twin believes."""

from __future__ import annotations

import re
import shutil
import tomllib
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

from fe.full.factorisation import Factorisation, lowest_eigenpairs
from fe.runtime.errors import FiniteElementError
from fe.structure.operators import load_and_assemble
from scenarios import scenario_files, structure_files
from tests.twin_master.runs import check_same, cut_off_after
from twin_master.errors import TwinMasterError
from twin_master.scenario.reading import LoadedScenario, parse_scenario
from twin_master.store.writing import read_run
from twin_master.workflow import fly as new_run
from twin_master.workflow import resume as resume_run

PATH = scenario_files()["bracket"]


TABLE = tomllib.loads(PATH.read_text(encoding="utf-8"))
BEYOND = {"state": "z_heel", "first_step": 2, "last_step": 6, "gain_percent": 30}


def high(table: str, key: str, value: Any) -> dict[str, Any]:
    """The list of states or controls, one key of the first changed."""
    return {"": [TABLE[table][0] | {key: value}, *TABLE[table][1:]]}


def short(**changes: dict[str, Any]) -> LoadedScenario:
    """The shipped mission of the bracket in ten shifts; `changes` by table, None for a key that goes."""
    table = tomllib.loads(PATH.read_text(encoding="utf-8"))
    table["mission"] |= {"steps": 10, "prediction_steps": 3}
    table["asset"] |= {"isolated": False}
    table["truth"]["gains"] = [{"state": "z_heel", "first_step": 2, "last_step": 3, "gain_percent": 20}]
    for name, values in changes.items():
        if "" in values:
            table[name] = values[""]
            continue
        table[name] |= values
        table[name] = {key: value for key, value in table[name].items() if value is not None}
    return LoadedScenario(parse_scenario(table, "short"), PATH, "0" * 64)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its run folder."""
    return new_run(short(), tmp_path_factory.mktemp("bracket") / "run", report=False).folder


def test_the_twin_finds_the_damage_of_the_full_model(flown: Path) -> None:
    """The strains flown are those of the full model within their bound; the heel is accused, not the arm."""
    tree = read_run(flown)
    structure = load_and_assemble(structure_files()["bracket"])
    unit = structure.load("weight", 1.0)
    truth, observed = tree["truth"], tree["observed"]
    for step in (0, 9):
        losses = dict(zip(structure.regions, truth["state"].values[step].tolist(), strict=True))
        full = Factorisation(structure.stiffness({"e": 1.02}, losses)).solve(unit)
        wanted = float(observed["load_factor"][step]) * (structure.gauge_output @ full)
        bound = float(truth["strain_error_bound"][step])
        assert np.abs(truth["strain"].values[step] - wanted).max() <= bound < 1e-3 * np.abs(wanted).max()
    np.testing.assert_allclose(truth["state"].values[-1], [0.4, 0.0], atol=1e-12)
    np.testing.assert_allclose(tree["filtered"]["mean"].values[-1], [0.4, 0.0], atol=0.1)


@pytest.mark.parametrize("between", [True, False])
def test_damage_between_two_levels_does_not_condemn_a_sound_region(tmp_path: Path, between: bool) -> None:
    """The heel stands at 70 %, half way between two levels, and the gauge of the arm is lost.

    A twin that takes it to be at a level believes with certainty that the arm has lost 80 %.
    """
    coarse = {"levels_percent": [0, 20, 40, 60, 80], "prior": [1, 0, 0, 0, 0]}
    loaded = short(
        state={"": [factor | coarse for factor in TABLE["state"]]},
        observation={"standard_deviation_microstrain": 3, "between_levels": between},
        transition={"probability": {"smooth": 0.02, "rough": 0.08}},
        truth={
            "gains": [{"state": "z_heel", "first_step": 1, "last_step": 5, "gain_percent": 14}],
            "noise": {"standard_deviation_microstrain": 3},
            "sensor_faults": [{"kind": "dropout", "sensors": [2], "first_step": 0}],
        },
    )
    folder = new_run(loaded, tmp_path / "run", report=False).folder
    probability = read_run(folder)["filtered"]["probability"].values.reshape(-1, 5, 5)
    sound = probability[-3:, :, 0].sum(axis=1)
    assert np.all(sound > 0.4) if between else np.all(sound < 0.01)


@pytest.mark.long
def test_damage_is_found_from_frequencies_alone(tmp_path: Path) -> None:
    """Three natural frequencies in the place of gauges; those flown are the full model's."""
    seen = {
        "role": "frequency",
        "count": 3,
        "titles": ["f1", "f2", "f3"],
        "unit": "Hz",
        "standard_deviation": [0.2, 0.4, 1.2],
        "standard_deviation_microstrain": None,
    }
    rewards = {"health_limit": 100.0, "error_scale": 1.0}
    rewards |= dict.fromkeys(("health_limit_microstrain", "error_scale_microstrain"))
    noise = {"truth": {"noise": {"standard_deviation": [0.2, 0.4, 1.2]}}}
    flown = new_run(short(observation=seen, rewards=rewards, **noise), tmp_path / "run", report=False).folder
    tree = read_run(flown)
    assert tree["truth"]["frequency"].attrs["units"] == "Hz"
    structure = load_and_assemble(structure_files()["bracket"])
    squares, _ = lowest_eigenpairs(structure.stiffness({"e": 1.02}, {"z_heel": 0.4}), structure.mass(), 3)
    np.testing.assert_allclose(
        tree["truth"]["frequency"].values[-1], np.sqrt(squares) / (2.0 * np.pi), rtol=2e-5
    )
    np.testing.assert_allclose(tree["filtered"]["mean"].values[-1], [0.4, 0.0], atol=0.12)
    seven = {"count": 7, "titles": [f"f{number}" for number in range(7)], "standard_deviation": 1.0}
    noise = {"truth": {"noise": {"standard_deviation": 1.0}}}
    changed = short(observation=seen | seven, rewards=rewards, **noise)
    with pytest.raises(TwinMasterError, match="first 6 frequencies, and 7 are observed"):
        new_run(changed, tmp_path / "no")


def test_a_resumed_flight_is_bit_identical_after_the_files_are_gone(flown: Path, tmp_path: Path) -> None:
    for name in ("bracket.toml", "bracket.inp"):
        shutil.copy(structure_files()["bracket"].with_name(name), tmp_path)
    own = {"structure": str(tmp_path / "bracket.toml")}
    loaded = short(asset=own, belief=own)
    with cut_off_after(4):
        new_run(loaded, tmp_path / "part", report=False)
    for name in ("bracket.toml", "bracket.inp"):
        (tmp_path / name).unlink()
    moved = tmp_path / "moved"
    (tmp_path / "part").rename(moved)
    resume_run(moved, report=False)
    check_same(moved, flown, "csv/observed.csv", "csv/estimated.csv", "csv/decisions.csv")


def test_the_field_of_the_last_estimate_is_written(flown: Path) -> None:
    """`structure.vtu` holds mesh, displacement, strain, regions and losses; no file has a wing's name."""
    field = meshio.read(flown / "structure.vtu")
    assert field.cells[0].type == "hexahedron20"
    displacement = field.point_data["displacement"]
    assert 1e-4 < np.abs(displacement).max() < 5e-3
    loss, region = field.cell_data["stiffness_loss"][0], field.cell_data["region"][0]
    assert set(np.unique(region)) == {0, 1, 2}
    assert np.all(loss[region == 0] == 0.0)
    assert 0.2 < loss[region == 1].max() < 0.6
    assert not (flown / "wing.vtu").exists()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"asset": {"structure": "nowhere.toml"}}, r"nowhere\.toml"),
        (
            {"calibration": {"parameter": "stiffness"}},
            "stiffness, which the structure bracket does not know; it knows e, pump",
        ),
        ({"calibration": {"source": "static_test"}}, "`static_test` is for wings"),
        ({"observation": {"role": "displacement"}}, "expects 4"),
        ({"observation": {"count": 3, "titles": ["a", "b", "c"]}}, "expects 3"),
        (
            {"observation": {"titles": ["arm", "heel", "tip", "back"]}},
            "has these sensors in the order heel, arm, tip, back",
        ),
        ({"asset": {"parameters": {"e": 1.0, "f": 2.0}}}, "parameter f"),
        ({"asset": {"parameters": {"e": 1.2}}}, r"parameter e is 1\.2, .* range 0\.9 to 1\.1; give"),
        ({"control": high("control", "values", {"load_factor": 30.0})}, "control smooth is 30, .* 0 to 4;"),
        (
            {"state": high("state", "levels_percent", [*range(0, 80, 10), 90])},
            r"level of z_heel is 0\.9, .* 0\.8;",
        ),
        ({"truth": {"gains": [BEYOND]}}, r"bring z_heel to 0\.9 in shift 4, .* range 0 to 0\.8"),
    ],
)
def test_what_does_not_fit_is_refused_before_a_folder_is_made(
    changes: dict[str, dict[str, Any]], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises((TwinMasterError, FiniteElementError), match=sentence):
        new_run(short(**changes), tmp_path / "run", report=False)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("table", ["asset", "belief"])
def test_a_set_that_the_mesh_does_not_have_is_refused_before_a_folder_is_made(
    table: str, tmp_path: Path
) -> None:
    """The sentence names the user's mesh, not a copy of it."""
    file = tmp_path / "mine.toml"
    shipped = structure_files()["bracket"]
    shutil.copy(shipped.with_name("bracket.inp"), tmp_path)
    file.write_text(
        shipped.read_text(encoding="utf-8").replace('set = "HEEL"', 'set = "HEAL"'), encoding="utf-8"
    )
    with pytest.raises(FiniteElementError, match=re.escape(f"{tmp_path / 'bracket.inp'} holds no set")):
        new_run(short(**{table: {"structure": str(file)}}), tmp_path / "run", report=False)
    assert not (tmp_path / "run").exists()


def test_a_mesh_that_does_not_lie_beside_its_file_is_refused(tmp_path: Path) -> None:
    text = structure_files()["bracket"].read_text(encoding="utf-8")
    shutil.copy(structure_files()["bracket"].with_name("bracket.inp"), tmp_path)
    (tmp_path / "sub").mkdir()
    file = tmp_path / "sub" / "bracket.toml"
    file.write_text(text.replace('"bracket.inp"', '"../bracket.inp"'), encoding="utf-8")
    with pytest.raises(TwinMasterError, match="does not lie beside it"):
        new_run(short(asset={"structure": str(file)}), tmp_path / "run", report=False)
