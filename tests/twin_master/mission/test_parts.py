"""Missions and fleets with policy, sensor model and estimator of a user, as objects or by name."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import uav_twin
from tests.command_line import command, refused, said
from tests.twin_master.runs import changed_scenario
from twin_master.errors import FleetError, MissionInputError, NotResumableError, RunFolderError
from twin_master.mission.journal import JOURNAL_NAME
from twin_master.scenario.reading import LoadedScenario

STEPS = 6

MODULE = """
import numpy as np
from uav_twin import ExactFilter, GaussianSensorModel

class Forgetful(ExactFilter):
    def step(self, before, observation, control_index, step):
        return super().step(None, observation, control_index, step)

def forgetful(twin):
    return Forgetful(twin.model, twin.sensor_model, "forgetful")

def noisy(twin):
    sensors = twin.sensor_model
    return GaussianSensorModel(sensors.value_per_draw, 10.0 * sensors.standard_deviation)

def gentle(model):
    return np.eye(len(model.controls))[np.zeros(model.states.size, dtype=int)]

number = 3
"""


class Forgetful(uav_twin.ExactFilter):
    """An estimator that begins each step with the prior."""

    def step(self, before: Any, observation: Any, control_index: int, step: int) -> uav_twin.Estimate:
        return super().step(None, observation, control_index, step)


def forgetful(twin: Any) -> Forgetful:
    return Forgetful(twin.model, twin.sensor_model, "forgetful")


def mission(steps: int = STEPS) -> LoadedScenario:
    return changed_scenario("paper_level_turns", {"mission": {"steps": steps}, "notice": ""})


@pytest.fixture
def fly(library_file: Path, tmp_path: Path) -> Any:
    """Fly the short mission into a folder of its own and return the run."""

    def flown(name: str, **parts: Any) -> Any:
        overrides = {"strain_library": library_file}
        return uav_twin.fly(mission(), tmp_path / name, overrides, report=False, **parts).tree

    return flown


@pytest.fixture
def module(tmp_path: Path) -> str:
    path = tmp_path / "rig.py"
    path.write_text(MODULE, encoding="utf-8")
    return str(path)


def test_an_estimator_is_flown_as_object_as_function_and_by_the_name_of_a_file(fly, module, library_file):
    plain = fly("plain")["filtered"]["probability"].values
    by_function = fly("function", estimator=forgetful)["filtered"]["probability"].values
    by_name = fly("name", estimator=f"{module}:forgetful")["filtered"]["probability"].values
    assert np.abs(plain - by_function).max() > 1e-3
    np.testing.assert_array_equal(by_function, by_name)
    known = uav_twin.prepare_twin(mission(), {"strain_library": library_file})
    as_object = fly("object", estimator=forgetful(known))["filtered"]["probability"].values
    np.testing.assert_array_equal(by_function, as_object)


def test_a_sensor_model_makes_the_belief_wider_and_a_policy_function_decides(fly, module):
    plain = fly("plain")
    noisy = fly("noisy", sensor_model=f"{module}:noisy", policy=f"{module}:gentle")
    deviation = [run["filtered"]["standard_deviation"].values[-1].sum() for run in (plain, noisy)]
    assert deviation[1] > 2.0 * deviation[0]
    assert set(noisy["observed"]["control_index"].values[1:].tolist()) == {0}


def test_a_run_is_resumed_with_the_parts_that_it_was_begun_with(library_file, module, tmp_path):
    name = f"{module}:forgetful"
    overrides = {"strain_library": library_file}
    whole = uav_twin.fly(mission(), tmp_path / "whole", overrides, estimator=name, report=False)
    folder = tmp_path / "cut"
    uav_twin.fly(mission(), folder, overrides, estimator=name, report=False)
    for file in ("run.nc", "summary.json"):
        (folder / file).unlink()
    journal = folder / JOURNAL_NAME
    lines = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join(lines[: len(lines) // 2]))
    with pytest.raises(
        NotResumableError, match=r"another estimator \(.*rig.py:forgetful\).*give `estimator` again"
    ):
        uav_twin.resume(folder, report=False)
    with pytest.raises(NotResumableError, match=r"another sensor model .*leave `sensor_model` out"):
        uav_twin.resume(folder, sensor_model=f"{module}:noisy", estimator=name, report=False)
    resumed = uav_twin.resume(folder, estimator=name, report=False)
    assert (folder / "summary.json").read_bytes() == (whole.folder / "summary.json").read_bytes()
    assert resumed.tree["filtered"].equals(whole.tree["filtered"])


@pytest.mark.parametrize(
    ("role", "name", "sentence"),
    [
        ("estimator", "nothing", "there is no estimator 'nothing': give MODULE:NAME"),
        ("estimator", "no_such_module:make", "cannot be loaded .ModuleNotFoundError"),
        ("estimator", "FILE:number", "an estimator needs `model`, `step"),
        ("sensor_model", "FILE:number", "must be a GaussianSensorModel"),
        ("sensor_model", "FILE:absent", "cannot be loaded .AttributeError"),
        ("policy", "FILE:absent", "the policy .* cannot be loaded"),
    ],
)
def test_a_part_that_does_not_fit_is_refused(role, name, sentence, fly, module):
    with pytest.raises(MissionInputError, match=sentence):
        fly("never", **{role: name.replace("FILE", module)})


def test_a_sensor_model_of_other_states_is_refused(fly):
    other = uav_twin.GaussianSensorModel(np.ones((1, 2, 2, 24)), 1.0)
    with pytest.raises(MissionInputError, match=r"\(2, 2, 24\), but the scenario has \(25, 2, 24\)"):
        fly("never", sensor_model=other)


@pytest.mark.parametrize("role", ["sensor_model", "estimator"])
def test_a_twin_that_learns_takes_no_part_that_it_would_ignore(role, library_file, module, tmp_path):
    changes = {"mission": {"steps": 2}, "notice": "", "learning": {"transition_factors": [0.1, 10.0]}}
    learning = changed_scenario("paper_level_turns", changes)
    name = {"sensor_model": f"{module}:noisy", "estimator": f"{module}:forgetful"}[role]

    with pytest.raises(MissionInputError, match="the scenario has a table `learning`"):
        uav_twin.fly(
            learning,
            tmp_path / "never",
            {"strain_library": library_file},
            report=False,
            **{role: name},
        )


def test_twins_of_an_ensemble_fly_what_runs_fly(library_file, module, tmp_path):
    overrides = {"strain_library": library_file}
    parts = {"estimator": f"{module}:forgetful", "policy": f"{module}:gentle"}
    fleet = uav_twin.ensemble(mission(), range(3), overrides)
    folder = uav_twin.fly_fleet(fleet, tmp_path / "many", **parts).folder
    group = uav_twin.open_fleet(folder)["paper_level_turns"]
    alone = uav_twin.fly(mission(), tmp_path / "one", {**overrides, "seed": 1}, report=False, **parts).tree
    np.testing.assert_array_equal(
        group["observed/control_index"].values[1], alone["observed"]["control_index"].values
    )
    np.testing.assert_allclose(
        group["filtered/mean"].values[1], alone["filtered"]["mean"].values, rtol=0, atol=1e-12
    )
    with pytest.raises(RunFolderError, match="another fleet"):
        uav_twin.fly_fleet(fleet, folder)
    record = json.loads((folder / "config.json").read_text())["fleet"]["parts"]
    assert record["estimator"] == f"{module}:forgetful"
    again = uav_twin.fly_fleet(fleet, folder, **parts)
    assert (again.shards_flown, again.shards_kept) == (0, 1)


def test_a_fleet_says_what_it_cannot_send_and_what_it_cannot_learn_from(library_file, module, tmp_path):
    fleet = uav_twin.ensemble(mission(), range(2), {"strain_library": library_file})

    def local_function(twin: Any) -> Forgetful:
        return forgetful(twin)

    with pytest.raises(FleetError, match=r"cannot be sent .*FILE\.py:NAME"):
        uav_twin.fly_fleet(fleet, tmp_path / "never", estimator=local_function)
    folder = uav_twin.fly_fleet(fleet, tmp_path / "noisy", sensor_model=f"{module}:noisy").folder
    with pytest.raises(FleetError, match=r"flew with the sensor model .*rig.py:noisy"):
        uav_twin.learn_from_fleet(folder, tmp_path / "learnt.toml")


def test_the_command_line_flies_parts_by_name_alone_and_under_many_seeds(library_file, module, tmp_path):
    words = ["growing_damage", "--strain-library", library_file, "--estimator", f"{module}:forgetful"]
    words += ["--policy", f"{module}:gentle", "--no-report"]
    told = said("run", *words, "--seeds", "0:2", "--workers", 0, "--out", tmp_path / "many")
    assert "2 twins" in told
    told = refused("run", "growing_damage", "--estimator", "nothing", "--out", tmp_path / "never")
    assert "there is no estimator 'nothing'" in told
    assert not (tmp_path / "never").exists()


SHARP = """
from uav_twin import GaussianSensorModel

class Sharp(GaussianSensorModel):
    def log_likelihood(self, observation, control_index):
        return 2.0 * super().log_likelihood(observation, control_index)

def sharp(twin):
    return Sharp(twin.sensor_model.value_per_draw, twin.sensor_model.standard_deviation)

def plain(twin):
    return GaussianSensorModel(twin.sensor_model.value_per_draw, twin.sensor_model.standard_deviation)
"""


GAUSSIAN_ALARMS = "take the noise of the gauges as Gaussian"


@pytest.fixture
def sharp_file(tmp_path) -> Path:
    """A file with a sensor model that has a likelihood of its own, and one that has not."""
    file = tmp_path / "sharp.py"
    file.write_text(SHARP, encoding="utf-8")
    return file


def test_a_run_says_once_that_alarms_do_not_use_the_likelihood_of_a_sensor_model_of_ones_own(
    library_file, sharp_file, tmp_path
):
    words = ["level_turns", "--strain-library", library_file, "--sensor-model", f"{sharp_file}:sharp"]
    message = said("run", *words, "--out", tmp_path / "sharp")
    assert message.count(GAUSSIAN_ALARMS) == 1
    assert "sensor model Sharp" in message
    assert (tmp_path / "sharp" / "report.html").read_text("utf-8").count(GAUSSIAN_ALARMS) == 1


def test_a_run_with_the_likelihood_of_the_alarms_says_nothing_of_it(library_file, sharp_file, tmp_path):
    words = ["level_turns", "--strain-library", library_file, "--sensor-model", f"{sharp_file}:plain"]
    assert GAUSSIAN_ALARMS not in said("run", *words, "--no-report", "--out", tmp_path / "plain")


@pytest.mark.parametrize(("name", "notes"), [("sharp", 1), ("plain", 0)])
def test_an_ensemble_says_once_how_a_sensor_model_becomes_fast(
    library_file, sharp_file, tmp_path, name, notes
):
    words = ["run", "level_turns", "--strain-library", library_file, "--seeds", "0:2", "--workers", 0]
    words += ["--no-report", "--sensor-model", f"{sharp_file}:{name}", "--out", tmp_path / name]
    flown = command(*words)
    assert flown.returncode == 0, flown.stderr
    assert flown.stderr.count("Sharp has only `log_likelihood`") == notes
    assert flown.stderr.count("implement `log_likelihood_sequence(observations, control_index)`") == notes
    assert "one after the other because" not in flown.stderr


def test_an_ensemble_flies_side_by_side_with_and_without_notices(library_file, tmp_path):
    words = ["run", "level_turns", "--strain-library", library_file, "--seeds", "0:2", "--workers", 0]
    words.append("--no-report")
    told = said(*words, "--out", tmp_path / "watched")
    told += said(*words, "--no-notices", "--out", tmp_path / "unwatched")
    assert "one after the other" not in told
    groups = [uav_twin.open_fleet(tmp_path / name)["level_turns"] for name in ("watched", "unwatched")]
    assert [group.attrs["gives_notice"] for group in groups] == [1, 0]


def test_an_ensemble_of_learning_twins_says_that_they_fly_one_after_the_other(library_file, tmp_path):
    words = [
        "run",
        "level_turns_learning",
        "--strain-library",
        library_file,
        "--seeds",
        "0:2",
        "--workers",
        0,
    ]
    flown = command(*words, "--no-report", "--no-notices", "--out", tmp_path / "learning")
    assert flown.returncode == 0, flown.stderr
    assert flown.stderr.count("the 2 twins fly one after the other because they learn") == 1
