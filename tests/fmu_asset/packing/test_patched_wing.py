"""Effects of structure, loads and internal forces in the FMU, against the model of the naming side.

The wing is the chain of springs and masses, which both sides hold exactly; what can differ is the physics.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from discrepancy.campaign.records import Campaign, Channel, Quantity, Release, Trial, TrialKind
from discrepancy.files.document import Origin
from discrepancy.files.patch import StoredPatch, fmu_outputs, patch_effects, read_patch, write_patch
from discrepancy.models.interface import Conditions
from discrepancy.models.wing import WingModel
from discrepancy.verdict import NamedEffect, VerdictKind
from fe.runtime.patch import (
    STRUCTURE,
    BoucWen,
    FreePlay,
    InertiaRelief,
    LoadGain,
    LoadPlace,
    LocalStiffnessLoss,
    MicroSlip,
    ModelPatch,
    ModulusTemperature,
    PointMass,
    PowerDamping,
    PowerStiffness,
    Primitive,
    RootCompliance,
    SensorGain,
    SensorRotation,
    StiffnessDrift,
    Washout,
)
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.reduced import ReducedModel
from fmu_asset.door.binding import Binding, parse_binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuCallError, FmuInputError, PatchFileError
from fmu_asset.packing.patch_file import SCHEMA, PatchFile, load_patch, parse_patch
from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.slaves.effects import output_channels
from reporting.provenance import collect_provenance

OUTPUTS = [name for name, _ in output_channels(24)]
STATE = np.array([1.0, 0.169, 0.134, 1.0735, 7.3124e-4])
INTERVAL = 0.01
EFFECTS: dict[str, tuple[Primitive, ...]] = {
    "point_mass": (PointMass(0.2, 1.1),),
    "root": (RootCompliance(2e-4),),
    "local_loss": (LocalStiffnessLoss(0.4, 0.5, 0.5),),
    "warmer": (ModulusTemperature(2e-3),),
    "friction": (PowerDamping("tip", 3.0, 0.0, 0.0, 1.0, 1.0),),
    "structural_damping": (PowerDamping("tip", 4.0, 0.0, 1.0, 1.0, 0.02),),
    "air": (PowerDamping("span", 1.0, 2.0, 0.0, 0.5, 1.0),),
    "air_everywhere": (PowerDamping("planform", 1.0, 2.0, 0.0, 0.5, 1.0),),
    "cubic": (PowerStiffness("tip", 40.0, 3.0, 0, 0.02),),
    "cubic_everywhere": (PowerStiffness("planform", 400.0, 3.0, 0, 0.02),),
    "crack": (PowerStiffness("root", -200.0, 1.0, -1, 0.01),),
    "play": (FreePlay("tip", 900.0, 0.004),),
    "slip": (MicroSlip("tip", 12.0, 1500.0, -0.3, 8),),
    "slip_everywhere": (MicroSlip("planform", 12.0, 1500.0, -0.3, 8),),
    "bouc_wen": (BoucWen("tip", 800.0, 0.01, 1.5),),
    "drifting": (StiffnessDrift(-0.1),),
    "place": (LoadPlace(-0.06, 0.02),),
    "cell": (LoadGain(0.05, 0.4),),
    "washout": (Washout(0.08, 2.0),),
    "relief": (InertiaRelief(0.15),),
    "turned": (SensorRotation("strain[3]", 0.2),),
    "both": (LocalStiffnessLoss(0.2, 0.2, 0.3), PowerDamping("tip", 1.0, 0.0, 0.0, 1.0, 1.0),
             FreePlay("root", 1000.0, 1e-4)),
}  # fmt: skip
DYNAMIC = sorted(set(EFFECTS) - {"place", "cell", "washout", "relief", "turned", "warmer"})
STATIC = sorted(set(EFFECTS) - {"washout", "relief", "drifting"})


def patch_of(*names: str) -> PatchFile:
    rows = [{"id": name, "primitives": ModelPatch(EFFECTS[name]).to_list()} for name in names]
    return parse_patch(json.dumps({"schema": SCHEMA, "effects": rows}).encode())


@pytest.fixture(scope="session")
def patched(model: ReducedModel, arrays: PatchArrays, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("patched_wing") / "wing.fmu"
    return build_fmu(model, path, patch=patch_of(*EFFECTS), arrays=arrays).path


@pytest.fixture(scope="session")
def door() -> Binding:
    return parse_binding(
        {
            "binding": {"name": "all", "step_size": INTERVAL},
            "control": {"load_factor": {"variable": "load_factor", "unit": "1"}},
            "health": {name: {"variable": f"health.{name}", "unit": "1"} for name in ("z1", "z2")},
            "load": {
                "tip_force": {"variable": "tip_force", "unit": "N"},
                "temperature": {"variable": "temperature_difference", "unit": "K"},
            },
            "parameter": {
                "response": {"variable": "response", "unit": "1"},
                "release": {"variable": "initial_tip_displacement", "unit": "m"},
            },
            "observation": {"all": {"variables": OUTPUTS, "unit": ["1"] * 24 + ["m"] * 2}},
            "record": {"variables": ["frequency[1]", "damping_ratio[1]"]},
        }
    )


def sending(door: Binding, step_size: float = INTERVAL) -> Binding:
    """A binding that sends switches and a value of effects at every step."""
    record = door.model_dump(exclude_none=True, mode="json")
    record["binding"]["step_size"] = step_size
    record["load"] |= {
        "root": {"variable": "effect.root.active", "unit": "1"},
        "play": {"variable": "effect.play.active", "unit": "1"},
        "half_width": {"variable": "effect.play.half_width", "unit": "m"},
    }
    return parse_binding(record)


def on(*names: str) -> dict[str, float]:
    return {f"effect.{name}.active": 1.0 for name in names}


@pytest.fixture(scope="session")
def naming_side(arrays: PatchArrays) -> WingModel:
    return WingModel(arrays)


def trial(kind: TrialKind, count: int, release: float = 0.0, **given: object) -> Trial:
    zero = np.zeros(count)
    values: dict[str, object] = {
        "name": "trial",
        "kind": kind,
        "channels": (),
        "values": np.zeros((count, 0)),
        "used": np.zeros((count, 0), dtype=bool),
        "time": INTERVAL * np.arange(count),
        "force": zero,
        "load_factor": zero,
        "load_place": "tip_load",
        "temperature": zero,
        "start": 0.0,
        "run": "",
        "health": np.zeros((count, 2)),
        "health_deviation": np.zeros((count, 2)),
        "release": Release(release) if release else None,
    }
    return Trial(**(values | given))  # type: ignore[arg-type]


def expected(
    model: WingModel, given: Trial, patch: ModelPatch, health: Sequence[float] = (0.0, 0.0)
) -> np.ndarray:
    outputs = tuple((name, model.output_quantity(name) or Quantity.STRAIN) for name in OUTPUTS)
    bare = ModelPatch(tuple(item for item in patch if not isinstance(item, SensorRotation)))
    turned = len(bare) < len(patch)
    conditions = Conditions(STATE, health=np.array([health]))
    found = model.respond(given, outputs, bare, replace(conditions, components=turned))
    values = found.values.copy()
    for item in patch.of(SensorRotation):
        assert isinstance(item, SensorRotation)
        assert found.transverse is not None
        assert found.shear is not None
        c, s, gauge = np.cos(item.angle), np.sin(item.angle), OUTPUTS.index(item.channel)
        values[:, gauge] = (
            c**2 * values[:, gauge] + s**2 * found.transverse[:, gauge] + s * c * found.shear[:, gauge]
        )
    return values


def close(shown: np.ndarray, wanted: np.ndarray, tolerance: float = 1e-6) -> None:
    scale = np.abs(wanted[:, :24]).max(), np.abs(wanted[:, 24:]).max()
    assert np.abs(shown[:, :24] - wanted[:, :24]).max() <= tolerance * scale[0]
    assert np.abs(shown[:, 24:] - wanted[:, 24:]).max() <= tolerance * scale[1]


@pytest.mark.parametrize("name", DYNAMIC)
def test_ring_downs_are_those_of_the_naming_side(
    name: str, patched: Path, door: Binding, naming_side: WingModel, arrays: PatchArrays
) -> None:
    steps, tip = 60, 0.03
    patch = ModelPatch(EFFECTS[name])
    structure = PatchedWing(arrays).structure(1.0, (0.1, 0.0), STATE[1], STATE[2], patch.of(*STRUCTURE))
    shape = structure.static(arrays.load_tip)
    release = tip * float(arrays.load_tip @ shape) / float(arrays.tip_row @ shape)
    wanted = expected(naming_side, trial(TrialKind.RINGDOWN, steps + 1, release), patch, (0.1, 0.0))
    given = {"response": 2.0, "release": tip} | on(name)
    with FmiAsset(patched, door, isolated=False, parameters=given) as asset:
        asset.reset(control={"load_factor": 0.0}, health={"z1": 0.1})
        shown = [asset.observe().values] + [asset.step().values for _ in range(steps)]
    close(np.array(shown), wanted)
    plain = expected(naming_side, trial(TrialKind.RINGDOWN, steps + 1, release), ModelPatch(), (0.1, 0.0))
    assert np.abs(np.array(shown) - plain).max() > 1e-3 * np.abs(plain).max()


FORCES = np.array([2.0, 9.0, 15.0, 6.0, -3.0, -14.0, -5.0, 8.0])


@pytest.mark.parametrize("name", STATIC)
def test_static_states_are_those_of_the_naming_side(
    name: str, patched: Path, door: Binding, naming_side: WingModel
) -> None:
    warm = 5.0 * np.arange(len(FORCES)) / len(FORCES)
    given = trial(TrialKind.STATIC, len(FORCES), force=FORCES, temperature=warm)
    wanted = expected(naming_side, given, ModelPatch(EFFECTS[name]))
    with FmiAsset(patched, door, isolated=False, parameters=on(name)) as asset:
        asset.reset(control={"load_factor": 0.0})
        shown = [
            asset.step(load={"tip_force": force, "temperature": temperature}).values
            for force, temperature in zip(FORCES, warm, strict=True)
        ]
    close(np.array(shown), wanted)


@pytest.mark.parametrize("name", ["washout", "relief", "play", "local_loss", "both"])
def test_flights_are_those_of_the_naming_side(
    name: str, patched: Path, door: Binding, naming_side: WingModel
) -> None:
    factors = np.array([1.0, 2.0, 3.5, -0.5, 2.5])
    damage = np.column_stack((0.15 * np.arange(5), 0.1 * np.ones(5)))
    given = trial(TrialKind.FLIGHT, 5, load_factor=factors, time=np.arange(5.0))
    outputs = tuple((name, Quantity.STRAIN) for name in OUTPUTS[:24])
    patch = ModelPatch(EFFECTS[name])
    wanted = naming_side.respond(given, outputs, patch, Conditions(STATE, health=damage)).values
    with FmiAsset(patched, door, isolated=False, parameters=on(name)) as asset:
        asset.reset(control={"load_factor": 0.0})
        shown = [
            asset.step({"load_factor": n}, {"z1": z1, "z2": z2}).values[:24]
            for n, (z1, z2) in zip(factors, damage, strict=True)
        ]
    assert np.abs(np.array(shown) - wanted).max() <= 1e-6 * np.abs(wanted).max()


def flown(path: Path, door: Binding, steps: int, **parameters: float) -> np.ndarray:
    generator = np.random.default_rng(11)
    own = parse_binding(
        door.model_dump(exclude_none=True, mode="json")
        | {"load": {"tip_force": {"variable": "tip_force", "unit": "N"}}}
    )
    with FmiAsset(path, own, isolated=False, parameters=parameters) as asset:
        rows = []
        for _ in range(steps):
            n, z1, z2, force = generator.uniform([-1, 0, 0, -20], [4, 0.8, 0.8, 20]).tolist()
            seen = asset.step({"load_factor": n}, {"z1": z1, "z2": z2}, {"tip_force": force})
            rows.append([*seen.values, *seen.extra.values()])
        return np.array(rows)


@pytest.mark.parametrize("response", [1.0, 2.0])
def test_effects_that_are_off_or_have_no_magnitude_change_nothing(
    model: ReducedModel, patched: Path, door: Binding, response: float, tmp_path: Path
) -> None:
    """A wing that can be patched moves in six modes, which are iterated; the plain one has six here, too."""
    plain = build_fmu(replace(model, mode_count=6), tmp_path / "wing.fmu").path
    nothing = {"effect.root.active": 1.0, "effect.root.compliance": 0.0}
    nothing |= {"effect.play.active": 1.0, "effect.play.stiffness": 0.0}
    for further in ({}, nothing):
        for release in (0.0, 0.02):
            given = {"response": response, "release": release * (response == 2.0)}
            wanted = flown(plain, door, 25, **given)
            seen = flown(patched, door, 25, **given, **further)
            close(seen[:, :26], wanted[:, :26], 1e-9 if response == 1.0 else 5e-4)


def test_the_wing_stays_where_it_is_when_effects_come_and_go(patched: Path, door: Binding) -> None:
    given = {"response": 2.0, "release": 0.03}
    with FmiAsset(patched, sending(door, 1e-5), isolated=False, parameters=given) as asset:
        asset.reset(control={"load_factor": 1.0})
        seen = [asset.observe().values[-2]]
        for switches in (
            {},
            {"play": 1.0},
            {"play": 1.0, "root": 1.0},
            {"half_width": 0.002},
            {"play": 0.0},
            {"root": 0.0},
        ):
            seen.append(asset.step(load=switches).values[-2])
            seen.append(asset.step().values[-2])
    assert np.abs(np.diff(seen)).max() < 0.003 * 0.03


@pytest.mark.parametrize("response", [1.0, 2.0])
def test_state_with_hysteresis_goes_on_to_the_bit_in_a_new_process(
    patched: Path, door: Binding, response: float
) -> None:
    given = {"response": response} | on("slip", "bouc_wen", "friction", "local_loss")
    own = sending(door)
    with FmiAsset(patched, own, parameters=given) as one, FmiAsset(patched, own, parameters=given) as other:
        for force in (8.0, -11.0, 4.0):
            one.step({"load_factor": 0.5}, {"z1": 0.1}, {"tip_force": force})
        other.restore_state(one.save_state())
        for force in (15.0, -2.0):
            seen = [asset.step(load={"tip_force": force, "root": 1.0}) for asset in (one, other)]
            assert seen[0].values.tobytes() == seen[1].values.tobytes()
            assert seen[0].extra == seen[1].extra


def test_modal_outputs_are_those_of_the_patched_wing(
    patched: Path, door: Binding, naming_side: WingModel
) -> None:
    with FmiAsset(patched, sending(door), isolated=False, parameters=on("point_mass")) as asset:
        seen = asset.step({"load_factor": 1.0}, load={"root": 1.0}).extra["frequency[1]"]
        off = asset.step(load={"root": 0.0}).extra["frequency[1]"]
    patch = ModelPatch(EFFECTS["point_mass"] + EFFECTS["root"])
    wing = naming_side.wing
    assert seen == pytest.approx(wing.structure(1.0, (0.0, 0.0), 0.169, 0.134, patch).lowest(1).frequency[0])
    assert off > seen


def test_impossible_values_are_refused_and_change_nothing(patched: Path, door: Binding) -> None:
    given = {"response": 2.0, "release": 0.01}
    with FmiAsset(patched, sending(door), isolated=False, parameters=given) as asset:
        asset.step({"load_factor": 1.0}, load={"play": 1.0})
        before = asset.save_state()
        with pytest.raises(FmuCallError, match="half_width of 'free_play' must not be negative"):
            asset.step(load={"half_width": -1.0})
        seen = asset.step(load={"half_width": 0.004}).values
        asset.restore_state(before)
        assert asset.step().values.tobytes() == seen.tobytes()


def test_whole_numbers_are_whole(patched: Path, door: Binding) -> None:
    with FmiAsset(patched, door, isolated=False, parameters=on("slip", "crack")) as asset:
        asset.reset(control={"load_factor": 0.0})
        asset.step(load={"tip_force": 14.0})
        many = asset.step(load={"tip_force": -6.0}).values
    one = on("slip", "crack") | {"effect.slip.element_count": 1, "effect.crack.side": 0}
    with FmiAsset(patched, door, isolated=False, parameters=one) as asset:
        asset.reset(control={"load_factor": 0.0})
        asset.step(load={"tip_force": 14.0})
        single = asset.step(load={"tip_force": -6.0}).values
    assert np.abs(many - single).max() > 1e-3 * np.abs(many).max()
    for name, value in (("slip.element_count", 2.5), ("slip.element_count", 0), ("crack.side", 2)):
        with pytest.raises(FmuInputError):
            FmiAsset(patched, door, parameters={f"effect.{name}": value})


def test_what_has_no_bounds_is_refused(patched: Path, door: Binding) -> None:
    soft = on("crack") | {
        "effect.crack.side": 0,
        "effect.crack.coefficient": -1e9,
        "response": 2.0,
        "release": 0.001,
    }
    with pytest.raises(FmuCallError, match="takes more stiffness than the structure has"):
        FmiAsset(patched, door, parameters=soft).reset()
    wild = on("drifting") | {"effect.drifting.rate": -1e6, "response": 2.0, "release": 0.001}
    with (
        FmiAsset(patched, door, parameters=wild) as asset,
        pytest.raises(FmuCallError, match="is not finite"),
    ):
        asset.simulate({"load_factor": 0.0}, steps=2000)


def test_what_cannot_be_packed_is_refused(model: ReducedModel, arrays: PatchArrays, tmp_path: Path) -> None:
    for primitive, changed, given, sentence in (
        (EFFECTS["root"][0], {}, None, "give `arrays`"),
        (PointMass(0.1, 9.0), {}, arrays, "must lie on the wing"),
        (FreePlay("nose", 1.0, 1.0), {}, arrays, "'nose', which this model does not have"),
        (
            EFFECTS["crack"][0],
            {"side": 3},
            arrays,
            "side of 'power_stiffness' must lie from -1 to 1, but is 3",
        ),
    ):
        (record,) = ModelPatch((primitive,)).to_list()
        effects = [{"id": "wrong", "primitives": [record | changed]}]
        content = json.dumps({"schema": SCHEMA, "effects": effects}).encode()
        with pytest.raises(PatchFileError, match=sentence):
            build_fmu(model, tmp_path / "a.fmu", patch=parse_patch(content), arrays=given)
    assert not list(tmp_path.iterdir())


def test_the_patch_that_a_verdict_leaves_goes_into_the_fmu(
    model: ReducedModel, arrays: PatchArrays, fmu: Path, door: Binding, tmp_path: Path
) -> None:
    channels = {
        "g3": Channel("g3", Quantity.STRAIN, "strain[3]", None),
        "tip": Channel("tip", Quantity.DISPLACEMENT, "tip_displacement", None),
        "rate": Channel("rate", Quantity.VELOCITY, "tip_displacement", None),
    }
    campaign = Campaign("chain", channels, (), None, {}, "")
    outputs = fmu_outputs(campaign.channels)
    assert outputs == {"g3": "strain[3]", "tip": "tip_displacement"}
    patch = ModelPatch((SensorGain("g3", 0.25),))
    named = NamedEffect("gauge_gain", "Gauge gain", "g3", "gain", (), (), patch)
    origin = Origin("chain", "wing", "ab" * 32, "cd" * 32, "uav-twin", collect_provenance(1))
    stored = StoredPatch(VerdictKind.NAMED, "", patch_effects((named,)), outputs, (), origin)
    path = write_patch(tmp_path / "patch.json", stored)
    assert read_patch(path).channels == outputs
    packed = build_fmu(
        model, tmp_path / "wing.fmu", patch=load_patch(path), arrays=arrays, activate=True
    ).path
    record = door.model_dump(exclude_none=True, mode="json")
    del record["load"]["temperature"]
    rows = []
    for which in (fmu, packed):
        with FmiAsset(which, parse_binding(record), isolated=False) as asset:
            rows.append(asset.step({"load_factor": 2.0}).values)
    ratio = rows[1] / rows[0]
    assert ratio[2] == pytest.approx(1.25, rel=1e-14)
    assert np.all(np.delete(ratio, 2) == 1.0)
