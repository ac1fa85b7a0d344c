"""The contract of a model, lumped, a wing, a structure, an FMU: what it says, reads and refuses."""

import pickle
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.linalg import eigh

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Hold, Quantity, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.fmu_models.model import FmuModel
from discrepancy.system.interface import Model
from discrepancy.system.lumped_model import LumpedModel
from discrepancy.system.response import Conditions
from discrepancy.system.scales import Scales
from discrepancy.system.structures import StructureModel
from discrepancy.system.system_model import SystemModel
from discrepancy.system.system_state import SystemState
from discrepancy.system.wing_model import WingModel
from fe.runtime import patch
from fe.runtime.laws import LAWS
from fe.runtime.patch import (
    PRIMITIVES,
    FreePlay,
    LoadPlace,
    PointMass,
    PowerDamping,
    PowerStiffness,
    TableStiffness,
)
from tests.discrepancy.rigs import INPUTS, FloatArray, asked, campaign, fmu_rig, seen
from tests.refusals import refused

TABLE = INPUTS.table("kinds.toml")


@dataclass
class Kind:
    """A kind of model: an instance, and its row of `kinds.toml`."""

    model: Model
    place: str
    output: str
    pace: float
    ports: list[str]
    stations: list[float]
    parameters: list[str]
    quantities: dict[str, str]
    carried: list[str]

    def trial(self, kind: TrialKind, **said: Any) -> Trial:
        time = 0.005 * np.arange(len(next(iter(said.values()))) if said else 60)
        release = {"release": Release(0.02)} if kind is TrialKind.RINGDOWN else {}
        return asked(kind, time, **{"load_place": self.place, "run": "A", **release, **said})

    def seen(self, what: Trial, *items: Any, **given: Any) -> Any:
        outputs = given.pop("outputs", {self.output: self.model.output_quantity(self.output)})
        return seen(self.model, what, outputs, *items, **{"parameters": self.model.prior_mean()} | given)


@pytest.fixture(scope="module", params=TABLE["kind"])
def kind(request, coarse_patch_arrays, pushed_beam, foreign_fmu, tmp_path_factory) -> Iterator[Kind]:
    made = {
        "lumped": lambda: LumpedModel.load("three_mass_chain"),
        "structure": lambda: StructureModel(pushed_beam[1]),
        "wing": lambda: WingModel(coarse_patch_arrays),
        "FMU": lambda: FmuModel.load(fmu_rig(tmp_path_factory.mktemp("rig"), foreign_fmu("rig2"))),
    }
    found = Kind(made[request.param](), **TABLE["kind"][request.param])
    yield found
    if isinstance(found.model, FmuModel):
        found.model.close()


def test_it_says_its_ports_and_stations(kind: Kind) -> None:
    assert kind.model.ports == tuple(kind.ports)
    assert list(kind.model.stations or ()) == pytest.approx(kind.stations)


def test_it_says_its_parameters_with_their_ranges(kind: Kind) -> None:
    parameters = kind.model.parameters
    assert [parameter.name for parameter in parameters] == kind.parameters
    assert all(parameter.low < parameter.mean < parameter.high for parameter in parameters)


def test_it_says_the_quantities_of_its_outputs(kind: Kind) -> None:
    quantities = {name: kind.model.output_quantity(name) for name in kind.quantities}
    names = {name: quantity.value if quantity else "" for name, quantity in quantities.items()}
    assert names == kind.quantities


def test_it_says_which_primitives_it_carries(kind: Kind) -> None:
    laws = [law.kind for law in LAWS]
    carried = {name for item in kind.carried for name in (laws if item == "laws" else [item])}
    supported = {name for name, primitive in PRIMITIVES.items() if kind.model.supports(primitive)}
    assert supported == {*carried, *TABLE["sensors"]}


@dataclass(frozen=True)
class StiffnessAndMass:
    """Matrices of a kind of model, the row of its load, and the rows of its ports."""

    stiffness: FloatArray
    mass: FloatArray
    load_row: FloatArray
    port_rows: dict[str, FloatArray]

    @property
    def first_mode(self) -> tuple[float, FloatArray]:
        """Return the square of the first angular frequency, and its shape."""
        squares, shapes = eigh(self.stiffness, self.mass, subset_by_index=[0, 0])
        return float(squares[0]), shapes[:, 0]

    @property
    def deflection(self) -> FloatArray:
        """Return the displacements under a unit load."""
        return np.linalg.solve(self.stiffness, self.load_row)


def stiffness_and_mass(kind: Kind) -> StiffnessAndMass:
    """Return the matrices of a kind of model; those of the FMU are of its one mass."""
    model = kind.model
    if not isinstance(model, SystemModel):
        unit = np.ones(1)
        ports = dict.fromkeys(kind.ports, unit)
        return StiffnessAndMass(np.full((1, 1), 1974.0), np.full((1, 1), 2.0), unit, ports)
    state = SystemState(tuple(model.prior_mean()), (0.0,) * len(model.regions))
    system = model.system_in_state(state)
    ports = {name: model.port_rows[name] for name in kind.ports}
    return StiffnessAndMass(system.stiffness, system.mass, model.force_row(kind.place, state), ports)


@pytest.mark.parametrize("kind", ["lumped", "structure", "wing"], indirect=True)
def test_a_force_at_a_port_at_rest_changes_the_outputs_as_a_law_of_constant_force(kind: Kind) -> None:
    loads = kind.trial(TrialKind.STATIC, force=np.array([1.0, -2.0]))
    outputs = ((kind.output, kind.model.output_quantity(kind.output)),)
    at_rest = kind.model.ports_at_rest(loads, outputs, Conditions(kind.model.prior_mean()))
    for number, port in enumerate(at_rest.ports):
        if port not in kind.model.ports:
            continue  # one of the stations of a force that is spread
        constant_force = TableStiffness(port=port, displacements=(-1.0, 1.0), forces=(0.5, 0.5))
        change = kind.seen(loads, constant_force) - kind.seen(loads)
        np.testing.assert_allclose(change, -0.5 * at_rest.outputs_by_force[:, number], rtol=1e-7, atol=1e-15)


LARGEST_FORCE = 6.0


def scales_of(kind: Kind) -> Scales:
    """Return the scales in a campaign of loads of up to 6 N and a ring-down that begins at 100 s."""
    loads = kind.trial(TrialKind.STATIC, force=np.array([1.0, -LARGEST_FORCE]))
    ringdown = replace(kind.trial(TrialKind.RINGDOWN), start=100.0)
    return kind.model.scales(campaign(loads, ringdown))


def tolerance_of(kind: Kind) -> float:
    return 1e-5 if isinstance(kind.model, WingModel) else 1e-7


@pytest.mark.parametrize("kind", ["lumped", "wing", "FMU"], indirect=True)
def test_scales_are_those_of_stiffness_and_mass_and_of_what_acts(kind: Kind) -> None:
    matrices = stiffness_and_mass(kind)
    square, shape = matrices.first_mode
    expected = {
        "tip_stiffness": 1.0 / (matrices.load_row @ matrices.deflection),
        "modal_mass": float(matrices.load_row @ shape) ** -2,
        "angular_frequency": np.sqrt(square),
        "force": LARGEST_FORCE,
        "duration": 59 * 0.005,
        "campaign_time": 100.0 + 59 * 0.005,
        "length": kind.stations[-1],
    }
    scales = scales_of(kind)
    assert {name: getattr(scales, name) for name in expected} == pytest.approx(
        expected, rel=tolerance_of(kind)
    )


@pytest.mark.parametrize("kind", ["lumped", "wing", "FMU"], indirect=True)
def test_scales_of_a_port_are_those_of_its_motion_and_of_the_first_mode(kind: Kind) -> None:
    matrices = stiffness_and_mass(kind)
    square, shape = matrices.first_mode
    load_of_release = 0.02 / float(matrices.load_row @ matrices.deflection)
    for name, row in matrices.port_rows.items():
        port = scales_of(kind).ports[name]
        displacement = abs(row @ matrices.deflection) * max(LARGEST_FORCE, load_of_release)
        modal_stiffness = square / float(row @ shape) ** 2
        expected = pytest.approx((displacement, modal_stiffness), rel=tolerance_of(kind))
        assert (port.displacement, port.stiffness) == expected
        assert port.mean_power(3.0) == 1.0


@pytest.mark.parametrize("how", [TrialKind.RINGDOWN, TrialKind.STATIC])
def test_what_changes_nothing_changes_no_bit(kind: Kind, how: TrialKind) -> None:
    what = kind.trial(how, **({"force": np.linspace(0.0, 5.0, 9)} if how is TrialKind.STATIC else {}))
    once = kind.seen(what)
    for items in ((), (patch.SensorGain("*", 0.5),), (patch.LoadGain(0.0, 0.0),)):
        assert np.array_equal(kind.seen(what, *items), once)
    if isinstance(kind.model, LumpedModel | WingModel):
        assert np.array_equal(kind.seen(what, PointMass(0.0, 0.3)), once)
    handed = pickle.loads(pickle.dumps(kind.model))  # to another process, without what is kept
    assert np.array_equal(replace(kind, model=handed).seen(what), once)
    if isinstance(handed, FmuModel):
        handed.close()


@pytest.mark.parametrize("hold", list(Hold))
@pytest.mark.parametrize("rubs", [False, True])
def test_a_coarse_force_does_between_its_samples_what_is_said(kind: Kind, hold: Hold, rubs: bool) -> None:
    """At nine samples a period, against the same force recorded a hundred times as fast.

    A clock that is half an interval late shows what there is between.
    """
    pace = 2.0 * np.pi / 9.0 / kind.pace
    time, fine = pace * np.arange(120), pace * np.arange(11901) / 100
    force = 3.0 * np.sin(kind.pace * time)
    laws = [PowerDamping(kind.ports[-1], 0.3, 0.0, 0.0, 1.0, 1.0)] * rubs
    coarse = replace(kind.trial(TrialKind.FORCED, force=force), time=time)
    between = {
        Hold.LINEAR: np.interp(fine, time, force),
        Hold.SMOOTH: CubicSpline(time, force)(fine),
        Hold.ZERO_ORDER: force[np.maximum(np.arange(len(fine)) - 1, 0) // 100],
    }[hold]
    exact = kind.seen(replace(kind.trial(TrialKind.FORCED, force=between), time=fine), *laws)
    wanted = exact[::100]
    found, straight = (kind.seen(replace(coarse, hold=own), *laws, refinement=4) for own in (hold, None))
    late = kind.seen(replace(coarse, hold=hold), *laws, clock=(0.0, 0.5 * pace))
    largest = np.abs(wanted).max()
    # the fine record of what is held goes up within its first interval
    least = (5e-3 if hold is Hold.ZERO_ORDER else 1e-4) * largest
    assert np.abs(found - wanted).max() < least
    assert np.abs(late[:-1] - exact[50::100]).max() < max(least, 3e-3 * largest)
    assert (np.abs(straight - wanted).max() > 2e-2 * largest) == (hold is not Hold.LINEAR)


@pytest.mark.parametrize("change", ["none", "spring", "drift"])
def test_rates_are_derivatives(kind: Kind, change: str) -> None:
    """In a motion that is held for 150 ms / pace before its release, at even stamps and with a gap."""
    time = np.delete(0.003 / kind.pace * np.arange(1501), 999 if change == "drift" else -1)
    what = replace(kind.trial(TrialKind.RINGDOWN), time=time)
    outputs = [(kind.output, quantity) for quantity in Quantity.DISPLACEMENT.motion_chain]
    outputs += [(name, Quantity(quantity)) for name, quantity in kind.quantities.items() if quantity]
    items = patch.ModelPatch(
        tuple(
            item
            for name, item in (
                ("spring", PowerStiffness(kind.ports[-1], 3e-2, 3.0, 0, 1e-2)),
                ("drift", patch.StiffnessDrift(0.05 * kind.pace)),
            )
            if name == change and kind.model.supports(type(item))
        )
    )
    conditions = Conditions(kind.model.prior_mean(), clock=(0.0, -0.15 / kind.pace))
    found = kind.model.respond(what, tuple(outputs), items, conditions)
    assert not found.values[:48, 1:3].any()
    assert not found.rates[:48].any()
    assert not np.ptp(kind.seen(what, clock=(0.0, -1e3)), axis=0).any()
    slope, seen_later = np.gradient(found.values, what.time, axis=0), slice(150, -5)  # what is left out fades
    scale = np.abs(slope).max(axis=0)
    np.testing.assert_allclose(found.rates[seen_later] / scale, slope[seen_later] / scale, atol=2e-3)


OF_ALL = [
    (TrialKind.STATIC, {"outputs": {"x9": Quantity.DISPLACEMENT}}, (), "no output 'x9'"),
    (TrialKind.STATIC, {"quantity": Quantity.FORCE}, (), "is a displacement"),
    (TrialKind.STATIC, {"quantity": Quantity.VELOCITY}, (), "is at rest"),
    (TrialKind.STATIC, {"load_place": "nose"}, (), r"place (is )?'nose'"),
    (TrialKind.STATIC, {}, (PowerStiffness("nose", 1.0, 3.0, 0, 1.0),), "port 'nose', which"),
    (TrialKind.RINGDOWN, {"release": None}, (), "does not say how it was released"),
    (TrialKind.STATIC, {"parameters": np.ones(9)}, (), "parameters, but 9 were given"),
]


@pytest.mark.parametrize(
    ("kind", "how", "said", "items", "sentence"),
    [
        *((name, *row) for name in TABLE["kind"] for row in OF_ALL),
        ("lumped", TrialKind.FLIGHT, {}, (), "is a flight, but the model .* no input load_factor"),
        ("lumped", TrialKind.STATIC, {"load_place": (0.1, 0.2)}, (), "takes forces at"),
        ("lumped", TrialKind.STATIC, {}, (patch.PortLoad("end", "time"),), "has no times, but a law"),
        ("lumped", TrialKind.STATIC, {}, (patch.Washout(0.1, 1.0),), "cannot carry the primitive 'washout'"),
        ("lumped", TrialKind.STATIC, {"load_place": "middle"}, (LoadPlace(0.1, 0.0),), "no station_deriv"),
        ("lumped", TrialKind.STATIC, {}, (PowerStiffness("end", -900.0, 3.0, 0, 1e-3),), "not found"),
        ("lumped", TrialKind.STATIC, {"temperature": np.full(3, 500.0)}, (patch.ModulusTemperature(2e-3),),
         "the factor on the stiffness would be 0"),
        ("wing", TrialKind.STATIC, {}, (patch.LocalStiffnessLoss(1.2, 0.2, 0.5),), "leave some stiffness"),
        ("FMU", TrialKind.STATIC, {}, (PointMass(0.1, 0.2),), "cannot carry the primitive 'point_mass'"),
        ("FMU", TrialKind.RINGDOWN, {}, (FreePlay("tip", 1.0, 1.0),), "port 'tip', which this model does"),
        ("FMU", TrialKind.FLIGHT, {"load_factor": np.ones(3)}, (), "no input load_factor"),
        ("FMU", TrialKind.STATIC, {"load_place": "wing tip"}, (), "In the trial 'a trial' the load place is"),
    ],
    indirect=["kind"],
)  # fmt: skip
def test_what_cannot_be_answered_is_refused_in_a_sentence(kind: Kind, how, said, items, sentence) -> None:
    given = dict(said)
    of_trial = {name: given.pop(name) for name in said if name in {item.name for item in fields(Trial)}}
    what = replace(kind.trial(how, force=np.ones(3)), **of_trial)
    if "quantity" in given:
        given = {"outputs": {kind.output: given["quantity"]}}
    with pytest.raises(ModelError, match=sentence):
        kind.seen(what, *items, **given)


ROWS = [
    *((name, *row) for name in ("two_masses", "rig") for row in INPUTS.refused(name)),
    *INPUTS.refused("rigs"),
]


@pytest.mark.parametrize(("name", "old", "new", "sentence"), ROWS)
def test_a_wrong_file_is_refused_in_one_sentence(
    tmp_path: Path, foreign_fmu, name: str, old: str, new: str, sentence: str
) -> None:
    file = tmp_path / "model.toml"
    changes = [("{fmu}", str(foreign_fmu("rig2")))] * (name == "rig")
    file.write_text(INPUTS.text(f"{name}.toml", *changes, (old, new)))
    with refused(ModelError, sentence if name == "rig" else f"model.toml.*({sentence})"):
        (FmuModel if name == "rig" else LumpedModel).load(file)
