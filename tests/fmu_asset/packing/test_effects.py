"""Missing effects in the FMU: of sensors, against whole records; of the wing, against the naming side.

The wing is the chain of springs and masses, which both sides hold exactly; what can differ is the physics.
"""

import json
import math
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy import read_model_description
from hypothesis import given
from hypothesis import strategies as st

from discrepancy.campaign.records import Campaign, Channel, Quantity, Release, Trial, TrialKind
from discrepancy.document import Origin
from discrepancy.files.verdict import StoredPatch, fmu_outputs, patch_effects, read_patch, write_patch
from discrepancy.models.high_pass import filtered_record
from discrepancy.models.interface import Conditions
from discrepancy.models.structures import WingModel
from discrepancy.verdict import NamedEffect, VerdictKind
from fe.runtime.patch import STRUCTURE, ModelPatch, SensorGain, SensorRotation
from fe.runtime.patch_arrays import PatchArrays
from fe.runtime.patched_wing import PatchedWing
from fe.runtime.sensors import SensorRecord, apply_sensors
from fe.runtime.state import DigitalState
from fmu_asset.check import check_fmu
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuCallError, FmuInputError, PatchFileError
from fmu_asset.packing.patch_file import load_patch, parse_patch
from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.slaves.effects import active_primitives, effect_rows, numbers_of
from reporting.provenance import collect_provenance
from tests.command_line import command, refused, said
from tests.fmu_asset.door.kinds import CHANNELS, INTERVAL, OUTPUTS, SENDING, WARM, on, playing, watching
from tests.fmu_asset.ours import OurFmus
from tests.fmu_asset.slaves.slave import OK, Slave

HERE = Path(__file__).parent
SENSORS, WING = (
    {effect["id"]: effect["primitives"] for effect in json.loads((HERE / name).read_text("utf-8"))["effects"]}
    for name in ("sensors.json", "wing.json")
)
DYNAMIC = sorted(set(WING) - {"place", "cell", "washout", "relief", "turned", "warmer"})
STATIC = sorted(set(WING) - {"washout", "relief", "drifting"})


def content(effects: Mapping[str, Sequence[Any]] = SENSORS, **further: object) -> bytes:
    """Return a patch file: that of the sensors with other effects or keys."""
    record = json.loads((HERE / "sensors.json").read_text("utf-8"))
    rows = [{"id": name, "place": "anywhere", "primitives": items} for name, items in effects.items()]
    return json.dumps(record | {"effects": rows} | further).encode()


def patch_of(*names: str) -> ModelPatch:
    return ModelPatch.from_list([primitive for name in names for primitive in WING[name]])


# ---------------------------------------------------------------------- what the naming side says

START = DigitalState()
STATE = np.array([1.0, START.servo_mass, START.pitot_mass, START.damping_alpha, START.damping_beta])


def trial(kind: TrialKind, count: int, **given: Any) -> Trial:
    """Return a trial of many moments under no load but what is given."""
    named, zeros = (
        {"name": "trial", "run": ""},
        dict.fromkeys(("force", "load_factor", "temperature"), np.zeros(count)),
    )
    none = {
        "channels": (),
        "values": np.zeros((count, 0)),
        "used": np.zeros((count, 0), bool),
        "release": None,
    }
    health = dict.fromkeys(("health", "health_deviation"), np.zeros((count, 2)))
    told = {"kind": kind, "time": INTERVAL * np.arange(count), "load_place": "tip_load", "start": 0.0}
    return Trial(**(named | zeros | none | health | told | given))


def expected(
    model: WingModel, given: Trial, patch: ModelPatch, health: Sequence[Any] = ((0.0, 0.0),)
) -> np.ndarray:
    """Return all outputs of the naming side; a rotated gauge is turned here."""
    bare = ModelPatch(tuple(item for item in patch if not isinstance(item, SensorRotation)))
    conditions = Conditions(STATE, health=np.array(health), components=len(bare) < len(patch))
    outputs = tuple((name, Quantity(quantity)) for name, quantity in CHANNELS)
    found = model.respond(given, outputs, bare, conditions)
    values = found.values.copy()
    for item in patch.of(SensorRotation):
        c, s, gauge = np.cos(item.angle), np.sin(item.angle), OUTPUTS.index(item.channel)
        across, sheared = found.transverse[:, gauge], found.shear[:, gauge]
        values[:, gauge] = c**2 * values[:, gauge] + s**2 * across + s * c * sheared
    return values


def close(shown: np.ndarray, wanted: np.ndarray, tolerance: float = 1e-6) -> None:
    """Compare with the largest strain and the largest displacement."""
    for part in (slice(24), slice(24, shown.shape[1])):
        apart = np.abs(shown[:, part] - wanted[:, part]).max(initial=0.0)
        assert apart <= tolerance * np.abs(wanted[:, part]).max(initial=0.0)


# ---------------------------------------------------------------------- the FMU


@pytest.fixture(scope="module")
def sensing(ours: OurFmus) -> Path:
    return ours("sensing")


@pytest.fixture(scope="module")
def patched(ours: OurFmus) -> Path:
    return ours("patched")


@pytest.fixture(scope="module")
def naming_side(arrays: PatchArrays) -> WingModel:
    return WingModel(arrays)


def flown(
    fmu: Path, rows: Sequence[Sequence[float]], step: float = 0.05, start: float = 0.0, **parameters: float
) -> np.ndarray:
    """Return all outputs at the start and after steps of load factor, z1, z2 and tip force."""
    with FmiAsset(fmu, watching(step, start_time=start), isolated=False, parameters=parameters) as asset:
        n, z1, z2, _ = rows[0]
        asset.reset(control={"load_factor": n}, health={"z1": z1, "z2": z2})
        seen = [asset.observe()]
        for n, z1, z2, force in rows:
            seen.append(asset.step({"load_factor": n}, {"z1": z1, "z2": z2}, {"tip_force": force}))
        return np.array([[*item.values, *item.extra.values()] for item in seen])


# ---------------------------------------------------------------------- files


def test_the_table_only_grows_at_its_end(fmu, sensing) -> None:
    plain, more = (read_model_description(str(path)).modelVariables for path in (fmu, sensing))
    for one, other in zip(plain, more, strict=False):
        assert (one.name, one.valueReference, one.start) == (other.name, other.valueReference, other.start)
    added = {row.name: row for row in more[len(plain) :]}
    assert list(added)[:4] == [
        f"effect.gauge_zero_drift.{name}" for name in ("active", "amplitude", "time", "exponent")
    ]
    assert "effect.gauge_gain.gain[2]" in added
    drift = added["effect.gauge_zero_drift.amplitude"]
    assert (drift.causality, drift.variability, drift.unit) == ("parameter", "tunable", "1")
    assert float(drift.start) == 4e-5
    assert added["effect.coupling.time_constant[2]"].unit == "s"
    assert added["effect.hum.cosine[2]"].unit == "1"  # metres per metre of the release
    assert added["temperature_difference"].causality == "input"
    assert float(added["effect.coupling.active"].start) == 0.0


def test_what_is_on_and_how_much_show_in_the_guid(model, sensing, tmp_path) -> None:
    patch = parse_patch(content())
    active = build_fmu(model, tmp_path / "on.fmu", patch=patch, activate=True)
    changed = parse_patch(content(SENSORS | {"gauge_gain": SENSORS["gauge_gain"][:1]}))
    other = build_fmu(model, tmp_path / "other.fmu", patch=changed)
    assert len({read_model_description(str(path)).guid for path in (sensing, active.path, other.path)}) == 3
    found = check_fmu(sensing, cycles=120)
    assert [item for item in found.findings if item.verdict != "ok"] == []


# ---------------------------------------------------------------------- sensors


@pytest.mark.parametrize("response", [1.0, 2.0], ids=["quasi-static", "transient"])
def test_effects_of_sensors_are_those_of_whole_records(fmu, sensing, response) -> None:
    """From the first step on, or from the release on."""
    moving = response == 2.0
    rows = [(0.0, 0.0, 0.0, 0.0)] * 80 if moving else [(n, 0.1, 0.0, 0.0) for n in (1.0, 2.0, -1.0, 3.0)]
    given = {"response": response, "release": 0.03 * moving, "start": 2.0 * moving}
    first = 0 if moving else 1
    plain, off, shown = (
        flown(path, rows, **given, **switched)[first:, :26]
        for path, switched in ((fmu, {}), (sensing, {}), (sensing, on(*SENSORS)))
    )
    assert off.tobytes() == plain.tobytes()
    whole = ModelPatch(
        tuple(item for effect in parse_patch(content()).for_gauges(24).effects for item in effect.patch)
    )
    time, kind = 0.05 * np.arange(first, len(rows) + 1), "ringdown" if moving else "flight"
    more = {"release": 0.03} if moving else {}
    record = SensorRecord(CHANNELS, kind, time, 2.0 * moving, np.zeros(len(time)), **more)
    wanted, _ = apply_sensors(whole, record, plain, filtered=filtered_record)
    if moving:
        scale = np.abs(wanted).max(axis=0)
        np.testing.assert_allclose(shown / scale, wanted / scale, rtol=0.0, atol=1e-12)
    else:
        np.testing.assert_allclose(shown, wanted, rtol=1e-13, atol=0.0)
    assert not np.allclose(shown, plain)


def test_switches_and_values_change_between_steps(sensing, fmu) -> None:
    with FmiAsset(sensing, SENDING, isolated=False) as asset:
        plain = flown(fmu, [(2.0, 0.0, 0.0, 0.0)])[1, :26]
        seen = [asset.step({"load_factor": 2.0}, load={"drift": k}).values[16] for k in (0.0, 1.0, 0.0, 1.0)]
        assert seen[0] == seen[2] == plain[16]
        for index, time in ((1, 0.1), (3, 0.2)):
            assert seen[index] - plain[16] == pytest.approx(4e-5 * math.sqrt(time / 10.0), rel=1e-9)
        warm = asset.step(load={"drift": 0.0, "temperature": 5.0}).values
        np.testing.assert_array_equal(warm, plain)  # the effect of temperature is off
        with asset.fork() as other:
            for one in (asset, other):
                one.step(load={"drift": 1.0})
            assert asset.observe().values.tobytes() == other.observe().values.tobytes()
        with pytest.raises(FmuInputError, match="range"):
            asset.step(load={"drift": 1.5})
    with FmiAsset(sensing, SENDING, isolated=False, parameters=on("thermal_strain")) as asset:
        cold = asset.step({"load_factor": 1.0}).values
        warm = asset.step(load={"temperature": 4.0}).values
    np.testing.assert_allclose(warm[:24] - cold[:24], 4.8e-5, rtol=1e-9)
    np.testing.assert_array_equal(warm[24:], cold[24:])


@pytest.mark.parametrize("response", [1, 2])
def test_what_is_read_while_initialising_leaves_no_trace(sensing, response) -> None:
    seen = []
    for factors in ((3.0, 1.0), (1.0,)):
        with closing(Slave(sensing)) as slave:
            slave.initialising()
            slave.fmu.setInteger([slave.reference["response"]], [response])
            for factor in factors:
                slave.set(on("coupling") | {"load_factor": factor})
                slave.everything()
            assert slave.status_of(slave.fmu.exitInitializationMode) == OK
            assert slave.status_of(slave.fmu.doStep, 0.0, 0.05) == OK
            seen.append(slave.everything())
    assert seen[0] == seen[1]


IMPOSSIBLE = {
    "sensing": (SENDING, on("coupling") | {"response": 2.0}, {"time_constant": -1.0}, {"time_constant": 0.7},
                "(?s)positive time constant.*the state is as it was"),
    "patched": (playing(), {"response": 2.0, "release": 0.01}, {"half_width": -1.0}, {"half_width": 0.004},
                "half_width of 'free_play' must not be negative"),
}  # fmt: skip


@pytest.mark.parametrize("which", IMPOSSIBLE)
def test_values_that_cannot_be_are_refused_and_change_nothing(request, which) -> None:
    binding, parameters, wrong, right, sentence = IMPOSSIBLE[which]
    on_first = {"play": 1.0} if which == "patched" else {}
    with FmiAsset(request.getfixturevalue(which), binding, isolated=False, parameters=parameters) as asset:
        asset.step({"load_factor": 1.0}, load=on_first)
        before = asset.save_state()
        with pytest.raises(FmuCallError, match=sentence):
            asset.step({"load_factor": 3.0}, load=wrong)
        seen = asset.step({"load_factor": 3.0}, load=right)
        asset.restore_state(before)
        assert asset.step({"load_factor": 3.0}).values.tobytes() == seen.values.tobytes()


@given(st.data())
def test_values_and_patch_belong_together(data) -> None:
    effects = parse_patch(content()).for_gauges(24).plain
    rows = effect_rows(effects, 7, {})
    assert [row.reference for row in rows] == list(range(7, 7 + len(rows)))
    value = {row.name: float(row.start or 0.0) for row in rows}
    assert active_primitives(effects, value) == []
    active = data.draw(st.sets(st.sampled_from(sorted(SENSORS))))
    changed = data.draw(st.sampled_from([name for effect in effects for name in numbers_of(effect)]))
    found = ModelPatch.from_list(active_primitives(effects, value | on(*active) | {changed: 0.125})).to_list()
    wanted = []
    for effect in effects:
        rows_of = [dict(item) for item in effect["primitives"]]
        for name, (number, key) in numbers_of(effect).items():
            if name == changed:
                rows_of[number][key] = 0.125
        wanted += rows_of if effect["id"] in active else []
    assert found == wanted


# ---------------------------------------------------------------------- the wing


FORCES = np.array([2.0, 9.0, 15.0, 6.0, -3.0, -14.0, -5.0, 8.0])
FACTORS = np.array([1.0, 2.0, 3.5, -0.5, 2.5])
NAMED = [
    *((TrialKind.RINGDOWN, name) for name in DYNAMIC),
    *((TrialKind.STATIC, name) for name in STATIC),
    *((TrialKind.FLIGHT, name) for name in ("washout", "relief", "play", "local_loss", "both")),
]


@pytest.mark.parametrize(("kind", "name"), NAMED)
def test_records_are_those_of_the_naming_side(kind, name, patched, naming_side, arrays) -> None:
    patch, chosen, damage, columns = patch_of(name), on(name), np.zeros((1, 2)), slice(26)
    if kind == TrialKind.RINGDOWN:
        damage, chosen = np.array([[0.1, 0.0]]), chosen | {"response": 2.0, "release": 0.03}
        state = np.array([1.0, *damage[0], *STATE[1:3], 1.0, 0.0])
        structure = PatchedWing(arrays).at(state, patch.of(*STRUCTURE))
        shape = structure.static(arrays.load_tip)
        force = 0.03 * float(arrays.load_tip @ shape) / float(arrays.tip_row @ shape)
        given, course = trial(kind, 61, release=Release(force)), {"steps": 60}
    elif kind == TrialKind.STATIC:
        warm = 5.0 * np.arange(len(FORCES)) / len(FORCES)
        given = trial(kind, len(FORCES), force=FORCES, temperature=warm)
        course = {"load": {"tip_force": FORCES, "temperature": warm}}
    else:
        damage = np.column_stack((0.15 * np.arange(5), 0.1 * np.ones(5)))
        given, columns = trial(kind, 5, load_factor=FACTORS, time=np.arange(5.0)), slice(24)
        health = dict(zip(("z1", "z2"), damage.T, strict=True))
        course = {"control": {"load_factor": FACTORS}, "health": health}
    with FmiAsset(patched, watching(load=WARM), isolated=False, parameters=chosen) as asset:
        asset.reset(control={"load_factor": 0.0}, health={"z1": damage[0, 0], "z2": damage[0, 1]})
        begin = [asset.observe().values] * (kind == TrialKind.RINGDOWN)
        shown = np.array([*begin, *asset.simulate(**course).values])[:, columns]
    wanted, plain = (expected(naming_side, given, each, damage)[:, columns] for each in (patch, ModelPatch()))
    close(shown, wanted)
    assert np.abs(shown - plain).max() > 1e-3 * np.abs(plain).max() or kind != TrialKind.RINGDOWN


@pytest.mark.parametrize("response", [1.0, 2.0])
def test_effects_that_are_off_or_have_no_magnitude_change_nothing(model, patched, response, tmp_path) -> None:
    """A wing that can be patched moves in six modes, which are iterated; the plain one has six here, too."""
    plain = build_fmu(replace(model, mode_count=6), tmp_path / "wing.fmu").path
    nothing = on("root", "play") | {"effect.root.compliance": 0.0, "effect.play.stiffness": 0.0}
    rows = np.random.default_rng(11).uniform([-1, 0, 0, -20], [4, 0.8, 0.8, 20], (25, 4)).tolist()
    for further in ({}, nothing):
        for tip in (0.0, 0.02):
            given = {"response": response, "release": tip * (response == 2.0)}
            wanted = flown(plain, rows, INTERVAL, **given)[1:, :26]
            seen = flown(patched, rows, INTERVAL, **given, **further)[1:, :26]
            close(seen, wanted, 1e-9 if response == 1.0 else 5e-4)


def test_the_wing_stays_where_it_is_when_effects_come_and_go(patched) -> None:
    given = {"response": 2.0, "release": 0.03}
    both = {"play": 1.0, "root": 1.0}
    switches = [{}, {"play": 1.0}, both, {"half_width": 0.002}, {"play": 0.0}, {"root": 0.0}]
    with FmiAsset(patched, playing(1e-5), isolated=False, parameters=given) as asset:
        asset.reset(control={"load_factor": 1.0})
        seen = [asset.observe().values[-2]]
        for load in switches:
            seen += [asset.step(load=load).values[-2], asset.step().values[-2]]
    assert np.abs(np.diff(seen)).max() < 0.003 * 0.03


def test_modal_outputs_are_those_of_the_patched_wing(patched, naming_side) -> None:
    with FmiAsset(patched, playing(), isolated=False, parameters=on("point_mass")) as asset:
        seen = asset.step({"load_factor": 1.0}, load={"root": 1.0}).extra["frequency[1]"]
        off = asset.step(load={"root": 0.0}).extra["frequency[1]"]
    heavier = patch_of("point_mass", "root")
    modes = naming_side.wing.at(np.array([1.0, 0.0, 0.0, 0.169, 0.134, 1.0, 0.0]), heavier).modes
    assert seen == pytest.approx(modes.frequency[0])
    assert off > seen


def test_whole_numbers_are_whole_and_what_has_no_bounds_is_refused(patched) -> None:
    many = on("slip", "crack")
    pushed = [(0.0, 0.0, 0.0, force) for force in (14.0, -6.0)]
    single = many | {"effect.slip.element_count": 1, "effect.crack.side": 0}
    seen, one = (flown(patched, pushed, **given)[-1, :26] for given in (many, single))
    assert np.abs(seen - one).max() > 1e-3 * np.abs(seen).max()
    for name, value in (("slip.element_count", 2.5), ("slip.element_count", 0), ("crack.side", 2)):
        with pytest.raises(FmuInputError):
            FmiAsset(patched, watching(), parameters={f"effect.{name}": value})
    moving = {"response": 2.0, "release": 0.001}
    soft = on("crack") | moving | {"effect.crack.side": 0, "effect.crack.coefficient": -1e9}
    with pytest.raises(FmuCallError, match="takes more stiffness than the structure has"):
        FmiAsset(patched, watching(), parameters=soft).reset()
    wild = on("drifting") | moving | {"effect.drifting.rate": -1e6}
    asset = FmiAsset(patched, watching(), parameters=wild)
    with asset, pytest.raises(FmuCallError, match="is not finite"):
        asset.simulate({"load_factor": 0.0}, steps=2000)


def test_the_patch_that_a_verdict_leaves_goes_into_the_fmu(model, arrays, fmu, tmp_path) -> None:
    seen = {"g3": "strain[3]", "tip": "tip_displacement", "rate": "tip_displacement"}
    quantities = {"g3": Quantity.STRAIN, "tip": Quantity.DISPLACEMENT, "rate": Quantity.VELOCITY}
    channels = {name: Channel(name, quantities[name], output, None) for name, output in seen.items()}
    outputs = fmu_outputs(Campaign("chain", channels, (), None, {}, "").channels)
    assert outputs == {"g3": "strain[3]", "tip": "tip_displacement"}
    gain = ModelPatch((SensorGain("g3", 0.25),))
    named = NamedEffect("gauge_gain", "Gauge gain", "g3", "gain", (), (), gain)
    origin = Origin("chain", "wing", "ab" * 32, "cd" * 32, "uav-twin", collect_provenance(1))
    stored = StoredPatch(VerdictKind.NAMED, "", patch_effects((named,)), outputs, (), origin)
    path = write_patch(tmp_path / "patch.json", stored)
    assert read_patch(path).channels == outputs
    options = {"patch": load_patch(path), "arrays": arrays, "activate": True}
    packed = build_fmu(model, tmp_path / "wing.fmu", **options).path
    plain, more = (flown(which, [(2.0, 0.0, 0.0, 0.0)])[1, :26] for which in (fmu, packed))
    ratio = more / plain
    assert ratio[2] == pytest.approx(1.25, rel=1e-14)
    assert np.all(np.delete(ratio, 2) == 1.0)


# ---------------------------------------------------------------------- refusals


TEXT, ONE = content(), {"gain": SENSORS["gauge_gain"][:1]}
REFUSED: dict[str, tuple[bytes, str]] = {
    row["case"]: (content({"wrong": [json.loads(row["primitive"])]}), row["sentence"])
    for row in tomllib.loads((HERE / "refused.toml").read_text("utf-8"))["refused"]
} | {
    "another schema": (content(schema="uav-twin patch 9"), "uav-twin patch 9"),
    "no effect": (content({}), "names no effect"),
    "an id that is no name": (content({"a b": ONE["gain"]}), "letters, digits and underscores"),
    "nothing to do": (content({"gain": []}), "no primitives"),
    "a wrong primitive": (TEXT.replace(b"thermal_strain", b"magic"), "kind 'magic'"),
    "no JSON": (b"{", "is not valid JSON"),
    "a list for a kind": (TEXT.replace(b'"kind": "thermal_strain"', b'"kind": []'), "the kind []"),
}


@pytest.mark.parametrize("case", sorted(REFUSED))
def test_patches_that_mean_nothing_are_refused_in_one_sentence(case, model, arrays, tmp_path) -> None:
    given, words = REFUSED[case]
    options = {"arrays": arrays} if case in ("beside the wing", "at no place", "on no side") else {}
    with pytest.raises(PatchFileError) as caught:
        build_fmu(model, tmp_path / "wing.fmu", patch=parse_patch(given), **options)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_byte_order_mark_means_nothing_and_an_id_that_comes_twice_is_numbered() -> None:
    assert parse_patch(b"\xef\xbb\xbf" + content()).effects == parse_patch(content()).effects
    rows = json.loads(content(ONE))["effects"] * 3
    again = parse_patch(json.dumps(json.loads(content()) | {"effects": rows}).encode())
    assert [effect.id for effect in again.effects] == ["gain", "gain_2", "gain_3"]


def test_the_command_line_refuses_before_it_models_a_wing(tmp_path) -> None:
    good, broken, out = tmp_path / "patch.json", tmp_path / "broken.json", tmp_path / "wing.fmu"
    good.write_bytes(content())
    broken.write_bytes(b"{")
    for words, sentence in (
        (("--patch", good, "--kind", "compiled"), "build the kind 'python'"),
        (("--patch", broken), "is not valid JSON"),
        (("--patch", tmp_path / "none.json"), "cannot be read"),
        (("--activate",), "no --patch"),
        (("--script", "gear_pump", "--patch", good), "are for the wing"),
    ):
        assert sentence in refused("fmu", "build", "--out", out, *words, code=None)
        assert not out.exists()


@pytest.mark.slow
def test_the_command_line_packs_a_patch_and_lists_its_effects(tmp_path) -> None:
    patch, out = tmp_path / "patch.json", tmp_path / "wing.fmu"
    patch.write_bytes(content())
    said("fmu", "build", "--out", out, "--patch", patch, "--activate")
    shown = command("fmu", "info", out)
    assert "gauge_zero_drift (on)" in " ".join(shown.stdout.split())
    assert "tunable" not in shown.stderr
    assert "effect.gauge_zero_drift.amplitude" not in said("fmu", "info", out, "--no-variables")
