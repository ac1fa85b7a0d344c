"""FMUs as models against the lumped model of the same rig, and our wing FMU against the wing model."""

import tomllib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from discrepancy.campaign.records import Campaign, Hold, Quantity, Release, Trial, TrialKind
from discrepancy.catalogue.library import load_catalogue
from discrepancy.errors import ModelError
from discrepancy.model_choice import choose_model
from discrepancy.models.fmu import FmuModel
from discrepancy.models.fmu_file import parse_fmu_model
from discrepancy.models.interface import Conditions, Model
from discrepancy.models.lumped import LumpedModel
from discrepancy.sources.examples import example_campaign, plan_for
from discrepancy.verdict import VerdictKind
from discrepancy.workflow import investigate
from fe.runtime.patch import (
    BoucWen,
    FreePlay,
    InertiaRelief,
    LoadGain,
    LoadPlace,
    MicroSlip,
    ModelPatch,
    PointMass,
    PowerDamping,
    PowerStiffness,
    Primitive,
    SensorGain,
    StiffnessDrift,
    Washout,
)

FloatArray = NDArray[np.float64]

STIFFNESS, AMPLITUDE, FREQUENCY = 1974.0, 0.02, np.sqrt(987.0)
CONDITIONS = Conditions(np.array([1.02, 0.9]))
OUTPUTS = (("displacement", Quantity.DISPLACEMENT), ("leaf_strain", Quantity.STRAIN))
LAWS: dict[str, Primitive] = {
    "coulomb": PowerDamping("slide", 0.02 * STIFFNESS * AMPLITUDE, 0.0, 0.0, 1.0, 1.0),
    "quadratic": PowerDamping("slide", 0.05 * STIFFNESS * AMPLITUDE, 2.0, 0.0, FREQUENCY * AMPLITUDE, 1.0),
    "structural": PowerDamping("slide", 0.03 * STIFFNESS * AMPLITUDE, 0.0, 1.0, 1.0, AMPLITUDE),
    "root of speed": PowerDamping(
        "slide", 0.02 * STIFFNESS * AMPLITUDE, 0.5, 0.0, FREQUENCY * AMPLITUDE, 1.0
    ),
    "cubic": PowerStiffness("slide", 0.05 * STIFFNESS * AMPLITUDE, 3.0, 0, AMPLITUDE),
    "crack": PowerStiffness("slide", -0.05 * STIFFNESS * AMPLITUDE, 1.0, -1, AMPLITUDE),
    "free play": FreePlay("slide", 0.1 * STIFFNESS, 0.1 * AMPLITUDE),
    "micro-slip": MicroSlip("slide", 0.05 * STIFFNESS * AMPLITUDE, 0.1 * STIFFNESS, -0.3),
    "bouc-wen": BoucWen("slide", 0.1 * STIFFNESS, 0.5 * AMPLITUDE, 2.0),
}

RIG = """
format = 1
kind = "fmu"
name = "Rig as an FMU"
fmu = "{fmu}"
isolated = false
inputs = {{ force = {{ mass = "slide.force" }} }}
static = {{ settle = true, step = 0.013 }}
release = {{ displacement = "release", velocity = "release_speed" }}
output = [
  {{ name = "displacement", variable = "slide.position" }},
  {{ name = "leaf_strain", variable = "leaf", quantity = "strain" }},
]
port = [
  {{ name = "slide", force = "slide.force", displacement = "slide.position", velocity = "slide.speed" }},
]
parameter = [
  {{ name = "stiffness_factor", variable = "stiffness", mean = 1, deviation = 0.02, low = 0.7, high = 1.3 }},
  {{ name = "damping_factor", variable = "damping", mean = 1.0, deviation = 0.1, low = 0.3, high = 3.0 }},
]
scales = {{ length = 0.4 }}
"""


def patch(*items: Primitive) -> ModelPatch:
    return ModelPatch(items)


def trial(kind: TrialKind, count: int = 300, **changes: Any) -> Trial:
    time = changes.pop("time", 0.01 * np.arange(count))
    return Trial.plain("a trial", kind, (), time, **{"load_place": "mass", **changes})


RINGDOWN = trial(TrialKind.RINGDOWN, release=Release(AMPLITUDE))
LOADS = trial(TrialKind.STATIC, 7, force=np.array([0.0, 5.0, 10.0, 15.0, 10.0, 5.0, -5.0]))
SHAKEN = trial(TrialKind.FORCED, force=8.0 * np.sin(28.0 * 0.01 * np.arange(300)))


def write(folder: Path, fmu: Path, *changes: tuple[str, str]) -> Path:
    """Write the rig's file beside nothing, with texts replaced."""
    text = RIG.format(fmu=fmu)
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "rig.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def rig(foreign_fmu: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[FmuModel]:
    model = FmuModel.load(write(tmp_path_factory.mktemp("rig"), foreign_fmu("rig2")))
    yield model
    model.close()


@pytest.fixture(scope="module")
def lumped() -> LumpedModel:
    return LumpedModel.load("single_mass_rig")


def error(
    rig: Model, lumped: LumpedModel, case: Trial, changes: ModelPatch, conditions: Conditions = CONDITIONS,
    refinement: int = 1,
) -> float:  # fmt: skip
    """Return the largest difference of the two models as a share of each output's largest value."""
    fine, finer = (replace(conditions, refinement=n) for n in (refinement, 32 if case.is_dynamic else 1))
    exact = lumped.respond(case, OUTPUTS, changes, finer).values
    mine = rig.respond(case, OUTPUTS, changes, fine).values
    return float(np.max(np.max(np.abs(mine - exact), axis=0) / np.max(np.abs(exact), axis=0)))


# ---------------------------------------------------------------- the same rig twice


def test_is_a_model_with_what_its_file_says(rig: FmuModel) -> None:
    model: Model = rig
    assert model.name == "Rig as an FMU"
    assert [item.name for item in model.parameters] == ["stiffness_factor", "damping_factor"]
    assert model.output_quantity("leaf_strain") is Quantity.STRAIN
    assert model.output_quantity("slide.position") is None
    assert model.ports() == ("slide",)
    assert model.stations() == (0.0, 0.4)
    for carried in (PowerDamping, PowerStiffness, FreePlay, MicroSlip, BoucWen, LoadGain, SensorGain):
        assert model.supports(carried)
    for refused in (StiffnessDrift, PointMass, LoadPlace, Washout, InertiaRelief):
        assert not model.supports(refused)


def test_a_changed_binding_is_another_model(foreign_fmu: Any, tmp_path: Path) -> None:
    binding = """
binding = { name = "rig", step_size = 0.01 }
load = { push = { variable = "slide.force", unit = "N", maximum = 50.0 } }
observation = { place = { variables = ["slide.position"], unit = "m" } }
"""
    fmu = foreign_fmu("rig2")
    bare = choose_model(write(tmp_path, fmu))
    assert bare.source_hash == choose_model(tmp_path / "rig.toml").source_hash
    path = write(tmp_path, fmu, (f'fmu = "{fmu}"', f'fmu = "{fmu}"\nbinding = "rig_binding.toml"'))
    hashes = [bare.source_hash]
    for text in (binding, binding.replace("50.0", "40.0")):
        (tmp_path / "rig_binding.toml").write_text(text, encoding="utf-8")
        hashes.append(choose_model(path).source_hash)
    assert len(set(hashes)) == 3


def test_scales_are_those_of_the_rig(rig: FmuModel, lumped: LumpedModel) -> None:
    campaign = Campaign("", {}, (RINGDOWN, LOADS), None, {"stiffness_factor": (1.04, 0.01)}, "")
    mine, exact = rig.scales(campaign), lumped.scales(campaign)
    for name in ("length", "tip_stiffness", "modal_mass", "angular_frequency", "force", "duration"):
        assert getattr(mine, name) == pytest.approx(getattr(exact, name), rel=1e-7), name
    assert mine.ports["slide"].stiffness == pytest.approx(exact.ports["slide"].stiffness, rel=1e-7)
    assert mine.ports["slide"].displacement == pytest.approx(AMPLITUDE, rel=1e-9)
    nothing = rig.scales(Campaign("", {}, (), None, {}, ""))
    assert nothing.angular_frequency == pytest.approx(FREQUENCY, rel=1e-7)


def test_rest_and_motion_without_laws(rig: FmuModel, lumped: LumpedModel) -> None:
    assert error(rig, lumped, LOADS, patch()) < 1e-9
    assert error(rig, lumped, LOADS, patch(LoadGain(0.04, 0.5))) < 1e-9
    assert error(rig, lumped, RINGDOWN, patch()) < 1e-11
    moving = replace(RINGDOWN, release=Release(AMPLITUDE, at_rest=False, mode_count=1))
    # the unit of the velocity is w of the nominal rig here, that of the rig at hand there
    begun = Conditions(np.array([1.0, 0.9]), np.array([[0.9, 0.3]]))
    assert error(rig, lumped, moving, patch(), begun) < 1e-8


def test_a_clock_is_read_between_the_samples(rig: FmuModel, lumped: LumpedModel) -> None:
    slow = replace(CONDITIONS, clock=(2e-3, 3e-3), initial=np.array([[0.05, 0.0]]))
    assert error(rig, lumped, RINGDOWN, patch(), slow) < 2e-6
    early = replace(CONDITIONS, clock=(0.0, -0.03))
    assert error(rig, lumped, RINGDOWN, patch(), early) < 1e-11


def test_rates_are_the_derivatives(rig: FmuModel, lumped: LumpedModel) -> None:
    outputs = (("displacement", Quantity.VELOCITY), ("displacement", Quantity.DISPLACEMENT))
    mine = rig.respond(RINGDOWN, outputs, patch(), CONDITIONS)
    exact = lumped.respond(RINGDOWN, outputs, patch(), CONDITIONS)
    assert np.max(np.abs(mine.values - exact.values)) < 3e-4 * np.max(np.abs(exact.values))
    assert np.max(np.abs(mine.rates - exact.rates)) < 1e-2 * np.max(np.abs(exact.rates))


@pytest.mark.parametrize("name", LAWS)
def test_a_law_at_the_port_converges_to_the_lumped_model(
    rig: FmuModel, lumped: LumpedModel, name: str
) -> None:
    coarse, fine = (error(rig, lumped, RINGDOWN, patch(LAWS[name]), refinement=n) for n in (1, 4))
    assert coarse < 4e-4
    order = np.log(coarse / fine) / np.log(4.0)
    # second order; the root of the speed has no derivative at its turns
    assert order > (1.4 if name == "root of speed" else 1.75)


@pytest.mark.parametrize("name", ["cubic", "crack", "free play", "micro-slip", "bouc-wen"])
def test_a_law_at_rest_follows_the_load_path(rig: FmuModel, lumped: LumpedModel, name: str) -> None:
    assert error(rig, lumped, LOADS, patch(LAWS[name])) < 1e-9


def test_forced_motion_converges(rig: FmuModel, lumped: LumpedModel) -> None:
    for changes in (patch(), patch(LAWS["coulomb"]), patch(LAWS["bouc-wen"]), patch(LoadGain(0.1, 0.0))):
        coarse, fine = (error(rig, lumped, SHAKEN, changes, refinement=n) for n in (1, 4))
        assert coarse < 3e-4
        assert np.log(coarse / fine) / np.log(4.0) > 1.75


@pytest.mark.parametrize("hold", list(Hold))
def test_a_coarse_force_does_between_its_samples_what_is_said(
    rig: FmuModel, lumped: LumpedModel, hold: Hold
) -> None:
    time = 0.04 * np.arange(75)
    coarse = trial(TrialKind.FORCED, 75, time=time, force=8.0 * np.sin(28.0 * time), hold=hold)
    for changes in (patch(), patch(LAWS["coulomb"])):
        assert error(rig, lumped, coarse, changes, refinement=4) < 1e-3
        wanted = lumped.respond(coarse, OUTPUTS, changes, CONDITIONS).values
        straight = rig.respond(replace(coarse, hold=None), OUTPUTS, changes, CONDITIONS).values
        differ = np.abs(straight - wanted).max() > 0.02 * np.abs(wanted).max()
        assert differ == (hold is not Hold.LINEAR)


def test_stepping_the_fmu_gives_what_superposition_gives(
    rig: FmuModel, foreign_fmu: Any, tmp_path: Path
) -> None:
    path = write(
        tmp_path, foreign_fmu("rig2"), ("isolated = false", "isolated = false\nsuperposition = false")
    )
    stepped = FmuModel.load(path)
    short = trial(TrialKind.RINGDOWN, 120, release=Release(AMPLITUDE))
    for name in ("coulomb", "quadratic", "bouc-wen"):
        first = stepped.respond(short, OUTPUTS, patch(LAWS[name]), replace(CONDITIONS, refinement=2)).values
        second = rig.respond(short, OUTPUTS, patch(LAWS[name]), replace(CONDITIONS, refinement=2)).values
        # steps may have been chosen differently: both are within their error
        assert np.max(np.abs(first - second), axis=0) == pytest.approx(0.0, abs=2e-4 * AMPLITUDE)
    stepped.close()


def test_an_fmu_that_is_not_linear_is_noticed_and_stepped(foreign_fmu: Any, tmp_path: Path) -> None:
    cubic = 0.3 * STIFFNESS / AMPLITUDE**2
    path = write(
        tmp_path,
        foreign_fmu("rig2"),
        ("release = {", f"motion = {{ parameters = {{ cubic = {cubic} }} }}\nrelease = {{"),
    )
    model = FmuModel.load(path)
    ones = Conditions(np.ones(2))
    case = trial(TrialKind.RINGDOWN, 150, release=Release(AMPLITUDE))
    friction = 0.03 * STIFFNESS * AMPLITUDE
    law = PowerDamping("slide", friction, 2.0, 0.0, FREQUENCY * AMPLITUDE, 1.0)

    def slope(_: float, state: FloatArray) -> list[float]:
        x, v = state
        drag = friction * (v / (FREQUENCY * AMPLITUDE)) ** 2 * np.sign(v)
        viscous = 2.0 * 0.01 * np.sqrt(STIFFNESS * 2.0) * v
        return [v, -(STIFFNESS * x + cubic * x**3 + viscous + drag) / 2.0]

    exact = solve_ivp(slope, (0.0, case.time[-1]), [AMPLITUDE, 0.0], t_eval=case.time, rtol=1e-10, atol=1e-12)
    mine = model.respond(case, OUTPUTS, patch(law), ones).values
    assert np.max(np.abs(mine[:, 0] - exact.y[0])) < 5e-4 * AMPLITUDE
    model.close()


def test_a_release_can_be_held_by_a_force(rig: FmuModel, foreign_fmu: Any, tmp_path: Path) -> None:
    path = write(
        tmp_path,
        foreign_fmu("rig2"),
        (
            'displacement = "release", velocity = "release_speed"',
            'hold = "slide.force", output = "slide.position"',
        ),
    )
    model = FmuModel.load(path)
    held = model.respond(RINGDOWN, OUTPUTS, patch(), CONDITIONS).values
    free = rig.respond(RINGDOWN, OUTPUTS, patch(), CONDITIONS).values
    assert np.max(np.abs(held - free)) < 1e-7 * np.max(np.abs(free[:, 0]))
    model.close()


# ---------------------------------------------------------------- hidden effects


def campaign(rig: FmuModel, lumped: LumpedModel, hidden: Primitive | None) -> Campaign:
    """Return trials of the lumped model, which has an effect that neither model knows of."""
    plan = plan_for(rig, ("displacement", "leaf_strain"), "mass")
    plan = replace(plan, duration=0.5 * plan.duration, interval=2.0 * plan.interval)
    changes = patch() if hidden is None else patch(hidden)
    return example_campaign(lumped, "laboratory", 4, plan, changes)


FEW = ("coulomb_friction", "cubic_stiffness", "gauge_gain", "load_cell")
"""A part of the catalogue: each further internal force costs a second or two."""


@pytest.mark.parametrize(
    ("hidden", "kind", "words"),
    [
        pytest.param(
            PowerDamping("slide", 0.008 * STIFFNESS * 0.008, 0.0, 0.0, 1.0, 1.0), VerdictKind.NAMED,
            "Coulomb friction at slide", marks=pytest.mark.long,
        ),
        (SensorGain("leaf_strain", 0.08), VerdictKind.NAMED, "gain error of a sensor at leaf_strain"),
        (None, VerdictKind.NOTHING_MISSING, ""),
    ],
)  # fmt: skip
def test_what_is_hidden_is_named_and_nothing_where_nothing_is(
    rig: FmuModel, lumped: LumpedModel, hidden: Primitive | None, kind: VerdictKind, words: str
) -> None:
    few = [effect for effect in load_catalogue() if effect.identifier in FEW]
    assert len(few) == len(FEW)
    found = investigate(campaign(rig, lumped, hidden), rig, few, thorough=False)
    assert found.verdict.kind is kind
    assert words in found.verdict.sentence


# ---------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('variable = "leaf"', 'variable = "laef"', "'laef', which is not a variable"),
        ('force = "slide.force",', 'force = "slide.speed",', "must be of causality input"),
        ('variable = "stiffness"', 'variable = "leaf"', "must be of causality parameter"),
        ('displacement = "slide.position", velocity = "slide.speed"', 'displacement = "slide.speed"',
         "is in 'm'"),
        ("scales = {", 'effects = { point_mass = "extra" }\nscales = {', "effect.extra.active"),
        ("scales = {", 'effects = { free_play = "gap" }\nscales = {', "internal forces act at ports"),
        ('name = "slide"', 'name = "slide", hinge = 1', "is not a key of an FMU model"),
        ("settle = true", "parameters = { respose = 1.0 }", "names 'respose', which is not a variable"),
        ('velocity = "release_speed"', 'hold = "slide.force"', "exactly one of displacement"),
        ("low = 0.7", "low = 1.7", "is not between low"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused_in_one_sentence(
    foreign_fmu: Any, tmp_path: Path, old: str, new: str, sentence: str
) -> None:
    with pytest.raises(ModelError) as refusal:
        FmuModel.load(write(tmp_path, foreign_fmu("rig2"), (old, new)))
    assert sentence in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_the_documented_file_is_one() -> None:
    page = (Path(__file__).parents[3] / "docs" / "fmu_models.md").read_text(encoding="utf-8")
    example = page.split("```toml\n")[1].split("```")[0]
    described = parse_fmu_model(tomllib.loads(example))
    assert described.effects == {"point_mass": "unmodelled_point_mass"}
    assert described.scales.length == 0.4


def test_missing_files_are_refused(tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.toml"
    wrong.write_text("format = ", encoding="utf-8")
    absent = write(tmp_path, Path("absent.fmu"))
    for path, words in (
        (tmp_path / "none.toml", "cannot be read"),
        (absent, r"absent\.fmu"),
        (wrong, "valid TOML"),
    ):
        with pytest.raises(ModelError, match=words):
            FmuModel.load(path)


@pytest.mark.parametrize(
    ("case", "changes", "outputs", "sentence"),
    [
        (LOADS, (PointMass(0.1, 0.2),), OUTPUTS, "cannot carry the primitive 'point_mass'"),
        (RINGDOWN, (FreePlay("tip", 1.0, 1.0),), OUTPUTS, "port 'tip', which this model does not have"),
        (trial(TrialKind.FLIGHT, 2, load_factor=np.ones(2)), (), OUTPUTS, "names no load_factor"),
        (replace(LOADS, load_place="wing tip"), (), OUTPUTS,
         "In the trial 'a trial' the load place is 'wing tip', and the FMU model"),
        (LOADS, (), (("x", Quantity.DISPLACEMENT),), "has no output 'x'"),
        (LOADS, (), (("displacement", Quantity.VELOCITY),), "is at rest"),
        (RINGDOWN, (PowerStiffness("slide", 1e9 * STIFFNESS * AMPLITUDE, 1.0, 0, AMPLITUDE),), OUTPUTS,
         "does not converge"),
    ],
)  # fmt: skip
def test_what_the_model_cannot_do_is_refused(
    rig: FmuModel, case: Trial, changes: tuple[Primitive, ...], outputs: Any, sentence: str
) -> None:
    with pytest.raises(ModelError) as refusal:
        rig.respond(case, outputs, patch(*changes), CONDITIONS)
    assert sentence in str(refusal.value)


def test_an_fmu_that_never_rests_is_refused(foreign_fmu: Any, tmp_path: Path) -> None:
    path = write(tmp_path, foreign_fmu("rig2"), ("step = 0.013", "step = 0.013, limit = 3.0"))
    model = FmuModel.load(path)
    with pytest.raises(ModelError, match=r"did not come to rest within 3 s: the output 'slide\.speed'"):
        model.respond(LOADS, OUTPUTS, patch(), CONDITIONS)
    model.close()
