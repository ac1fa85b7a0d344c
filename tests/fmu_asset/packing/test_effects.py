"""Missing effects in the FMU: of sensors against records, of the wing against the naming side."""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy import read_model_description
from numpy.typing import NDArray

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Quantity, Trial, TrialKind
from discrepancy.system.response import ACROSS, Conditions
from discrepancy.system.wing_model import WingModel
from fe.high_pass import filtered_record
from fe.runtime.patch import STRUCTURE, ModelPatch, SensorRotation
from fe.runtime.sensors import SensorRecord, apply_sensors
from fe.runtime.state import DigitalState
from fmu_asset.client.session import FmiAsset
from fmu_asset.errors import FmuCallError, FmuInputError, PatchFileError
from fmu_asset.packing.patch_file import parse_patch
from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.slaves.effects import output_channels
from tests.command_line import command, refused, said
from tests.fmu_asset.client.kinds import BINDINGS, KINDS
from tests.fmu_asset.making import tables
from tests.fmu_asset.ours import wing_arrays
from tests.refusals import refused as refused_on_one_line

HERE = Path(__file__).parent
REFUSED = tables(__file__)
FloatArray = NDArray[np.float64]


def read_effects(name: str) -> dict[str, Any]:
    """Return the primitives of each effect of a patch file."""
    effects = json.loads((HERE / name).read_text("utf-8"))["effects"]
    return {effect["id"]: effect["primitives"] for effect in effects}


SENSOR_EFFECTS = read_effects("sensors.json")
WING_EFFECTS = read_effects("wing.json")
SENSING = KINDS["effects of sensors"].binding
PATCHED = KINDS["hysteresis"].binding
WARM = PATCHED.model_copy(
    update={"load": {name: PATCHED.load[name] for name in ("tip_force", "temperature")}}
)
"""The binding of the patched wing without what switches effects."""
CHANNELS = output_channels(24)
OUTPUTS = [name for name, _ in CHANNELS]
GAUGES = slice(24)
"""Columns of the strains; the displacements of the tip and of the load point follow."""
DISPLACEMENTS = slice(24, 26)
ALL_OUTPUTS = slice(26)


def patch_file(effects: Mapping[str, Sequence[Any]] = SENSOR_EFFECTS) -> bytes:
    """Return a patch file: that of the sensors with other effects."""
    record = json.loads((HERE / "sensors.json").read_text("utf-8"))
    rows = [
        {"id": name, "place": "anywhere", "primitives": primitives}
        for name, primitives in effects.items()
    ]
    return json.dumps(record | {"effects": rows}).encode()


def switch_on(*names: str) -> dict[str, float]:
    """Return the parameters that switch effects on."""
    return {f"effect.{name}.active": 1.0 for name in names}


def fly(
    fmu: Path, rows: Sequence[Sequence[float]], start: float = 0.0, **parameters: float
) -> FloatArray:
    """Return all outputs at the start and after steps of 50 ms of load factor and tip force."""
    binding = BINDINGS["watched"].with_header(step_size=0.05, start_time=start)
    (first_load_factor, _), *_ = rows
    with FmiAsset(fmu, binding, isolated=False, parameters=parameters) as asset:
        asset.reset(control={"load_factor": first_load_factor})
        outputs = [asset.observe().values]
        for load_factor, tip_force in rows:
            step = asset.step({"load_factor": load_factor}, load={"tip_force": tip_force})
            outputs.append(step.values)
    return np.array(outputs)


# ---------------------------------------------------------------------- descriptions


@pytest.fixture(scope="module")
def plain_description(fmu):
    return read_model_description(str(fmu))


@pytest.fixture(scope="module")
def sensing_description(sensing):
    return read_model_description(str(sensing))


def test_effects_add_variables_at_the_end(plain_description, sensing_description):
    plain = plain_description.modelVariables
    sensing = sensing_description.modelVariables

    assert len(sensing) > len(plain)
    for expected, variable in zip(plain, sensing, strict=False):
        facts = (variable.name, variable.valueReference, variable.start)
        assert facts == (expected.name, expected.valueReference, expected.start)


def test_the_identity_follows_from_the_effects_and_from_what_is_on(
    sensing_description, model, tmp_path
):
    patch = parse_patch(patch_file())
    active = build_fmu(model, tmp_path / "on.fmu", patch=patch, activate=True)
    half_gain = SENSOR_EFFECTS | {"gauge_gain": SENSOR_EFFECTS["gauge_gain"][:1]}
    other = build_fmu(model, tmp_path / "other.fmu", patch=parse_patch(patch_file(half_gain)))

    assert len({sensing_description.guid, active.guid, other.guid}) == 3


# ---------------------------------------------------------------------- sensors


@dataclass(frozen=True)
class SensorFlight:
    """A flight of the wing, without effects and with those of sensors.

    Attributes
    ----------
    rows : list of tuple
        Load factor and force at the tip of each step.
    plain, off, on : (N, C) array
        Outputs of the plain FMU, and of the FMU with effects that are switched off and on.
    record : SensorRecord
        The record that the effects act on.
    tolerance : float
        Relative, of the values of a channel: of the largest one in motion, else of each.
    """

    rows: list[tuple[float, float]]
    plain: FloatArray
    off: FloatArray
    on: FloatArray
    record: SensorRecord
    tolerance: float


@pytest.fixture(scope="module")
def quasi_static_flight(fmu, sensing) -> SensorFlight:
    """Records begin with the first step."""
    rows = [(1.0, 0.0), (2.0, 0.0), (-1.0, 0.0), (3.0, 0.0)]
    parameters = {"response": 1.0, "release": 0.0}
    time = 0.05 * np.arange(1, len(rows) + 1)
    return SensorFlight(
        rows=rows,
        plain=fly(fmu, rows, **parameters)[1:],
        off=fly(sensing, rows, **parameters)[1:],
        on=fly(sensing, rows, **parameters, **switch_on(*SENSOR_EFFECTS))[1:],
        record=SensorRecord(CHANNELS, "flight", time, 0.0, np.zeros(len(time))),
        tolerance=1e-13,
    )


@pytest.fixture(scope="module")
def release_flight(fmu, sensing) -> SensorFlight:
    """Records begin with the release at 2 s."""
    rows = [(0.0, 0.0)] * 80
    parameters = {"response": 2.0, "release": 0.03}
    time = 0.05 * np.arange(len(rows) + 1)
    return SensorFlight(
        rows=rows,
        plain=fly(fmu, rows, start=2.0, **parameters),
        off=fly(sensing, rows, start=2.0, **parameters),
        on=fly(sensing, rows, start=2.0, **parameters, **switch_on(*SENSOR_EFFECTS)),
        record=SensorRecord(CHANNELS, "ringdown", time, 2.0, np.zeros(len(time)), release=0.03),
        tolerance=1e-12,
    )


@pytest.fixture(params=["quasi_static_flight", "release_flight"])
def flight(request) -> SensorFlight:
    return request.getfixturevalue(request.param)


def test_effects_that_are_off_change_no_bit(flight):
    assert flight.off.tobytes() == flight.plain.tobytes()


def test_effects_of_the_wing_that_are_off_change_no_bit(quasi_static_flight, patched):
    outputs = fly(patched, quasi_static_flight.rows)[1:]

    assert outputs.tobytes() == quasi_static_flight.plain.tobytes()


def test_effects_of_sensors_are_those_of_whole_records(flight):
    effects = parse_patch(patch_file()).for_gauges(24).effects
    patch = ModelPatch(tuple(primitive for effect in effects for primitive in effect.patch))

    expected, _ = apply_sensors(patch, flight.record, flight.plain, high_pass=filtered_record)

    scale = np.abs(expected)
    if flight.record.kind == "ringdown":
        scale = scale.max(axis=0)
    assert (np.abs(flight.on - expected) <= flight.tolerance * scale).all()
    assert not np.allclose(flight.on, flight.plain)


def test_gauges_that_saturate_show_the_formula_and_displacements_stay(fmu, sensing):
    """One limit for all gauges, of an order with the strains; the tip has a limit of its own."""
    rows = [(1.0, 0.0), (3.0, 0.0), (-2.0, 0.0)]
    plain = fly(fmu, rows)
    strain = plain[:, GAUGES]
    tip, load_point = plain[:, DISPLACEMENTS].T
    assert np.abs(strain).max() > 2e-3

    saturated = fly(sensing, rows, **switch_on("saturation"))

    saturated_tip, saturated_load_point = saturated[:, DISPLACEMENTS].T
    expected_strain = 4e-3 * np.tanh(strain / 4e-3)
    np.testing.assert_allclose(saturated[:, GAUGES], expected_strain, rtol=1e-13)
    np.testing.assert_allclose(saturated_tip, 0.9 * np.tanh(tip / 0.9), rtol=1e-13)
    np.testing.assert_array_equal(saturated_load_point, load_point)


# ---------------------------------------------------------------------- switches

DRIFTING_GAUGE = 16
"""The index of the gauge whose drift is switched."""


@pytest.fixture(scope="module")
def plain_at_2g(fmu) -> FloatArray:
    """All outputs of the wing without effects at 2 g."""
    _, outputs = fly(fmu, [(2.0, 0.0)])
    return outputs


@pytest.fixture
def sensing_asset(sensing) -> Iterator[FmiAsset]:
    with FmiAsset(sensing, SENSING, isolated=False) as asset:
        yield asset


def test_an_effect_is_switched_between_steps(sensing_asset, plain_at_2g):
    """The drift goes on with the time while it is off."""
    plain = plain_at_2g[DRIFTING_GAUGE]

    readings = []
    for drift in (0.0, 1.0, 0.0, 1.0):
        step = sensing_asset.step({"load_factor": 2.0}, load={"drift": drift})
        readings.append(step.values[DRIFTING_GAUGE])

    off, first_drift, off_again, second_drift = readings
    assert off == off_again == plain
    assert first_drift - plain == pytest.approx(4e-5 * math.sqrt(0.1 / 10.0), rel=1e-9)
    assert second_drift - plain == pytest.approx(4e-5 * math.sqrt(0.2 / 10.0), rel=1e-9)


def test_a_temperature_without_its_effect_changes_nothing(sensing_asset, plain_at_2g):
    warm = sensing_asset.step({"load_factor": 2.0}, load={"drift": 0.0, "temperature": 5.0})

    np.testing.assert_array_equal(warm.values, plain_at_2g)


def test_a_switch_outside_its_range_is_refused(sensing_asset):
    with pytest.raises(FmuInputError, match="range"):
        sensing_asset.step(load={"drift": 1.5})


def test_a_temperature_strains_all_gauges(sensing):
    with FmiAsset(
        sensing, SENSING, isolated=False, parameters=switch_on("thermal_strain")
    ) as asset:
        cold = asset.step({"load_factor": 1.0}).values
        warm = asset.step(load={"temperature": 4.0}).values

    np.testing.assert_allclose(warm - cold, [4.8e-5] * 24 + [0.0] * 2, rtol=1e-9)


@pytest.mark.parametrize(
    ("which", "parameters", "first", "wrong", "right", "sentence"), REFUSED["values"]
)
def test_impossible_values_are_refused_and_change_nothing(
    ours, which, parameters, first, wrong, right, sentence
):
    binding = {"sensing": SENSING, "patched": PATCHED}[which]
    in_motion = parameters | {"response": 2.0}
    with FmiAsset(ours(which), binding, isolated=False, parameters=in_motion) as asset:
        asset.step({"load_factor": 1.0}, load=first)
        state = asset.save_state()
        with pytest.raises(FmuCallError, match=sentence):
            asset.step({"load_factor": 3.0}, load=wrong)
        after_refusal = asset.step({"load_factor": 3.0}, load=right)

        asset.restore_state(state)
        without_refusal = asset.step({"load_factor": 3.0})

    assert without_refusal.values.tobytes() == after_refusal.values.tobytes()


# ---------------------------------------------------------------- the wing and the naming side

START = DigitalState()
STATE = np.array([1.0, START.servo_mass, START.pitot_mass, START.damping_alpha, START.damping_beta])
FORCES = np.array([2.0, 9.0, 15.0, 6.0, -3.0, -14.0, -5.0, 8.0])
LOAD_FACTORS = np.array([1.0, 2.0, 3.5, -0.5, 2.5])
NO_EFFECT: dict[str, dict[str, float]] = {
    "nothing": {},
    "of no magnitude": {
        **switch_on("root", "play"),
        "effect.root.compliance": 0.0,
        "effect.play.stiffness": 0.0,
    },
}
"""Parameters of flights that no effect changes."""
IN_FLIGHT_ALONE = {"washout", "relief"}
OF_RINGDOWNS = sorted(set(WING_EFFECTS) - IN_FLIGHT_ALONE - {"place", "cell", "turned", "warmer"})
OF_STATIC_TESTS = sorted(set(WING_EFFECTS) - IN_FLIGHT_ALONE - {"drifting"})
OF_FLIGHTS = ["washout", "relief", "play", "local_loss", "both"]


@pytest.fixture(scope="module")
def patched_wing(patched: Path) -> Iterator[FmiAsset]:
    """The wing with effects, which each test starts anew."""
    with FmiAsset(patched, WARM, isolated=False) as asset:
        yield asset


@pytest.fixture(scope="module")
def naming_side() -> WingModel:
    """The model of the wing that names effects."""
    return WingModel(wing_arrays())


def patch_of(*names: str) -> ModelPatch:
    """Return the patch of effects of the wing; one that is not there has no primitives."""
    primitives = [primitive for name in names for primitive in WING_EFFECTS.get(name, ())]
    return ModelPatch.from_list(primitives)


@dataclass(frozen=True)
class Flown:
    """What the FMU and the naming side fly.

    Attributes
    ----------
    trial : Trial
        For the naming side.
    parameters : dict
        Of the FMU, without those of effects.
    course : dict
        Arguments of `simulate`.
    health : (H, 2) array
        Losses of both regions, of all steps or of each.
    columns : slice
        The outputs that are compared.
    shows_start : bool
        Whether the record begins with the start of the FMU, before its first step.
    """

    trial: Trial
    parameters: dict[str, float]
    course: dict[str, Any]
    health: FloatArray
    columns: slice
    shows_start: bool = False

    @property
    def start_health(self) -> dict[str, float]:
        z1, z2 = self.health[0]
        return {"z1": z1, "z2": z2}


def ringdown(patch: ModelPatch, naming_side: WingModel) -> Flown:
    """Return a release from 3 cm at the load point of a damaged wing."""
    arrays = wing_arrays()
    health = np.array([[0.1, 0.0]])
    _, servo_mass, pitot_mass, *_ = STATE
    state = np.array([1.0, *health[0], servo_mass, pitot_mass, 1.0, 0.0])
    structure = naming_side.wing.structure_at(state, patch.of(*STRUCTURE))
    shape = structure.static(arrays.load_tip)
    load_point_over_tip = float(arrays.load_tip @ shape) / float(arrays.tip_row @ shape)
    release = Release(0.03 * load_point_over_tip)
    trial = Trial.plain("trial", TrialKind.RINGDOWN, (), 0.01 * np.arange(31), release=release)
    return Flown(
        trial=trial,
        parameters={"response": 2.0, "release": 0.03},
        course={"steps": 30},
        health=health,
        columns=ALL_OUTPUTS,
        shows_start=True,
    )


def static_test() -> Flown:
    """Return forces at the tip of a wing that becomes warmer."""
    number = np.arange(len(FORCES))
    temperature = 5.0 * number / len(FORCES)
    trial = Trial.plain(
        "trial", TrialKind.STATIC, (), 0.01 * number, force=FORCES, temperature=temperature
    )
    return Flown(
        trial=trial,
        parameters={},
        course={"load": {"tip_force": FORCES, "temperature": temperature}},
        health=np.zeros((1, 2)),
        columns=ALL_OUTPUTS,
    )


def manoeuvres() -> Flown:
    """Return load factors of a wing whose damage grows; gauges alone are compared."""
    time = np.arange(5)
    z1 = 0.15 * time
    z2 = 0.1 * np.ones(5)
    trial = Trial.plain("trial", TrialKind.FLIGHT, (), 1.0 * time, load_factor=LOAD_FACTORS)
    return Flown(
        trial=trial,
        parameters={},
        course={"control": {"load_factor": LOAD_FACTORS}, "health": {"z1": z1, "z2": z2}},
        health=np.column_stack((z1, z2)),
        columns=GAUGES,
    )


def outputs_of_naming_side(model: WingModel, flown: Flown, patch: ModelPatch) -> FloatArray:
    """Return the compared outputs of the naming side; a rotated gauge is turned here."""
    bare = ModelPatch(
        tuple(primitive for primitive in patch if not isinstance(primitive, SensorRotation))
    )
    channels = tuple((name, Quantity(quantity)) for name, quantity in CHANNELS)
    conditions = Conditions(STATE, health=flown.health)
    values = model.respond(flown.trial, channels, bare, conditions).values.copy()
    for rotation in patch.of(SensorRotation):
        c = np.cos(rotation.angle)
        s = np.sin(rotation.angle)
        gauge = OUTPUTS.index(rotation.channel)
        name, _ = CHANNELS[gauge]
        components = tuple((name + component, Quantity.STRAIN) for component in ACROSS)
        across, shear = model.respond(flown.trial, components, bare, conditions).values.T
        values[:, gauge] = c**2 * values[:, gauge] + s**2 * across + s * c * shear
    return values[:, flown.columns]


def outputs_of_fmu(asset: FmiAsset, flown: Flown, parameters: dict[str, float]) -> FloatArray:
    """Return the compared outputs of the FMU."""
    asset.reset(
        parameters | flown.parameters, control={"load_factor": 0.0}, health=flown.start_health
    )
    start = [asset.observe().values] if flown.shows_start else []
    return np.array([*start, *asset.simulate(**flown.course).values])[:, flown.columns]


def assert_same_outputs(outputs: FloatArray, expected: FloatArray) -> None:
    """Compare within 1e-6 of the largest strain and of the largest displacement."""
    for columns in (GAUGES, DISPLACEMENTS):
        error = np.abs(outputs[:, columns] - expected[:, columns]).max(initial=0.0)
        assert error <= 1e-6 * np.abs(expected[:, columns]).max(initial=0.0)


@pytest.mark.parametrize("name", [*OF_RINGDOWNS, *NO_EFFECT])
def test_ringdowns_are_those_of_the_naming_side(name, patched_wing, naming_side):
    patch = patch_of(name)
    flown = ringdown(patch, naming_side)

    outputs = outputs_of_fmu(patched_wing, flown, NO_EFFECT.get(name, switch_on(name)))

    assert_same_outputs(outputs, outputs_of_naming_side(naming_side, flown, patch))
    if name not in NO_EFFECT:
        plain = outputs_of_naming_side(naming_side, flown, ModelPatch())
        assert np.abs(outputs - plain).max() > 1e-3 * np.abs(plain).max()


@pytest.mark.parametrize("name", [*OF_STATIC_TESTS, "of no magnitude"])
def test_static_tests_are_those_of_the_naming_side(name, patched_wing, naming_side):
    flown = static_test()

    outputs = outputs_of_fmu(patched_wing, flown, NO_EFFECT.get(name, switch_on(name)))

    assert_same_outputs(outputs, outputs_of_naming_side(naming_side, flown, patch_of(name)))


@pytest.mark.parametrize("name", [*OF_FLIGHTS, "of no magnitude"])
def test_flights_are_those_of_the_naming_side(name, patched_wing, naming_side):
    flown = manoeuvres()

    outputs = outputs_of_fmu(patched_wing, flown, NO_EFFECT.get(name, switch_on(name)))

    assert_same_outputs(outputs, outputs_of_naming_side(naming_side, flown, patch_of(name)))


# ---------------------------------------------------------------------- the patched wing itself


def test_the_wing_stays_where_it_is_when_effects_come_and_go(patched):
    switches = [
        {},
        {"play": 1.0},
        {"play": 1.0, "root": 1.0},
        {"half_width": 0.002},
        {"play": 0.0},
        {"root": 0.0},
    ]
    binding = PATCHED.with_header(step_size=1e-5)
    parameters = {"response": 2.0, "release": 0.03}

    with FmiAsset(patched, binding, isolated=False, parameters=parameters) as asset:
        asset.reset(control={"load_factor": 1.0})
        tip = [asset.observe().values[-2]]
        for load in switches:
            tip.append(asset.step(load=load).values[-2])
            tip.append(asset.step().values[-2])

    assert np.abs(np.diff(tip)).max() < 0.003 * 0.03


def test_modal_outputs_are_those_of_the_patched_wing(patched, naming_side):
    healthy = np.array([1.0, 0.0, 0.0, 0.169, 0.134, 1.0, 0.0])
    structure = naming_side.wing.structure_at(healthy, patch_of("point_mass", "root"))

    with FmiAsset(patched, PATCHED, isolated=False, parameters=switch_on("point_mass")) as asset:
        soft_root = asset.step(load={"root": 1.0}).extra["frequency[1]"]
        stiff_root = asset.step(load={"root": 0.0}).extra["frequency[1]"]

    assert soft_root == pytest.approx(structure.modes.frequency[0])
    assert stiff_root > soft_root


def test_whole_numbers_of_a_law_change_its_outputs(patched):
    rows = [(0.0, 14.0), (0.0, -6.0)]
    many_elements = switch_on("slip", "crack")
    one_element = many_elements | {"effect.slip.element_count": 1, "effect.crack.side": 0}

    *_, of_many = fly(patched, rows, **many_elements)
    *_, of_one = fly(patched, rows, **one_element)

    assert np.abs(of_many - of_one).max() > 1e-3 * np.abs(of_many).max()


@pytest.mark.parametrize(
    ("name", "value"),
    [("slip.element_count", 2.5), ("slip.element_count", 0), ("crack.side", 2)],
)
def test_an_impossible_whole_number_is_refused(patched, name, value):
    with pytest.raises(FmuInputError):
        FmiAsset(patched, WARM, parameters={f"effect.{name}": value})


MOVING = {"response": 2.0, "release": 0.001}


def test_a_crack_that_takes_all_stiffness_is_refused(patched):
    soft = {"effect.crack.side": 0, "effect.crack.coefficient": -1e9}
    parameters = switch_on("crack") | MOVING | soft

    with (
        pytest.raises(FmuCallError, match="takes more stiffness than the structure has"),
        FmiAsset(patched, WARM, parameters=parameters) as asset,
    ):
        asset.reset()


def test_a_motion_without_bounds_is_refused(patched):
    wild = {"effect.drifting.rate": -1e6}
    asset = FmiAsset(patched, WARM, parameters=switch_on("drifting") | MOVING | wild)

    with asset, pytest.raises(FmuCallError, match="is not finite"):
        asset.simulate({"load_factor": 0.0}, steps=2000)


# ---------------------------------------------------------------------- patch files


@pytest.mark.parametrize("row", REFUSED["refused"], ids=lambda row: row["case"])
def test_patches_that_mean_nothing_are_refused_in_one_sentence(row, model, tmp_path):
    is_text = "text" in row
    content = row["text"].encode() if is_text else patch_file(json.loads(row["effects"]))
    options = {"arrays": wing_arrays()} if "wing" in row else {}

    with refused_on_one_line(PatchFileError, re.escape(row["sentence"])):
        build_fmu(model, tmp_path / "wing.fmu", patch=parse_patch(content), **options)

    assert not list(tmp_path.iterdir())


def test_a_byte_order_mark_means_nothing():
    content = patch_file()

    assert parse_patch(b"\xef\xbb\xbf" + content).effects == parse_patch(content).effects


def test_an_id_that_comes_twice_is_numbered():
    record = json.loads(patch_file())
    record["effects"] = record["effects"][:1] * 3

    effects = parse_patch(json.dumps(record).encode()).effects

    identifiers = [effect.id for effect in effects]
    assert identifiers == ["gauge_zero_drift", "gauge_zero_drift_2", "gauge_zero_drift_3"]


# ---------------------------------------------------------------------- the command line

BUILD = ("fmu", "build", "--patch", HERE / "sensors.json")


@pytest.mark.slow
def test_the_compiled_kind_takes_no_patch(tmp_path):
    out = tmp_path / "wing.fmu"

    message = refused(*BUILD, "--out", out, "--kind", "compiled", code=None)

    assert "build the kind 'python'" in message
    assert not out.exists()


@pytest.fixture(scope="module")
def activated_fmu(tmp_path_factory) -> Path:
    """An FMU that the command packs, with its effects on."""
    out = tmp_path_factory.mktemp("activated") / "wing.fmu"
    said(*BUILD, "--out", out, "--activate")
    return out


@pytest.mark.slow
def test_the_command_lists_the_effects_of_an_fmu(activated_fmu):
    shown = command("fmu", "info", activated_fmu)

    assert "gauge_zero_drift (on)" in " ".join(shown.stdout.split())
    assert "tunable" not in shown.stderr


@pytest.mark.slow
def test_the_command_lists_effects_without_their_variables(activated_fmu):
    text = said("fmu", "info", activated_fmu, "--no-variables")

    assert "effect.gauge_zero_drift.amplitude" not in text
