"""What an FMU is told before its first step: end of the experiment, enumerations, texts."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fmu_asset import errors
from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.checks.fmu_check import check_fmu
from fmu_asset.client.binding import parse_binding
from fmu_asset.client.experiment import default_experiment, ending_with_histories, run_experiment
from fmu_asset.client.session import FmiAsset
from tests.fmu_asset.making import bound, edited

DAY = 86400.0
WANTS_A_DAY = f"WANTS_STOP_TIME={DAY}"
SIREN = {"y": (["y"], "1")}


def flown(path: Path, **wanted: Any) -> np.ndarray:
    """Return the outputs of an FMU's default experiment, or what is wanted instead."""
    experiment = default_experiment(read_fmu(path), **wanted)
    with FmiAsset(path, experiment.binding, isolated=False) as asset:
        return run_experiment(asset, experiment).values


# ---------------------------------------------------------------- the end of the experiment


@pytest.mark.parametrize("model", ["siren1", "siren2", "siren3"])
def test_the_stop_time_is_told_at_the_start(foreign_fmu, model) -> None:
    values = flown(foreign_fmu(model, WANTS_A_DAY), stop_time=DAY, step_size=900.0)
    assert len(values) == 97


def test_an_end_within_the_last_step_is_told_as_the_end_of_that_step(foreign_fmu) -> None:
    experiment = default_experiment(read_fmu(foreign_fmu("siren2")), stop_time=1.0, step_size=0.6)
    assert experiment.binding.binding.stop_time == pytest.approx(1.2)


def test_steps_that_only_rounding_leads_beyond_the_end_leave_it_as_it_was_asked_for(
    foreign_fmu,
) -> None:
    experiment = default_experiment(read_fmu(foreign_fmu("siren2")), stop_time=0.3, step_size=0.1)
    assert experiment.binding.binding.stop_time == 0.3


@pytest.mark.parametrize(("interpolation", "end"), [("zero-order", 30.0), ("linear", 20.0)])
def test_histories_of_a_file_end_the_experiment(interpolation, end) -> None:
    binding = bound(10.0, SIREN, header={"interpolation": interpolation})
    assert ending_with_histories(binding, 3).binding.stop_time == end


def test_a_stop_time_of_the_binding_is_told(foreign_fmu) -> None:
    binding = bound(900.0, SIREN, header={"stop_time": DAY})
    with FmiAsset(foreign_fmu("siren2", WANTS_A_DAY), binding) as asset:
        assert asset.step().time == 900.0


def test_a_start_without_an_end_names_the_key(foreign_fmu) -> None:
    words = (
        r"(?s)No end of the experiment.*"
        r"give `stop_time` in the table \[binding\].*must be given"
    )
    asset = FmiAsset(foreign_fmu("siren2", WANTS_A_DAY), bound(900.0, SIREN))
    with pytest.raises(errors.FmuCallError, match=words):
        asset.reset()


def test_an_end_before_the_start_is_refused() -> None:
    with pytest.raises(errors.BindingError, match="stop_time 1 s must come after start_time 2 s"):
        bound(1.0, SIREN, header={"start_time": 2.0, "stop_time": 1.0})


def test_the_checks_tell_the_stop_time_that_the_fmu_declares(foreign_fmu, tmp_path) -> None:
    declared = ("<ModelVariables>", f'<DefaultExperiment stopTime="{DAY}"/><ModelVariables>')
    plain = foreign_fmu("siren2", WANTS_A_DAY)
    check = check_fmu(edited(plain, tmp_path / "day.fmu", declared), cycles=0)
    assert check.passed, check.problems


# ---------------------------------------------------------------- enumerations


def test_an_enumeration_is_set_by_the_name_of_its_item(foreign_fmu) -> None:
    values = flown(foreign_fmu("siren2"), values={"loudness": "loud", "u": "2"})
    assert values[-1][0] == 20.0


def test_a_binding_sets_an_enumeration_by_name(foreign_fmu) -> None:
    content = {
        "binding": {"name": "siren", "step_size": 1.0},
        "observation": {"y": {"variables": "y", "unit": "1"}},
        "parameter": {"loudness": {"variable": "loudness", "unit": "1", "value": "loud"}},
    }
    with FmiAsset(foreign_fmu("siren2"), parse_binding(content), isolated=False) as asset:
        assert asset.step().values[0] == 10.0


@pytest.mark.parametrize("history", [["quiet", "loud", "quiet"], [1, 3, 1]])
def test_an_input_moves_through_items_by_name_or_number(foreign_fmu, history) -> None:
    binding = bound(1.0, SIREN, control={"switch": ("switch", "1")})
    with FmiAsset(foreign_fmu("siren2"), binding, isolated=False) as asset:
        assert asset.simulate({"switch": history}).values[:, 0].tolist() == [1.0, 10.0, 1.0]


@pytest.mark.parametrize("value", [2, 4, "noisy"])
def test_a_value_that_an_enumeration_does_not_define_is_refused(foreign_fmu, value) -> None:
    binding = bound(1.0, SIREN, control={"switch": ("switch", "1")})
    words = (
        r"control\.switch must be an item of the enumeration 'switch' "
        r"\(quiet = 1, loud = 3\), but is "
    )
    asset = FmiAsset(foreign_fmu("siren2"), binding, isolated=False)
    with asset, pytest.raises(errors.FmuInputError, match=words):
        asset.step({"switch": value})


def test_a_word_that_is_no_item_names_the_items(foreign_fmu) -> None:
    with pytest.raises(
        errors.FmuInputError, match="loudness must be one of quiet = 1, loud = 3, but is 'x'"
    ):
        flown(foreign_fmu("siren2"), values={"loudness": "x"})


# ---------------------------------------------------------------- texts


@pytest.mark.parametrize("model", ["siren1", "siren2", "siren3"])
def test_a_text_parameter_is_set_as_it_is_written(foreign_fmu, model) -> None:
    """Also one that looks like a number, or like several."""
    assert flown(foreign_fmu(model), values={"label": "1,25 é", "u": 0.0})[-1][0] == 7.0


def test_a_text_stays_after_a_reset_and_in_a_state(foreign_fmu) -> None:
    content = {
        "binding": {"name": "siren", "step_size": 1.0},
        "observation": {"y": {"variables": "y", "unit": "1"}},
        "parameter": {"label": {"variable": "label", "unit": "1", "value": "horn"}},
    }
    with FmiAsset(
        foreign_fmu("siren2"), parse_binding(content), parameters={"label": "siren"}
    ) as asset:
        asset.step()
        saved = asset.save_state()
        asset.reset({})
        assert asset.step().values[0] == 5.0  # 1 + the length of "horn"
        asset.restore_state(saved)
        assert asset.step().values[0] == 6.0


def test_a_number_for_a_text_is_refused(foreign_fmu) -> None:
    with pytest.raises(errors.FmuInputError, match=r"parameter\.label must be a text, but is 3\.0"):
        FmiAsset(foreign_fmu("siren2"), bound(1.0, SIREN), parameters={"label": 3.0})
