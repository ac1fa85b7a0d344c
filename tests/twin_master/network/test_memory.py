"""What does not fit in memory, or is no noise of a sensor, is refused before it is built."""

import tomllib
import tracemalloc

import numpy as np
import pytest

from reporting.memory import memory_left
from scenarios import scenario_files
from twin_master.assets.resolution import Overrides, asset_source, resolve_scenario
from twin_master.errors import InvalidModelError, TwinMasterError
from twin_master.mission.preparation import prepare_knowledge
from twin_master.network import memory
from twin_master.network.graphical_model import worsening_table
from twin_master.network.memory import check_scenario_fits
from twin_master.network.sensor_model import check_noise
from twin_master.network.transition import TransitionModel
from twin_master.scenario.reading import LoadedScenario, load_scenario, parse_scenario

TEXT = scenario_files()["level_turns"].read_text(encoding="utf-8")
GIGABYTES = 8e9


@pytest.fixture
def small_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine of 8 GB, whatever the tests run on."""
    monkeypatch.setattr(memory, "memory_left", lambda: GIGABYTES)


def six_factors() -> LoadedScenario:
    """A scenario of 5^6 = 15,625 states."""
    table = tomllib.loads(TEXT)
    table["state"] = [table["state"][0] | {"name": f"z{number}"} for number in range(1, 7)]
    table["mission"]["steps"] = 60
    table["calibration"]["draws"] = 800
    return LoadedScenario(parse_scenario(table, "x"), scenario_files()["level_turns"], "")


def test_the_memory_of_this_machine_is_known():
    assert 5e7 < memory_left() < 1e14


@pytest.mark.usefixtures("small_machine")
def test_too_many_states_are_refused_before_anything_is_built():
    loaded = six_factors()
    tracemalloc.start()
    try:
        with pytest.raises(InvalidModelError) as caught:
            asset_source(resolve_scenario(loaded, Overrides()))
        assert tracemalloc.get_traced_memory()[1] < 5e7
    finally:
        tracemalloc.stop()
    sentence = str(caught.value)
    for word in ("15625 states", "2 controls", "38.4 GB", "8 GB", "800 draws", "fewer levels"):
        assert word in sentence, sentence
    assert "\n" not in sentence


@pytest.mark.usefixtures("small_machine")
def test_too_many_draws_are_refused_with_their_size():
    scenario = parse_scenario(tomllib.loads(TEXT.replace("draws = 100", "draws = 1000000")), "x")
    with pytest.raises(InvalidModelError, match=r"76.8 GB for 1000000 draws of 24 sensors"):
        check_scenario_fits(scenario)
    check_scenario_fits(load_scenario("level_turns").scenario)


@pytest.mark.usefixtures("small_machine")
def test_the_table_of_all_states_is_refused_too():
    table = worsening_table(5, 0.1)
    product = TransitionModel.from_factors([[table] * 6] * 2)
    with pytest.raises(InvalidModelError, match="15625 states under 2 controls"):
        _ = product.matrix
    assert TransitionModel.from_factors([[table] * 2] * 2).matrix.shape == (2, 25, 25)


@pytest.mark.parametrize(
    ("key", "number"), [("observation.standard_deviation", 125), ("truth.noise.standard_deviation", 150)]
)
def test_a_noise_whose_unit_was_forgotten_is_refused(key, number, tmp_path, library_file):
    old = f"standard_deviation_microstrain = {number}"
    assert old in TEXT
    path = tmp_path / "blind.toml"
    path.write_text(TEXT.replace(old, f"standard_deviation = {number}"), encoding="utf-8")
    with pytest.raises(TwinMasterError, match=f"write `{key}_microstrain = {number}`"):  # no strain at all
        load_scenario(path)
    path.write_text(TEXT.replace(old, "standard_deviation = 0.05"), encoding="utf-8")
    scenario = resolve_scenario(load_scenario(path), Overrides(strain_library=library_file))
    with pytest.raises(TwinMasterError) as caught:
        prepare_knowledge(scenario, asset_source(scenario), 0)
    for word in (f"`{key}` is 0.05", f"write `{key}_microstrain = 0.05`", "sensor 1"):
        assert word in str(caught.value), str(caught.value)


def test_only_a_noise_beyond_all_that_its_kind_of_sensor_shows_is_refused():
    predicted = np.zeros((1, 2, 1, 3))
    predicted[0, :, 0, 0] = 1e-3, 2e-3
    predicted[0, :, 0, 2] = 300.0
    # The second gauge shows nothing at all, as one on the neutral axis; the third is a thermometer.
    check_noise("noise", [1e-4, 1e-4, 0.5], predicted, ("1", "1", "K"))
    for given, unit in (([1e-4, 3e-3, 0.5], "strain"), ([1e-4, 1e-4, 500.0], "in K")):
        with pytest.raises(InvalidModelError, match=unit):
            check_noise("noise", given, predicted, ("1", "1", "K"))
    with pytest.raises(InvalidModelError, match="sensor 2"):
        check_noise("noise", [1e-4, 125.0, 0.5], predicted, ("1", "1", "K"))
