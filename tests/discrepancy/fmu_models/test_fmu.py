"""FMUs as models against the lumped model of the same rig: rest, motion, laws at a port, refusals."""

import tomllib
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Campaign, Quantity, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.fmu_models.description import FmuModelDescription
from discrepancy.fmu_models.model import FmuModel
from discrepancy.model_choice import choose_model
from discrepancy.system.interface import Model
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.response import Conditions
from fe.runtime.patch import LoadGain, LoadPlace, ModelPatch, PowerDamping, PowerStiffness, Primitive
from fmu_asset.packing.script import build_script_fmu
from tests.discrepancy.rigs import INPUTS, FloatArray, asked, campaign, fmu_rig, integrated, laws
from tests.discrepancy.rigs import seen as shown

STIFFNESS, AMPLITUDE, FREQUENCY = 1974.0, 0.02, np.sqrt(987.0)
FORCE, SPEED = STIFFNESS * AMPLITUDE, FREQUENCY * AMPLITUDE
GIVEN: dict[str, Any] = {"parameters": np.array([1.02, 0.9])}
OUTPUTS = (("displacement", Quantity.DISPLACEMENT), ("leaf_strain", Quantity.STRAIN))
BOTH = (*OUTPUTS, ("displacement", Quantity.VELOCITY))
LAWS = laws("slide", STIFFNESS, AMPLITUDE, SPEED)
LUMPED = LumpedModel.load("single_mass_rig")


def trial(kind: TrialKind, time: Any = 300, **said: Any) -> Trial:
    return asked(kind, time, **{"load_place": "tip", **said})


def seen(model: Model, what: Trial, *items: Primitive, **given: Any) -> FloatArray:
    return shown(model, what, given.pop("outputs", OUTPUTS), *items, **GIVEN | given)


RINGDOWN = trial(TrialKind.RINGDOWN, release=Release(AMPLITUDE))
LOADS = trial(TrialKind.STATIC, 7, force=np.array([0.0, 5.0, 10.0, 15.0, 10.0, 5.0, -5.0]))
SHAKEN = trial(TrialKind.FORCED, force=8.0 * np.sin(28.0 * 0.01 * np.arange(300) + 2.0))


@pytest.fixture(scope="module")
def make(foreign_fmu, tmp_path_factory) -> Iterator[Callable[..., FmuModel]]:
    """A maker of models of the rig's file with texts replaced."""
    models: list[FmuModel] = []

    def load(*changes: tuple[str, str]) -> FmuModel:
        models.append(FmuModel.load(fmu_rig(tmp_path_factory.mktemp("rig"), foreign_fmu("rig2"), *changes)))
        return models[-1]

    yield load
    for model in models:
        model.close()


@pytest.fixture(scope="module")
def rig(make) -> FmuModel:
    return make()


@pytest.fixture(scope="module")
def stepped(make) -> FmuModel:
    return make(("isolated = false", "isolated = false\nsuperposition = false"))


def share(model: Model, exact: Model, what: Trial, *items: Primitive, n: int = 1, **given: Any) -> float:
    """The largest difference of two models as a share of each output's largest value."""
    mine = seen(model, what, *items, **given, refinement=n)
    other = seen(exact, what, *items, **given, refinement=32 if what.is_dynamic else 1)
    return float(np.max(np.max(np.abs(mine - other), axis=0) / np.max(np.abs(other), axis=0)))


# ---------------------------------------------------------------- the same rig twice


def test_a_changed_binding_is_another_model(foreign_fmu, tmp_path: Path) -> None:
    fmu = foreign_fmu("rig2")
    hashes = [choose_model(fmu_rig(tmp_path, fmu)).source_hash for _ in range(2)]
    assert hashes.pop() == hashes[0]
    path = fmu_rig(tmp_path, fmu, ("isolated", 'binding = "rig_binding.toml"\nisolated'))
    for changes in ((), (("50.0", "40.0"),)):
        (tmp_path / "rig_binding.toml").write_text(INPUTS.text("binding.toml", *changes), encoding="utf-8")
        hashes.append(choose_model(path).source_hash)
    assert len(set(hashes)) == 3


def test_scales_are_at_the_parameters_of_a_campaign(rig: FmuModel) -> None:
    given = Campaign("", {}, (LOADS,), None, {"stiffness_factor": (1.04, 0.01)}, "")
    assert rig.scales(given).tip_stiffness == pytest.approx(1.04 * STIFFNESS, rel=1e-7)
    assert rig.scales(campaign()).angular_frequency == pytest.approx(FREQUENCY, rel=1e-7)


CONSOLE = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Real

UNITS = {"F": "N", "M": "N.m", "T": "N.m"}

class Console(Fmi2Slave):
    unit_table = {"N": {"kg": 1, "m": 1, "s": -2}, "N.m": {"kg": 1, "m": 2, "s": -2}}
    variable_table = {name: ("input", unit, None, None, 0.0, name) for name, unit in UNITS.items()}
    variable_table["strain"] = ("output", None, None, None, None, "strain")

    def __init__(self, **options):
        super().__init__(**options)
        for name, row in self.variable_table.items():
            setattr(self, name, 0.0)
            self.register_variable(Real(name, causality=Fmi2Causality[row[0]]))

    def do_step(self, time, step):
        self.strain = 1e-6 * (3.0 * self.F + 5.0 * self.M + 7.0 * self.T)
        return True
"""


def test_a_force_elsewhere_is_the_force_with_its_moments(tmp_path: Path) -> None:
    (tmp_path / "console.py").write_text(CONSOLE, encoding="utf-8")
    build_script_fmu(tmp_path / "console.py", tmp_path / "console.fmu")
    (tmp_path / "console.toml").write_text(INPUTS.text("console.toml"), encoding="utf-8")
    with closing(FmuModel.load(tmp_path / "console.toml")) as model:
        moved = LoadPlace(along_span=0.5, along_chord=-0.2)
        found = shown(model, LOADS, (("strain", Quantity.STRAIN),), moved, parameters=np.zeros(0))
    np.testing.assert_allclose(found[:, 0], 1e-6 * (3.0 + 5.0 * 0.5 - 7.0 * 0.2) * LOADS.force, rtol=1e-12)


MOVED = {
    **{name: (RINGDOWN, several) for name, several in LAWS.items()},
    "shaken": (SHAKEN, ()),
    "shaken, coulomb": (SHAKEN, LAWS["coulomb"]),
    "shaken, bouc-wen": (SHAKEN, LAWS["bouc-wen"]),
    "shaken, gain": (SHAKEN, (LoadGain(0.1, 0.0),)),
}


@pytest.mark.parametrize(
    ("what", "items", "given", "largest"),
    [
        (LOADS, (), {}, 1e-9),
        (LOADS, (LoadGain(0.04, 0.5), LoadGain(0.1, 0.0)), {}, 1e-9),
        (RINGDOWN, (), {"outputs": BOTH}, 1e-11),
        # the unit of the velocity is w of the nominal rig here, that of the rig at hand there
        (replace(RINGDOWN, release=Release(AMPLITUDE, at_rest=False, mode_count=1)), (),
         {"parameters": np.array([1.0, 0.9]), "initial": np.array([[0.9, 0.3]])}, 1e-8),
        (RINGDOWN, (), {"clock": (2e-3, 3e-3), "initial": np.array([[0.05, 0.0]])}, 1e-11),
        (RINGDOWN, (), {"clock": (0.0, -0.03), "outputs": BOTH}, 1e-11),
        *((LOADS, LAWS[n], {}, 1e-9) for n in ("cubic", "crack", "free play", "micro-slip", "bouc-wen")),
        *((*MOVED[n], {}, 1e-11 if n == "shaken" else 2e-4) for n in MOVED),
    ],
)  # fmt: skip
def test_rest_and_motion_are_those_of_the_lumped_model(rig, what: Trial, items, given, largest) -> None:
    assert share(rig, LUMPED, what, *items, **given) < largest
    if what.is_dynamic:
        assert share(rig, LUMPED, what, *items, **given, n=4) < 1.5e-5


@pytest.mark.parametrize("first", [-2.0, -0.5, 3.7, 1e6])
def test_stamps_of_a_forced_record_begin_anywhere(rig, stepped, first: float) -> None:
    what = replace(SHAKEN, time=SHAKEN.time[:100] + first, force=SHAKEN.force[:100] + 5.0)
    assert share(rig, LUMPED, what, *LAWS["coulomb"]) < 4e-4
    assert share(stepped, LUMPED, what) < 4e-4


def first_100_samples(trial: Trial) -> Trial:
    return replace(trial, time=trial.time[:100], force=trial.force[:100])


@pytest.mark.parametrize("name", ["quadratic", "root of speed", "crack", "bouc-wen", "shaken, gain"])
def test_an_fmu_that_is_stepped_converges_to_the_lumped_model(stepped, name: str) -> None:
    """Second order; the root of the speed has no derivative at its turns."""
    trial, laws = MOVED[name]
    options: dict[str, Any] = {"clock": (0.0, -0.03), "outputs": BOTH} if trial is RINGDOWN else {}
    short = first_100_samples(trial)
    coarse = share(stepped, LUMPED, short, *laws, **options, n=1)
    fine = share(stepped, LUMPED, short, *laws, **options, n=4)
    order = np.log(coarse / fine) / np.log(4.0)
    assert coarse < 4e-4
    assert order > (1.4 if name == "root of speed" else 1.75)


@pytest.mark.parametrize("name", ["quadratic", "root of speed", "crack", "bouc-wen", "shaken, gain"])
def test_the_rate_of_a_speed_of_an_fmu_that_is_stepped_is_its_acceleration(stepped, name: str) -> None:
    trial, laws = MOVED[name]
    motion = tuple(("displacement", quantity) for quantity in Quantity.DISPLACEMENT.motion_chain)
    response = stepped.respond(first_100_samples(trial), motion, ModelPatch(laws), Conditions(**GIVEN))
    np.testing.assert_array_equal(response.rates[:, 1], response.values[:, 2])


def test_a_law_that_is_too_stiff_for_steps_is_refused(stepped) -> None:
    stiff = PowerStiffness("slide", 3e7 * FORCE, 1.0, 0, AMPLITUDE)
    with pytest.raises(ModelError, match=r"at slide does not converge .* halving steps of"):
        seen(stepped, trial(TrialKind.RINGDOWN, 20, release=Release(AMPLITUDE)), stiff)


def test_an_fmu_that_is_not_linear_is_noticed_and_stepped(make) -> None:
    cubic, friction = 0.3 * STIFFNESS / AMPLITUDE**2, 0.03 * FORCE
    model = make(("release = {", f"motion = {{ parameters = {{ cubic = {cubic} }} }}\nrelease = {{"))
    what = trial(TrialKind.RINGDOWN, 150, release=Release(AMPLITUDE))

    def slope(_: float, state: FloatArray) -> list[float]:
        x, v = state
        drag = friction * (v / SPEED) ** 2 * np.sign(v)
        viscous = 2.0 * 0.01 * np.sqrt(STIFFNESS * 2.0) * v
        return [v, -(STIFFNESS * x + cubic * x**3 + viscous + drag) / 2.0]

    mine = seen(model, what, PowerDamping("slide", friction, 2.0, 0.0, SPEED, 1.0), parameters=np.ones(2))
    exact = integrated(slope, what.time, [AMPLITUDE, 0.0])
    assert np.max(np.abs(mine[:, 0] - exact[:, 0])) < 5e-4 * AMPLITUDE


def test_a_port_whose_speed_jumps_with_a_force_is_stepped(foreign_fmu) -> None:
    """A plate in oil, x' = -2 x + 0.01 f, pulled by the spring of a law, f = -100 x."""
    file = INPUTS.table("plate.toml") | {"fmu": str(foreign_fmu("linear2"))}
    what, law = (
        trial(TrialKind.RINGDOWN, 60, release=Release(0.1)),
        PowerStiffness("plate", 10.0, 1.0, 0, 0.1),
    )
    given: dict[str, Any] = {"parameters": np.zeros(0), "outputs": {"displacement": Quantity.DISPLACEMENT}}
    with closing(FmuModel(FmuModelDescription.parse(file))) as model:
        found = seen(model, what, law, **given)[:, 0]
    assert found == pytest.approx(0.1 * np.exp(-3.0 * what.time), abs=1e-5)
    del file["port"][0]["velocity"]
    with (
        closing(FmuModel(FmuModelDescription.parse(file))) as model,
        pytest.raises(ModelError, match=r"the speed of a port jumps with a force, so its port 'plate' needs"),
    ):
        seen(model, what, law, **given)


@pytest.mark.parametrize("size", [0.0, 1.0])
def test_a_law_acts_on_the_place_of_a_port_that_is_not_zero_at_rest(foreign_fmu, size: float) -> None:
    """At rest the temperature holds it at 0.3."""
    description = INPUTS.table("aside.toml") | {"fmu": str(foreign_fmu("linear2"))}
    ringdown = trial(TrialKind.RINGDOWN, 60, release=Release(0.1), temperature=np.full(60, 0.3))
    law = PowerStiffness("mass", size, 3.0, 0, 0.1)
    outputs = {"displacement": Quantity.DISPLACEMENT}
    with closing(FmuModel(FmuModelDescription.parse(description))) as model:
        response = seen(model, ringdown, law, outputs=outputs, refinement=4, parameters=np.zeros(0))

    def rate(_: float, state: FloatArray) -> list[float]:
        displacement, speed = state
        force_of_law = size * ((displacement + 0.3) / 0.1) ** 3
        return [speed, -100.0 * displacement - 2.0 * speed - force_of_law]

    displacement, _ = integrated(rate, ringdown.time, [0.1, 0.0]).T
    assert response[:, 0] == pytest.approx(displacement + 0.3, abs=2e-5)


def test_a_release_can_be_held_by_a_force(rig: FmuModel, make) -> None:
    released = 'displacement = "release", velocity = "release_speed"'
    model = make((released, 'hold = "slide.force", output = "slide.position"'))
    held, free = (seen(which, RINGDOWN) for which in (model, rig))
    assert np.max(np.abs(held - free)) < 1e-7 * np.max(np.abs(free[:, 0]))


# ---------------------------------------------------------------- refusals


def test_the_documented_files_are_read() -> None:
    page = (Path(__file__).parents[3] / "docs" / "how_to" / "fmu_models.md").read_text(encoding="utf-8")
    texts = [part.split("```")[0] for part in page.split("```toml\n")[1:]]
    example, complete = (FmuModelDescription.model_validate(tomllib.loads(text)) for text in texts)
    assert [output.name for output in example.output] == ["tip", "strain[{1..4}]"]
    assert complete.effects == {"point_mass": "unmodelled_point_mass"}
    assert complete.scales.length == 0.4


def test_an_fmu_that_never_rests_is_refused(make) -> None:
    with pytest.raises(ModelError, match=r"did not come to rest within 3 s: the output 'slide\.speed'"):
        seen(make(("step = 0.013", "step = 0.013, limit = 3.0")), LOADS)
