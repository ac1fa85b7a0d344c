"""The run store: bytes that depend on nothing but the mission, tables for people, whole files or none."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from reporting.errors import DamagedFileError, FileNotWrittenError
from twin_master.assets.strain_library import load_strain_library
from twin_master.assets.strain_library_source import StrainLibrarySource
from twin_master.mission.loop import fly
from twin_master.mission.preparation import prepare_knowledge
from twin_master.scenario.reading import load_scenario
from twin_master.store.mission_result import MissionResult
from twin_master.store.results import groups_of
from twin_master.store.summary import Figure
from twin_master.store.tables import tables_of
from twin_master.store.writing import read_run, store_mission, write_run, write_summary


@pytest.fixture(scope="module")
def result(library_file: Path) -> MissionResult:
    scenario = load_scenario("failing_gauges").scenario
    source = StrainLibrarySource(scenario, load_strain_library(library_file), "h")
    knowledge = prepare_knowledge(scenario, source, 3)
    truth = knowledge.truth(3)
    flight = fly(scenario, knowledge.twin(), knowledge.plant(truth, source.open()))
    return MissionResult(scenario, knowledge, flight, truth)


def test_the_file_reads_back_and_its_bytes_depend_on_the_tree_alone(
    result: MissionResult, tmp_path: Path
) -> None:
    groups = groups_of(result)
    first = write_run(tmp_path / "a", groups, {"seed": 3}).read_bytes()
    assert write_run(tmp_path / "b", groups_of(result), {"seed": 3}).read_bytes() == first
    assert write_run(tmp_path / "c", groups_of(result), {"seed": 4}).read_bytes() != first
    read, predicted = read_run(tmp_path / "a"), groups["predicted"]
    assert {*predicted.variables, *predicted.coords} == set(read["predicted"].to_dataset().variables)
    for name, variable in {**predicted.variables, **predicted.coords}.items():
        found = read["predicted"][name]
        np.testing.assert_array_equal(found, variable.values)
        assert (found.dims, found.attrs) == (variable.dims, variable.attrs)
    np.testing.assert_array_equal(read["observed"]["strain"], result.flight.observed)


def test_what_is_stored_agrees_with_itself(result: MissionResult, tmp_path: Path) -> None:
    write_run(tmp_path, groups_of(result), {})
    tree = read_run(tmp_path)
    filtered, predicted = tree["filtered"].to_dataset(), tree["predicted"].to_dataset()
    levels = result.knowledge.model.states.coordinates
    np.testing.assert_allclose(filtered["mean"], filtered["probability"].values @ levels)
    np.testing.assert_allclose(predicted["control_probability"].sum("control"), 1.0)
    decided = filtered["decision_probability"]
    np.testing.assert_array_equal(decided.argmax("control")[:-1], result.flight.control_index[1:])
    assert "filtered belief" in decided.attrs["long_name"]
    # A healthy wing at 3g: the mean over the draws of e is the quantity of interest.
    np.testing.assert_allclose(filtered["quantity_mean"][0], result.knowledge.sensor_model.mean[0, 1])
    deviation = result.knowledge.sensor_model.value_per_draw[:, 0, 1].std(axis=0)
    np.testing.assert_allclose(filtered["quantity_standard_deviation"][0], deviation)
    assert np.all(filtered["quantity_lower"] <= filtered["quantity_mean"])
    assert np.all(filtered["quantity_mean"] <= filtered["quantity_upper"])
    assert np.isnan(filtered["reward_mean"].sel(reward="error").values[36:38]).all()
    assert np.isnan(predicted["reward_mean"].sel(reward="error")).all()
    assert np.isfinite(predicted["reward_mean"].sel(reward=["health", "control"])).all()
    assert filtered["log_evidence"].values[36] == pytest.approx(0.0, abs=1e-12)
    drifting = tree["truth"]["sensor_status"].values[:, 11]
    assert set(drifting[8:36]) == {2}


def test_tables_are_in_the_units_of_their_headers(result: MissionResult) -> None:
    tables = tables_of(groups_of(result), "strain")
    health = list(csv.DictReader(tables["health"].splitlines()))
    assert [float(row["z1_true_percent"]) for row in health[8:13]] == [0, 0, 2, 4, 6]
    observed = list(csv.DictReader(tables["observed"].splitlines()))
    assert float(observed[3]["strain_5_microstrain"]) == pytest.approx(
        1e6 * result.flight.observed[3, 4], rel=1e-5
    )
    assert observed[36]["strain_5_microstrain"] == ""
    policy = list(csv.DictReader(tables["policy"].splitlines()))
    assert (policy[0]["z1_percent"], policy[0]["control"]) == ("0", "3g")
    assert (policy[-1]["z1_percent"], policy[-1]["control"]) == ("80", "2g")
    decisions = list(csv.DictReader(tables["decisions"].splitlines()))
    assert decisions[0]["control"] == "3g"
    assert decisions[36]["error_reward"] == ""


def test_the_store_calls_the_writer_of_the_field(result: MissionResult, tmp_path: Path) -> None:
    asked: list[Path] = []
    store_mission(tmp_path, result, {}, asked.append)
    assert asked == [tmp_path / "wing.vtu"]
    assert sorted(path.name for path in (tmp_path / "csv").iterdir()) == [
        "decisions.csv", "estimated.csv", "health.csv", "observed.csv", "policy.csv", "true.csv",
    ]  # fmt: skip


def test_summary_keeps_each_figure_beside_its_reference(tmp_path: Path) -> None:
    figure = Figure("a", "title", 1.5, "steps", 2.0, "somebody")
    path = write_summary(tmp_path, [figure, Figure("b", "none", None)], {"seed": 3})
    record = json.loads(path.read_text(encoding="utf-8"))
    assert record["seed"] == 3
    assert record["figures"][0] == {
        "key": "a", "title": "title", "value": 1.5, "unit": "steps", "reference": 2.0,
        "reference_source": "somebody",
    }  # fmt: skip
    assert record["figures"][1]["value"] is None


def test_damaged_and_unwritable(result: MissionResult, tmp_path: Path) -> None:
    write_run(tmp_path, groups_of(result), {})
    content = (tmp_path / "run.nc").read_bytes()
    (tmp_path / "run.nc").write_bytes(content[:1000])
    with pytest.raises(DamagedFileError, match="not a whole run"):
        read_run(tmp_path)
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(FileNotWrittenError):
        write_run(tmp_path / "file", groups_of(result), {})
