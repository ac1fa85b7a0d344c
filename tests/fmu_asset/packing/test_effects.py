"""Missing effects in the FMU: of sensors, against whole records; of the wing, against the naming side."""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy import read_model_description

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Quantity, Trial, TrialKind
from discrepancy.system.response import ACROSS, Conditions
from discrepancy.system.structures import WingModel
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
from tests.refusals import refused as no_line_end

HERE, REFUSED = Path(__file__).parent, tables(__file__)
SENSORS, WING = (
    {
        effect["id"]: effect["primitives"]
        for effect in json.loads((HERE / name).read_text("utf-8"))["effects"]
    }
    for name in ("sensors.json", "wing.json")
)
SENSING, PATCHED = KINDS["effects of sensors"].binding, KINDS["hysteresis"].binding
WARM = PATCHED.model_copy(
    update={"load": {name: PATCHED.load[name] for name in ("tip_force", "temperature")}}
)
"""The same without what switches effects."""
CHANNELS = output_channels(24)
OUTPUTS = [name for name, _ in CHANNELS]


def content(effects: Mapping[str, Sequence[Any]] = SENSORS) -> bytes:
    """Return a patch file: that of the sensors with other effects."""
    record = json.loads((HERE / "sensors.json").read_text("utf-8"))
    rows = [
        {"id": name, "place": "anywhere", "primitives": items} for name, items in effects.items()
    ]
    return json.dumps(record | {"effects": rows}).encode()


def on(*names: str) -> dict[str, float]:
    """Return the parameters that switch effects on."""
    return {f"effect.{name}.active": 1.0 for name in names}


@pytest.fixture(scope="module")
def flying(patched: Path) -> Iterator[FmiAsset]:
    """The wing with effects, started anew by each test."""
    with FmiAsset(patched, WARM, isolated=False) as asset:
        yield asset


@pytest.fixture(scope="module")
def naming_side() -> WingModel:
    return WingModel(wing_arrays())


def flown(
    fmu: Path, rows: Sequence[Sequence[float]], start: float = 0.0, **parameters: float
) -> np.ndarray:
    """Return all outputs at the start and after steps of 50 ms of load factor and tip force."""
    binding = BINDINGS["watched"].with_header(step_size=0.05, start_time=start)
    with FmiAsset(fmu, binding, isolated=False, parameters=parameters) as asset:
        asset.reset(control={"load_factor": rows[0][0]})
        seen = [asset.observe()] + [
            asset.step({"load_factor": n}, load={"tip_force": f}) for n, f in rows
        ]
        return np.array([item.values for item in seen])


# ---------------------------------------------------------------------- files


def test_the_table_only_grows_at_its_end_and_the_guid_tells_what_is_on(
    fmu, sensing, model, tmp_path
) -> None:
    active = build_fmu(model, tmp_path / "on.fmu", patch=parse_patch(content()), activate=True).path
    changed = parse_patch(content(SENSORS | {"gauge_gain": SENSORS["gauge_gain"][:1]}))
    other = build_fmu(model, tmp_path / "other.fmu", patch=changed).path
    plain, *more = (read_model_description(str(path)) for path in (fmu, sensing, active, other))
    for one, another in zip(plain.modelVariables, more[0].modelVariables, strict=False):
        assert (one.name, one.valueReference, one.start) == (
            another.name,
            another.valueReference,
            another.start,
        )
    assert len(more[0].modelVariables) > len(plain.modelVariables)
    assert len({each.guid for each in more}) == 3


# ---------------------------------------------------------------------- sensors


@pytest.mark.parametrize("moving", [False, True], ids=["quasi-static", "transient"])
def test_effects_of_sensors_are_those_of_whole_records(fmu, sensing, patched, moving) -> None:
    """From the first step on, or from the release on."""
    rows = [(0.0, 0.0)] * 80 if moving else [(n, 0.0) for n in (1.0, 2.0, -1.0, 3.0)]
    given = {"response": 1.0 + moving, "release": 0.03 * moving, "start": 2.0 * moving}
    first = 0 if moving else 1
    plain, off, shown = (
        flown(path, rows, **given, **switched)[first:]
        for path, switched in ((fmu, {}), (sensing, {}), (sensing, on(*SENSORS)))
    )
    assert off.tobytes() == plain.tobytes()
    assert moving or flown(patched, rows)[first:].tobytes() == plain.tobytes()
    whole = ModelPatch(
        tuple(
            item
            for effect in parse_patch(content()).for_gauges(24).effects
            for item in effect.patch
        )
    )
    time, kind = 0.05 * np.arange(first, len(rows) + 1), "ringdown" if moving else "flight"
    more = {"release": 0.03} if moving else {}
    record = SensorRecord(CHANNELS, kind, time, 2.0 * moving, np.zeros(len(time)), **more)
    wanted, _ = apply_sensors(whole, record, plain, high_pass=filtered_record)
    scale = np.abs(wanted).max(axis=0) if moving else np.abs(wanted)
    assert (np.abs(shown - wanted) <= (1e-12 if moving else 1e-13) * scale).all()
    assert not np.allclose(shown, plain)


def test_gauges_that_saturate_show_the_formula_and_displacements_stay(fmu, sensing) -> None:
    """One limit for all gauges, of an order with the strains; a displacement has a limit of its own."""
    rows = [(n, 0.0) for n in (1.0, 3.0, -2.0)]
    plain, shown = flown(fmu, rows), flown(sensing, rows, **on("saturation"))
    assert np.abs(plain[:, :24]).max() > 2e-3
    np.testing.assert_allclose(shown[:, :24], 4e-3 * np.tanh(plain[:, :24] / 4e-3), rtol=1e-13)
    np.testing.assert_allclose(shown[:, 24], 0.9 * np.tanh(plain[:, 24] / 0.9), rtol=1e-13)
    np.testing.assert_array_equal(shown[:, 25], plain[:, 25])


def test_switches_and_values_change_between_steps(sensing, fmu) -> None:
    with FmiAsset(sensing, SENSING, isolated=False) as asset:
        plain = flown(fmu, [(2.0, 0.0)])[1]
        seen = [
            asset.step({"load_factor": 2.0}, load={"drift": k}).values[16]
            for k in (0.0, 1.0, 0.0, 1.0)
        ]
        assert seen[0] == seen[2] == plain[16]
        for index, time in ((1, 0.1), (3, 0.2)):
            assert seen[index] - plain[16] == pytest.approx(4e-5 * math.sqrt(time / 10.0), rel=1e-9)
        warm = asset.step(load={"drift": 0.0, "temperature": 5.0}).values
        np.testing.assert_array_equal(warm, plain)  # the effect of temperature is off
        with pytest.raises(FmuInputError, match="range"):
            asset.step(load={"drift": 1.5})
    with FmiAsset(sensing, SENSING, isolated=False, parameters=on("thermal_strain")) as asset:
        cold = asset.step({"load_factor": 1.0}).values
        warm = asset.step(load={"temperature": 4.0}).values
    np.testing.assert_allclose(warm - cold, [4.8e-5] * 24 + [0.0] * 2, rtol=1e-9)


@pytest.mark.parametrize(
    ("which", "parameters", "first", "wrong", "right", "sentence"), REFUSED["values"]
)
def test_values_that_cannot_be_are_refused_and_change_nothing(
    ours, which, parameters, first, wrong, right, sentence
) -> None:
    binding = {"sensing": SENSING, "patched": PATCHED}[which]
    with FmiAsset(
        ours(which), binding, isolated=False, parameters=parameters | {"response": 2.0}
    ) as asset:
        asset.step({"load_factor": 1.0}, load=first)
        before = asset.save_state()
        with pytest.raises(FmuCallError, match=sentence):
            asset.step({"load_factor": 3.0}, load=wrong)
        seen = asset.step({"load_factor": 3.0}, load=right)
        asset.restore_state(before)
        assert asset.step({"load_factor": 3.0}).values.tobytes() == seen.values.tobytes()


# ---------------------------------------------------------------------- the wing

START = DigitalState()
STATE = np.array([1.0, START.servo_mass, START.pitot_mass, START.damping_alpha, START.damping_beta])
FORCES = np.array([2.0, 9.0, 15.0, 6.0, -3.0, -14.0, -5.0, 8.0])
FACTORS = np.array([1.0, 2.0, 3.5, -0.5, 2.5])
OFF: dict[str, dict[str, float]] = {
    "nothing": {},
    "of no magnitude": on("root", "play")
    | {"effect.root.compliance": 0.0, "effect.play.stiffness": 0.0},
}
DYNAMIC = sorted(set(WING) - {"place", "cell", "washout", "relief", "turned", "warmer"})
STATIC = sorted(set(WING) - {"washout", "relief", "drifting"})
NAMED = [
    *((TrialKind.RINGDOWN, name) for name in (*DYNAMIC, *OFF)),
    *((TrialKind.STATIC, name) for name in (*STATIC, "of no magnitude")),
    *(
        (TrialKind.FLIGHT, name)
        for name in ("washout", "relief", "play", "local_loss", "both", "of no magnitude")
    ),
]


def patch_of(*names: str) -> ModelPatch:
    return ModelPatch.from_list([primitive for name in names for primitive in WING.get(name, ())])


def expected(model: WingModel, given: Trial, patch: ModelPatch, health: np.ndarray) -> np.ndarray:
    """Return all outputs of the naming side; a rotated gauge is turned here."""
    bare = ModelPatch(tuple(item for item in patch if not isinstance(item, SensorRotation)))
    outputs = tuple((name, Quantity(quantity)) for name, quantity in CHANNELS)
    conditions = Conditions(STATE, health=health)
    values = model.respond(given, outputs, bare, conditions).values.copy()
    for item in patch.of(SensorRotation):
        c, s, gauge = np.cos(item.angle), np.sin(item.angle), OUTPUTS.index(item.channel)
        turned = tuple((CHANNELS[gauge][0] + part, Quantity.STRAIN) for part in ACROSS)
        across, sheared = model.respond(given, turned, bare, conditions).values.T
        values[:, gauge] = c**2 * values[:, gauge] + s**2 * across + s * c * sheared
    return values


@pytest.mark.parametrize(("kind", "name"), NAMED)
def test_records_are_those_of_the_naming_side(kind, name, flying, naming_side) -> None:
    """Within 1e-6 of the largest strain and the largest displacement."""
    patch, chosen, damage, columns = patch_of(name), OFF.get(name, on(name)), np.zeros((1, 2)), 26
    time = np.arange(
        {TrialKind.RINGDOWN: 31, TrialKind.STATIC: len(FORCES), TrialKind.FLIGHT: 5}[kind]
    )
    acting: dict[str, Any] = {}
    course: dict[str, Any] = {"steps": 30}
    if kind == TrialKind.RINGDOWN:
        arrays, damage = wing_arrays(), np.array([[0.1, 0.0]])
        chosen = chosen | {"response": 2.0, "release": 0.03}
        state = np.array([1.0, *damage[0], *STATE[1:3], 1.0, 0.0])
        shape = naming_side.wing.structure_at(state, patch.of(*STRUCTURE)).static(arrays.load_tip)
        acting = {
            "release": Release(
                0.03 * float(arrays.load_tip @ shape) / float(arrays.tip_row @ shape)
            )
        }
    elif kind == TrialKind.STATIC:
        warm = 5.0 * time / len(FORCES)
        acting, course = (
            {"force": FORCES, "temperature": warm},
            {"load": {"tip_force": FORCES, "temperature": warm}},
        )
    else:
        damage, columns = np.column_stack((0.15 * time, 0.1 * np.ones(5))), 24
        health = dict(zip(("z1", "z2"), damage.T, strict=True))
        acting, course = (
            {"load_factor": FACTORS},
            {"control": {"load_factor": FACTORS}, "health": health},
        )
    trial = Trial.plain(
        "trial", kind, (), (1.0 if kind == TrialKind.FLIGHT else 0.01) * time, **acting
    )
    flying.reset(
        chosen, control={"load_factor": 0.0}, health={"z1": damage[0, 0], "z2": damage[0, 1]}
    )
    begin = [flying.observe().values] * (kind == TrialKind.RINGDOWN)
    shown = np.array([*begin, *flying.simulate(**course).values])[:, :columns]
    wanted, plain = (
        expected(naming_side, trial, each, damage)[:, :columns] for each in (patch, ModelPatch())
    )
    for part in (slice(24), slice(24, columns)):
        apart = np.abs(shown[:, part] - wanted[:, part]).max(initial=0.0)
        assert apart <= 1e-6 * np.abs(wanted[:, part]).max(initial=0.0)
    if kind == TrialKind.RINGDOWN and name not in OFF:
        assert np.abs(shown - plain).max() > 1e-3 * np.abs(plain).max()


def test_the_wing_stays_where_it_is_when_effects_come_and_go(patched) -> None:
    both = {"play": 1.0, "root": 1.0}
    switches = [{}, {"play": 1.0}, both, {"half_width": 0.002}, {"play": 0.0}, {"root": 0.0}]
    binding, given = PATCHED.with_header(step_size=1e-5), {"response": 2.0, "release": 0.03}
    with FmiAsset(patched, binding, isolated=False, parameters=given) as asset:
        asset.reset(control={"load_factor": 1.0})
        seen = [asset.observe().values[-2]]
        for load in switches:
            seen += [asset.step(load=load).values[-2], asset.step().values[-2]]
    assert np.abs(np.diff(seen)).max() < 0.003 * 0.03


def test_modal_outputs_are_those_of_the_patched_wing(patched, naming_side) -> None:
    with FmiAsset(patched, PATCHED, isolated=False, parameters=on("point_mass")) as asset:
        seen, off = (asset.step(load={"root": root}).extra["frequency[1]"] for root in (1.0, 0.0))
    healthy = np.array([1.0, 0.0, 0.0, 0.169, 0.134, 1.0, 0.0])
    assert seen == pytest.approx(
        naming_side.wing.structure_at(healthy, patch_of("point_mass", "root")).modes.frequency[0]
    )
    assert off > seen


def test_whole_numbers_are_whole_and_what_has_no_bounds_is_refused(patched) -> None:
    many = on("slip", "crack")
    single = many | {"effect.slip.element_count": 1, "effect.crack.side": 0}
    seen, one = (
        flown(patched, [(0.0, 14.0), (0.0, -6.0)], **given)[-1] for given in (many, single)
    )
    assert np.abs(seen - one).max() > 1e-3 * np.abs(seen).max()
    for name, value in (("slip.element_count", 2.5), ("slip.element_count", 0), ("crack.side", 2)):
        with pytest.raises(FmuInputError):
            FmiAsset(patched, WARM, parameters={f"effect.{name}": value})
    moving = {"response": 2.0, "release": 0.001}
    soft = on("crack") | moving | {"effect.crack.side": 0, "effect.crack.coefficient": -1e9}
    with pytest.raises(FmuCallError, match="takes more stiffness than the structure has"):
        FmiAsset(patched, WARM, parameters=soft).reset()
    wild = on("drifting") | moving | {"effect.drifting.rate": -1e6}
    asset = FmiAsset(patched, WARM, parameters=wild)
    with asset, pytest.raises(FmuCallError, match="is not finite"):
        asset.simulate({"load_factor": 0.0}, steps=2000)


# ---------------------------------------------------------------------- refusals


@pytest.mark.parametrize("row", REFUSED["refused"], ids=lambda row: row["case"])
def test_patches_that_mean_nothing_are_refused_in_one_sentence(row, model, tmp_path) -> None:
    given = row["text"].encode() if "text" in row else content(json.loads(row["effects"]))
    options = {"arrays": wing_arrays()} if "wing" in row else {}
    with no_line_end(PatchFileError, re.escape(row["sentence"])):
        build_fmu(model, tmp_path / "wing.fmu", patch=parse_patch(given), **options)
    assert not list(tmp_path.iterdir())


def test_a_byte_order_mark_means_nothing_and_an_id_that_comes_twice_is_numbered() -> None:
    record = json.loads(content())
    record["effects"] = record["effects"][:1] * 3
    again = parse_patch(b"\xef\xbb\xbf" + json.dumps(record).encode())
    assert [effect.id for effect in again.effects] == [
        f"gauge_zero_drift{end}" for end in ("", "_2", "_3")
    ]


@pytest.mark.slow
def test_the_command_line_packs_a_patch_and_lists_its_effects(tmp_path) -> None:
    out = tmp_path / "wing.fmu"
    words = "fmu", "build", "--out", out, "--patch", HERE / "sensors.json"
    assert "build the kind 'python'" in refused(*words, "--kind", "compiled", code=None)
    assert not out.exists()
    said(*words, "--activate")
    shown = command("fmu", "info", out)
    assert "gauge_zero_drift (on)" in " ".join(shown.stdout.split())
    assert "tunable" not in shown.stderr
    assert "effect.gauge_zero_drift.amplitude" not in said("fmu", "info", out, "--no-variables")
