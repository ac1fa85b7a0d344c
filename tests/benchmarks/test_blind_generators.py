"""Hidden effects beside the package's own models and patches, with which the generators share no code."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

import benchmarks.blind
from benchmarks.blind.cases import (
    DETECTABLE,
    Case,
    Order,
    Workbench,
    finite_signals,
    make_case,
    workbench,
)
from benchmarks.blind.changes import Changes
from benchmarks.blind.effects import DRAWS, LUMPED, Hidden, spread_cubic_stiffness
from benchmarks.blind.instruments import Chance, draw_chance, true_signals
from benchmarks.blind.lumped_rig import model_text
from benchmarks.blind.writing import write_case
from discrepancy.campaign.reading import read_campaign
from discrepancy.catalogue.entry import Setting
from discrepancy.system.response import Conditions
from discrepancy.system.sensing import observe
from discrepancy.system.wing_model import WingModel
from fe.full.factorisation import lowest_eigenpairs
from fe.runtime.patch import ModelPatch
from fe.wing.operators import point_masses, section_displacement
from tests.discrepancy.rigs import chosen, model_of, setting_of
from tests.test_architecture import named_imports

pytestmark = pytest.mark.long  # loops are compiled in half a minute, the full wing is projected in one

NEAR = {"lumped": 0.05, "wing": 0.5}
"""Noises by which a rig and its model may differ; the wing has another mesh and fewer modes."""
CASES = [("lumped", DRAWS[name]) for name in LUMPED]
CASES += [("wing", draw) for draw in (*DRAWS.values(), spread_cubic_stiffness)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the wing's basis and the campaigns are kept."""
    return tmp_path_factory.mktemp("blind")


@pytest.fixture(scope="module", params=NEAR)
def rig(request: pytest.FixtureRequest, folder: Path) -> tuple[Workbench, Setting]:
    """A rig, and its campaign with the package's own model."""
    name = request.param
    write_case(make_case(Order(name, "null", name, (), 5), folder), folder, folder / "sealed")
    model = model_of(model_text()) if name == "lumped" else WingModel.of_design()
    return workbench(name, folder), setting_of(read_campaign(folder / name), model)


def patch_of(hidden: Hidden, setting: Setting) -> ModelPatch:
    """Return the patch that the sealed truth of an effect says, forces at unit speed and displacement."""
    (effect,) = chosen(hidden.identifier)
    usual = {item.name: item.prior.value(1.0) for item in effect.parameters}
    (primitive,) = effect.patch(setting, usual, hidden.place)
    sealed = {"reference_velocity": 1.0, "reference_displacement": 1.0}
    for key, value in hidden.truth.items():
        name, _, port = key.partition(".")[2].partition("@")
        if port in ("", hidden.place):
            sealed[name] = value
    return ModelPatch((replace(primitive, **{k: v for k, v in sealed.items() if hasattr(primitive, k)}),))


@pytest.mark.parametrize(("rig", "draw"), CASES, indirect=["rig"])
def test_a_hidden_effect_shows_as_its_patch_in_the_model(rig, draw):
    work, setting = rig
    chance = Chance(draw_chance(np.random.default_rng(2), work.plan).parameters, work.mean.amplitude)
    parameters = np.array([chance.parameters[item.name] for item in setting.model.parameters])
    bare, seen = true_signals(work.rig, work.plan, chance, Changes()), 0.0
    for seed in range(5, 30):
        hidden = draw(np.random.default_rng(seed), work.bench)
        signals = finite_signals(work, chance, hidden.changes)
        if signals is not None:
            break
    patch = patch_of(hidden, setting)
    for trial in setting.campaign.trials:
        channels = [work.plan.channels[name] for name in trial.channels]
        shown = observe(setting.model, setting.campaign, trial, patch, Conditions(parameters, refinement=4))
        expected, noise = signals[trial.name], np.array([channel.noise for channel in channels])
        found = shown.values / [channel.scale for channel in channels]
        assert np.abs((found - expected) / noise).max() < NEAR[work.rig.name], trial.name
        seen = max(seen, np.abs((expected - bare[trial.name]) / noise).max())
    assert seen > 0.6


@pytest.mark.parametrize("station", [0.9477, 1.3834, 1.4071])
def test_a_wing_with_a_point_mass_has_the_frequencies_of_its_full_model(folder, station):
    mass, parameters = 0.09, {"young_modulus_factor": 1.03, "servo_mass": 0.165, "pitot_mass": 0.14}
    rig = workbench("wing", folder).rig
    operators = rig.store.operators
    stiffness = operators.stiffness({"young_modulus_factor": parameters["young_modulus_factor"]})
    whole_mass = operators.mass(point_masses(parameters["servo_mass"], parameters["pitot_mass"]))
    at_place = section_displacement(operators.wing_mesh, station, 0.3)
    for direction in np.eye(3):
        row = sparse.csc_array((operators.expansion.T @ np.kron(at_place, direction))[:, np.newaxis])
        whole_mass = whole_mass + mass * (row @ row.T)
    squares, _ = lowest_eigenpairs(stiffness, whole_mass.tocsr(), 6)
    damping = {"damping_alpha": 0.0, "damping_beta": 0.0}
    structure = rig.structure(parameters | damping, Changes(mass=mass, mass_station=station))
    np.testing.assert_allclose(structure.angular_frequency[:6], np.sqrt(squares), rtol=5e-6)


ORDER = Order("case-0007", "catalogue", "lumped", ("coulomb_friction",), 5)


@pytest.fixture(scope="module")
def friction_case() -> Case:
    """A rig with hidden friction and its readings."""
    return make_case(ORDER)


@pytest.fixture(scope="module")
def sealed_folder(friction_case: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the truth of that case lies, beside the campaign that is given away."""
    folder = tmp_path_factory.mktemp("friction")
    write_case(friction_case, folder / "campaigns", folder / "sealed")
    return folder / "sealed"


@pytest.fixture(scope="module")
def written_campaign(sealed_folder: Path) -> Path:
    """The folder of the campaign of that case."""
    return sealed_folder.parent / "campaigns" / ORDER.name


def test_a_case_repeats(friction_case):
    again = make_case(ORDER)
    assert friction_case.truth == again.truth
    for name, values in friction_case.measured.values.items():
        np.testing.assert_array_equal(values, again.measured.values[name])


def test_a_hidden_effect_is_detectable(friction_case):
    assert friction_case.truth["d2"]["coulomb_friction"] >= DETECTABLE


def test_a_written_campaign_names_no_effect(written_campaign):
    text = "".join(file.read_text(encoding="utf-8") for file in sorted(written_campaign.iterdir()))
    assert not any(identifier in text for identifier in set(DRAWS) - {"load_place"})  # a key


def test_a_written_campaign_has_the_model_without_effects(written_campaign):
    assert (written_campaign / "model.toml").read_text(encoding="utf-8") == model_text()


def test_the_sealed_file_names_what_is_hidden(sealed_folder):
    sealed = json.loads((sealed_folder / f"{ORDER.name}.json").read_text(encoding="utf-8"))
    assert sealed["identifiers"] == ["coulomb_friction"]


def test_the_written_rows_are_those_that_were_measured(friction_case, written_campaign):
    rows = np.loadtxt(written_campaign / "05.csv", delimiter=",", skiprows=1)
    trial = friction_case.plan.trials[4]
    np.testing.assert_allclose(rows[:, 0], trial.rows, atol=1e-9)
    np.testing.assert_allclose(rows[:, 1:], friction_case.measured.values[trial.name], rtol=1e-6)


def test_generators_share_no_code_with_what_names():
    forbidden = (
        "discrepancy",
        "fe.runtime.patch",
        "fe.runtime.motion",
        "fe.runtime.patched_wing",
        "fe.runtime.sensors",
        "fe.runtime.reduced",
    )
    for file in Path(benchmarks.blind.__file__).parent.glob("*.py"):
        names = named_imports(f"benchmarks.blind.{file.stem}", file)
        assert not [name for name in names if name.startswith(forbidden)], file
