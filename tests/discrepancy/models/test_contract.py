"""The contract of a model, lumped, a wing, a structure, an FMU: what it says, reads and refuses."""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from discrepancy.campaign.records import Hold, Quantity, Release, Trial, TrialKind
from discrepancy.errors import ModelError
from discrepancy.models.fmu import FmuModel
from discrepancy.models.interface import Model
from discrepancy.models.lumped import LumpedModel
from discrepancy.models.structures import SHIPPED_PRIOR, StructureModel, WingModel
from fe.runtime import patch
from fe.runtime.laws import LAWS
from fe.runtime.patch import (
    PRIMITIVES,
    FreePlay,
    LoadGain,
    LoadPlace,
    PointMass,
    PowerDamping,
    PowerStiffness,
)
from tests.discrepancy.asking import seen
from tests.discrepancy.asking import trial as asked
from tests.discrepancy.rigs import fmu_rig


@dataclass
class Kind:
    """A kind of model: an instance, a place of its loads, an output, a pace, what it is to say of itself."""

    model: Model
    place: str
    output: str
    pace: float
    ports: tuple[str, ...]
    stations: tuple[float, ...] | None
    parameters: tuple[str, ...]
    quantities: dict[str, Quantity | None]
    carried: set[str] = field(default_factory=set)

    def trial(self, kind: TrialKind, **said: Any) -> Trial:
        time = 0.005 * np.arange(len(next(iter(said.values()))) if said else 60)
        release = {"release": Release(0.02)} if kind is TrialKind.RINGDOWN else {}
        return asked(kind, time, **{"load_place": self.place, "run": "A", **release, **said})

    def seen(self, what: Trial, *items: Any, **given: Any) -> Any:
        means = np.array([parameter.mean for parameter in self.model.parameters])
        outputs = given.pop("outputs", {self.output: self.model.output_quantity(self.output)})
        return seen(self.model, what, outputs, *items, **{"parameters": means} | given)


SENSED = {
    "sensor_gain", "sensor_drift", "channel_offset", "sensor_rotation", "thermal_strain", "high_pass",
    "clock", "logger_clock", "line", "decaying_line", "run_offset",
}  # fmt: skip
FMU = SENSED | {law.kind for law in LAWS} | {"load_gain"}
LUMPED = FMU | {
    "port_load", "point_mass", "root_compliance", "modulus_temperature", "stiffness_drift", "load_place",
}  # fmt: skip


@pytest.fixture(scope="module", params=["lumped", "wing", "structure", "FMU"])
def kind(request, coarse_patch_arrays, pushed_beam, foreign_fmu, tmp_path_factory) -> Iterator[Kind]:
    if request.param == "lumped":
        quantities: dict[str, Quantity | None] = {"base_strain": Quantity.STRAIN, "nothing": None}
        chain = LumpedModel.load("three_mass_chain")
        names = tuple(item.name for item in chain.parameters)
        yield Kind(chain, "end", "x1", 28.0, ("joint", "end"), (0.2, 0.6), names, quantities, LUMPED)
    elif request.param == "structure":
        quantities = {"g1": Quantity.STRAIN, "shake": Quantity.ACCELERATION, "z1": None}
        yield Kind(
            StructureModel(pushed_beam[1]), "push", "tip", 2e3, ("tip",), None, ("e", "pump"), quantities,
            FMU | {"stiffness_drift"},
        )  # fmt: skip
    elif request.param == "wing":
        quantities = {
            "strain[3]": Quantity.STRAIN,
            "strain[77]": None,
            "displacement[0.5, 0.3]": Quantity.DISPLACEMENT,
        }
        yield Kind(
            WingModel(coarse_patch_arrays), "tip_load", "tip_displacement", 18.0 * np.pi,
            ("root", "tip", "span"), (0.0, 1.828), tuple(SHIPPED_PRIOR), quantities,
            set(PRIMITIVES) - {"port_load"},
        )  # fmt: skip
    else:
        model = FmuModel.load(fmu_rig(tmp_path_factory.mktemp("rig"), foreign_fmu("rig2")))
        quantities = {"leaf_strain": Quantity.STRAIN, "slide.position": None}
        names = ("stiffness_factor", "damping_factor")
        yield Kind(model, "mass", "displacement", 28.0, ("slide",), (0.0, 0.4), names, quantities, FMU)
        model.close()


def test_it_says_what_it_is_and_what_it_carries(kind: Kind) -> None:
    model = kind.model
    assert (model.ports, model.stations) == (kind.ports, kind.stations and pytest.approx(kind.stations))
    assert tuple(item.name for item in model.parameters) == kind.parameters
    assert all(item.low < item.mean < item.high for item in model.parameters)
    assert {name: model.output_quantity(name) for name in kind.quantities} == kind.quantities
    assert {name for name, primitive in PRIMITIVES.items() if model.supports(primitive)} == kind.carried


@pytest.mark.parametrize("how", [TrialKind.RINGDOWN, TrialKind.STATIC])
def test_what_changes_nothing_changes_no_bit(kind: Kind, how: TrialKind) -> None:
    what = kind.trial(how, **({"force": np.linspace(0.0, 5.0, 9)} if how is TrialKind.STATIC else {}))
    once = kind.seen(what)
    for items in ((), (patch.SensorGain("*", 0.5),), (LoadGain(0.0, 0.0),)):
        assert np.array_equal(kind.seen(what, *items), once)
    if isinstance(kind.model, LumpedModel | WingModel):
        assert np.array_equal(kind.seen(what, PointMass(0.0, 0.3)), once)
        wing = isinstance(kind.model, WingModel)
        fresh = WingModel(kind.model.wing.arrays) if wing else LumpedModel.load("three_mass_chain")
        assert np.array_equal(replace(kind, model=fresh).seen(what), once)


@pytest.mark.parametrize("hold", list(Hold))
@pytest.mark.parametrize("rubs", [False, True])
def test_a_coarse_force_does_between_its_samples_what_is_said(kind: Kind, hold: Hold, rubs: bool) -> None:
    """At nine samples a period, against the same force recorded a hundred times as fast."""
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
    wanted = kind.seen(replace(kind.trial(TrialKind.FORCED, force=between), time=fine), *laws)[::100]
    found, straight = (kind.seen(replace(coarse, hold=own), *laws, refinement=4) for own in (hold, None))
    largest = np.abs(wanted).max()
    # the fine record of what is held goes up within its first interval
    assert np.abs(found - wanted).max() < (5e-3 if hold is Hold.ZERO_ORDER else 1e-4) * largest
    assert (np.abs(straight - wanted).max() > 2e-2 * largest) == (hold is not Hold.LINEAR)


@pytest.mark.parametrize(
    ("how", "said", "sentence"),
    [
        (TrialKind.STATIC, {"outputs": {"x9": Quantity.DISPLACEMENT}}, "no output 'x9'"),
        (TrialKind.STATIC, {"quantity": Quantity.FORCE}, "is a displacement"),
        (TrialKind.STATIC, {"quantity": Quantity.VELOCITY}, "is at rest"),
        (TrialKind.STATIC, {"load_place": "nose"}, r"place (is )?'nose'"),
        (TrialKind.STATIC, {"items": (PowerStiffness("nose", 1.0, 3.0, 0, 1.0),)}, "port 'nose', which"),
        (TrialKind.RINGDOWN, {"release": None}, "does not say how it was released"),
        (TrialKind.STATIC, {"parameters": np.ones(9)}, "parameters, but 9 came"),
    ],
)
def test_what_cannot_be_answered_is_refused_in_a_sentence(kind: Kind, how, said, sentence: str) -> None:
    what, given = kind.trial(how, force=np.ones(3)), dict(said)
    what = replace(what, **{name: given.pop(name) for name in ("load_place", "release") if name in given})
    items = given.pop("items", ())
    if "quantity" in given:
        given = {"outputs": {kind.output: given["quantity"]}}
    with pytest.raises(ModelError, match=sentence):
        kind.seen(what, *items, **given)


@pytest.mark.parametrize(
    ("kind", "how", "said", "items", "sentence"),
    [
        ("lumped", TrialKind.FLIGHT, {}, (), "is a flight, but the model .* no input load_factor"),
        ("lumped", TrialKind.STATIC, {"load_place": (0.1, 0.2)}, (), "takes forces at"),
        ("lumped", TrialKind.STATIC, {}, (patch.Washout(0.1, 1.0),), "cannot carry the primitive 'washout'"),
        ("lumped", TrialKind.STATIC, {"load_place": "middle"}, (LoadPlace(0.1, 0.0),), "no station_deriv"),
        ("lumped", TrialKind.STATIC, {}, (PowerStiffness("end", -900.0, 3.0, 0, 1e-3),), "not found"),
        ("lumped", TrialKind.STATIC, {"temperature": np.full(3, 500.0)}, (patch.ModulusTemperature(2e-3),),
         "leaves 0 of the stiffness"),
        ("wing", TrialKind.STATIC, {}, (patch.LocalStiffnessLoss(1.2, 0.2, 0.5),), "leave some stiffness"),
        ("FMU", TrialKind.STATIC, {}, (PointMass(0.1, 0.2),), "cannot carry the primitive 'point_mass'"),
        ("FMU", TrialKind.RINGDOWN, {}, (FreePlay("tip", 1.0, 1.0),), "port 'tip', which this model does"),
        ("FMU", TrialKind.FLIGHT, {"load_factor": np.ones(3)}, (), "no input load_factor"),
        ("FMU", TrialKind.STATIC, {"load_place": "wing tip"}, (), "In the trial 'a trial' the load place is"),
    ],
    indirect=["kind"],
)  # fmt: skip
def test_what_a_kind_cannot_do_is_refused(kind: Kind, how: TrialKind, said, items, sentence: str) -> None:
    with pytest.raises(ModelError, match=sentence):
        kind.seen(replace(kind.trial(how, force=np.ones(3)), **said), *items)
