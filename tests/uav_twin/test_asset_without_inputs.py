"""A mission, and a library, of an FMU without inputs whose damage is a parameter that is set at the start."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from fmu_asset.checks.fmu_check import check_fmu
from fmu_asset.client.binding import load_binding
from fmu_asset.packing.script import build_script_fmu
from reporting.arrays import Float
from tests.command_line import refused, said
from tests.twin_master.runs import edited
from twin_master.assets.library_source import load_observation_library
from twin_master.library.grid import grid_of_fmu
from twin_master.library.sampling import sample_library

SCRIPT = """from pythonfmu import Fmi2Causality, Fmi2Slave, Fmi2Variability, Real


class Beam(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.wear, self.load, self.deflection = 0.0, 1.0, 0.0
        for name in ("wear", "load"):
            role = {"causality": Fmi2Causality.parameter, "variability": Fmi2Variability.fixed}
            self.register_variable(Real(name, start=getattr(self, name), **role))
        self.register_variable(Real("deflection", causality=Fmi2Causality.output))

    def do_step(self, time, step):
        self.deflection = self.load / (1.0 - self.wear)
        return True
"""
BINDING = """[binding]
name = "beam"
step_size = 1.0

[health.wear]
variable = "wear"
unit = "1"
minimum = 0.0
maximum = 0.5

[parameter.load]
variable = "load"
unit = "1"

[observation.deflection]
variables = ["deflection"]
unit = "1"
"""
SCENARIO = """format = 2

[mission]
name = "beam"
steps = 4
prediction_steps = 1
first_control = "only"
seed = 1

[[state]]
name = "wear"
levels_percent = [0, 20, 50]
prior = [1, 0, 0]

[[control]]
name = "only"
values = {}

[observation]
role = "deflection"
count = 1
unit = "1"
standard_deviation = 0.01

[transition]
kind = "independent_worsening"
probability = { only = 0.2 }

[rewards]
health_limit = 2.0
error_scale = 0.01
control = { only = 0.0 }

[planner]
gamma = 0.9

[asset]
kind = "fmu"
file = "beam.fmu"
binding = "beam.toml"

[belief]
kind = "asset"

[calibration]
parameter = "load"
source = "fixed"
mean = 1.0

[truth]
kind = "scripted"
gains = [{ state = "wear", first_step = 2, gain_percent = 20 }]

[truth.noise]
standard_deviation = 0.01
"""


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The FMU of a beam whose wear and load are parameters."""
    folder = tmp_path_factory.mktemp("beam")
    (folder / "beam.py").write_text(SCRIPT, encoding="utf-8")
    return build_script_fmu(folder / "beam.py", folder / "beam.fmu").path


def scenario_file(fmu: Path, folder: Path, *changes: tuple[str, str], binding: str = BINDING) -> Path:
    """Write a mission of the beam in which texts are exchanged."""
    (folder / "beam.fmu").write_bytes(fmu.read_bytes())
    (folder / "beam.toml").write_text(binding, encoding="utf-8")
    path = folder / "mission.toml"
    path.write_text(edited(SCENARIO, *changes), encoding="utf-8")
    return path


def deflections(wear: Float) -> Float:
    return 1.0 / (1.0 - wear)


def test_a_mission_of_an_fmu_without_inputs_wears_as_its_scenario_says(fmu, tmp_path):
    said("run", scenario_file(fmu, tmp_path), "--out", tmp_path / "run", "--no-report")

    flown = pd.read_csv(tmp_path / "run" / "csv" / "true.csv").iloc[:, 1]
    np.testing.assert_allclose(flown, deflections(np.array([0.0, 0.0, 0.2, 0.2])), rtol=1e-5)


@pytest.mark.parametrize("role", ["control", "load"])
def test_an_input_that_is_a_parameter_of_the_start_is_refused_with_the_remedy(fmu, tmp_path, role):
    changes = {
        "control": ("values = {}", "values = { load = 1.0 }"),
        "load": ('binding = "beam.toml"', 'binding = "beam.toml"\nload = { load = 1.0 }'),
    }
    binding = BINDING.replace("[parameter.load]", f"[{role}.load]")
    file = scenario_file(fmu, tmp_path, changes[role], binding=binding)

    sentence = refused("scenario", "check", file)

    assert f"{role}.load of the binding beam" in sentence
    assert "set before the start only: name it in [parameter], or in [health] if it is damage" in sentence


def test_a_state_that_the_binding_lacks_is_refused_with_the_remedy(fmu, tmp_path):
    binding = BINDING.replace("[health.wear]", "[parameter.wear]")
    file = scenario_file(fmu, tmp_path, binding=binding)

    sentence = refused("scenario", "check", file)

    assert "has the state wear, which the binding beam does not know" in sentence
    assert "bind each state in a table [health.NAME]" in sentence


def test_a_control_input_that_another_control_lacks_is_named(fmu, tmp_path):
    second = '\n[[control]]\nname = "second"\nvalues = { load = 1.0 }\n\n[observation]'
    file = scenario_file(fmu, tmp_path, ("\n[observation]", second))

    assert "`only` gives none and `second` gives load" in refused("scenario", "check", file)


def test_the_check_of_an_fmu_tries_the_range_of_a_health_that_is_set_at_the_start(fmu, tmp_path):
    binding = tmp_path / "beam.toml"
    binding.write_text(BINDING, encoding="utf-8")

    check = check_fmu(fmu, load_binding(binding), cycles=0)

    finding = next(finding for finding in check.findings if finding.check == "range edges")
    assert (finding.verdict, finding.text) == ("ok", "2 limits of input ranges give finite outputs.")


def test_a_library_of_an_fmu_without_inputs_is_believed(fmu, tmp_path):
    binding = tmp_path / "beam.toml"
    binding.write_text(BINDING, encoding="utf-8")
    grid = grid_of_fmu(fmu, binding, ["wear=0,0.2,0.5"])

    sample_library(grid, tmp_path / "beam.nc", workers=1)

    library = load_observation_library(tmp_path / "beam.nc")
    control = library.control_index("only", {})
    expected = deflections(np.array([0.0, 0.2, 0.5]))
    np.testing.assert_allclose(library.values[0, :, control, 0], expected, rtol=1e-15)
