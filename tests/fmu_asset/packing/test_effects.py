"""Missing effects of sensors in the FMU: variables, switches between steps, state, bit-identity while off."""

from __future__ import annotations

import json
import math
import re
import sys
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy import read_model_description
from fmpy.validation import validate_fmu
from hypothesis import given, settings
from hypothesis import strategies as st

from discrepancy.models.high_pass import filtered_record
from fe.runtime.patch import (
    Clock,
    DecayingLine,
    HighPass,
    Line,
    MicroSlip,
    ModelPatch,
    RunOffset,
    SensorDrift,
    SensorGain,
    ThermalStrain,
)
from fe.runtime.reduced import ReducedModel
from fe.runtime.sensors import SensorRecord, apply_sensors
from fmu_asset.check import check_fmu
from fmu_asset.door.binding import Binding, parse_binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuCallError, FmuInputError, PatchFileError
from fmu_asset.packing.patch_file import SCHEMA, PatchFile, parse_patch
from fmu_asset.packing.structure_fmu import build_fmu
from fmu_asset.slaves.effects import active_primitives, effect_rows, numbers_of, output_channels
from tests.command_line import command

BIN = Path(sys.executable).parent
ROOT = Path(__file__).parents[3]
CHANNELS = output_channels(24)
EFFECTS = {
    "gauge_zero_drift": [SensorDrift("g17", 4e-5, 10.0, 0.5)],
    "gauge_gain": [SensorGain("g3", 0.1), SensorGain("strain[5]", -0.04)],
    "coupling": [HighPass("*", 3.0, 2.0, "strain"), HighPass("tip", 0.7)],
    "hum": [Line("*", 0.3, 1e-5, 2e-5, "strain"), DecayingLine("tip", 0.2, 0.1, 0.01, 0.0)],
    "thermal_strain": [ThermalStrain("*", 1.2e-5)],
}


def content(effects: Mapping[str, Sequence[Any]] = EFFECTS, **further: object) -> bytes:
    rows = [
        {"id": name, "place": "anywhere", "primitives": ModelPatch(tuple(items)).to_list()}
        for name, items in effects.items()
    ]
    channels = {"g17": "strain[17]", "g3": "strain[3]", "tip": "tip_displacement"}
    record = {"schema": SCHEMA, "effects": rows, "channels": channels, "verdict": "ignored"}
    return json.dumps(record | further).encode()


@pytest.fixture(scope="session")
def patch() -> PatchFile:
    return parse_patch(content())


@pytest.fixture(scope="session")
def patched(model: ReducedModel, patch: PatchFile, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_fmu(model, tmp_path_factory.mktemp("patched") / "wing.fmu", patch=patch).path


@pytest.fixture(scope="session")
def everything() -> Binding:
    """A binding of the wing that observes all outputs."""
    record = {
        "binding": {"name": "all", "step_size": 0.05},
        "control": {"load_factor": {"variable": "load_factor", "unit": "1"}},
        "health": {name: {"variable": f"health.{name}", "unit": "1"} for name in ("z1", "z2")},
        "load": {"tip_force": {"variable": "tip_force", "unit": "N"}},
        "parameter": {"response": {"variable": "response", "unit": "1"},
                      "release": {"variable": "initial_tip_displacement", "unit": "m"}},
        "observation": {"all": {"variables": [name for name, _ in CHANNELS], "unit": "1"}},
        "record": {"variables": ["strain_error_bound", "frequency[{1..6}]", "damping_ratio[{1..6}]"]},
    }  # fmt: skip
    record["observation"]["all"]["unit"] = ["1"] * 24 + ["m"] * 2  # type: ignore[index]
    return parse_binding(record)


@pytest.fixture(scope="session")
def sending(everything: Binding) -> Binding:
    record = everything.model_dump(exclude_none=True, mode="json")
    record["load"]["drift"] = {"variable": "effect.gauge_zero_drift.active", "unit": "1"}
    record["load"]["time_constant"] = {"variable": "effect.coupling.time_constant[2]", "unit": "s"}
    record["load"]["temperature"] = {"variable": "temperature_difference", "unit": "K"}
    return parse_binding(record)


def flown(fmu: Path, binding: Binding, inputs: list[dict[str, float]], **parameters: float) -> np.ndarray:
    with FmiAsset(fmu, binding, isolated=False, parameters=parameters) as asset:
        rows = []
        for row in inputs:
            seen = asset.step(
                {"load_factor": row["n"]}, {"z1": row["z1"], "z2": row["z2"]}, {"tip_force": row["f"]}
            )
            rows.append([*seen.values, *seen.extra.values()])
        return np.array(rows)


ROW = st.fixed_dictionaries(
    {"n": st.floats(-1.0, 4.0), "z1": st.sampled_from([0.0, 0.3, 0.8]), "z2": st.floats(0.0, 0.8),
     "f": st.floats(-20.0, 20.0)}
)  # fmt: skip


@settings(max_examples=12, deadline=None)
@given(inputs=st.lists(ROW, min_size=1, max_size=6), response=st.sampled_from([1.0, 2.0]))
@pytest.mark.long
def test_off_is_the_plain_wing_to_the_bit(
    fmu: Path, patched: Path, everything: Binding, inputs: list[dict[str, float]], response: float
) -> None:
    given = {"response": response, "release": 0.02 if response == 2.0 else 0.0}
    plain = flown(fmu, everything, inputs, **given)
    assert plain.tobytes() == flown(patched, everything, inputs, **given).tobytes()


def test_what_is_packed_imports_nothing_of_the_project(fmu: Path, patched: Path) -> None:
    project = re.compile(rb"^\s*(?:from|import) (?:fe|fmu_asset|reporting)\b", re.MULTILINE)
    for file in (fmu, patched):
        with zipfile.ZipFile(file) as archive:
            names = [name for name in archive.namelist() if name.endswith(".py")]
            assert not [name for name in names if project.search(archive.read(name))]


def test_the_table_only_grows_at_its_end(fmu: Path, patched: Path) -> None:
    plain, more = (read_model_description(str(path)).modelVariables for path in (fmu, patched))
    for one, other in zip(plain, more, strict=False):
        assert (one.name, one.valueReference, one.start) == (other.name, other.valueReference, other.start)
    added = {row.name: row for row in more[len(plain) :]}
    assert list(added)[:4] == [
        "effect.gauge_zero_drift.active",
        "effect.gauge_zero_drift.amplitude",
        "effect.gauge_zero_drift.time",
        "effect.gauge_zero_drift.exponent",
    ]
    assert "effect.gauge_gain.gain[2]" in added
    drift = added["effect.gauge_zero_drift.amplitude"]
    assert (drift.causality, drift.variability, drift.unit, float(drift.start)) == (
        "parameter",
        "tunable",
        "1",
        4e-5,
    )
    assert added["effect.coupling.time_constant[2]"].unit == "s"
    assert added["effect.hum.cosine[2]"].unit == "1"  # metres per metre of the release
    assert added["temperature_difference"].causality == "input"
    assert float(added["effect.coupling.active"].start) == 0.0


def test_it_is_sound_and_two_builds_are_equal(
    model: ReducedModel, patch: PatchFile, patched: Path, tmp_path: Path
) -> None:
    assert build_fmu(model, tmp_path / "again.fmu", patch=patch).path.read_bytes() == patched.read_bytes()
    on = build_fmu(model, tmp_path / "on.fmu", patch=patch, activate=True)
    changed = content(EFFECTS | {"gauge_gain": [SensorGain("g3", 0.11)]})
    other = build_fmu(model, tmp_path / "other.fmu", patch=parse_patch(changed))
    assert len({read_model_description(str(path)).guid for path in (patched, on.path, other.path)}) == 3
    assert validate_fmu(str(patched)) == []
    found = check_fmu(patched, cycles=120)
    assert found.passed
    assert [item for item in found.findings if item.verdict != "ok"] == []


def test_quasi_static_sensor_effects_are_those_of_whole_records(
    patched: Path, everything: Binding, fmu: Path
) -> None:
    inputs = [{"n": n, "z1": 0.1, "z2": 0.0, "f": 0.0} for n in (1.0, 2.0, -1.0, 3.0)]
    on = {f"effect.{name}.active": 1.0 for name in EFFECTS}
    shown = flown(patched, everything, inputs, **on)[:, :26]
    plain = flown(fmu, everything, inputs)[:, :26]
    whole = ModelPatch(
        tuple(item for effect in parse_patch(content()).for_gauges(24).effects for item in effect.patch)
    )
    record = SensorRecord(CHANNELS, "flight", 0.05 * np.arange(1, 5), 0.0, np.zeros(4))
    expected, _ = apply_sensors(whole, record, plain, filtered=filtered_record)
    np.testing.assert_allclose(shown, expected, rtol=1e-13, atol=0.0)
    assert not np.allclose(shown, plain)


def test_transient_sensor_effects_are_those_of_whole_records(
    patched: Path, fmu: Path, everything: Binding
) -> None:
    steps = 80
    inputs = [{"n": 0.0, "z1": 0.0, "z2": 0.0, "f": 0.0}] * steps
    record = everything.model_dump(exclude_none=True, mode="json")
    record["binding"]["start_time"] = 2.0
    binding = parse_binding(record)
    parameters = {"response": 2.0, "release": 0.03}
    rows = []
    for path, on in ((fmu, {}), (patched, {f"effect.{name}.active": 1.0 for name in EFFECTS})):
        with FmiAsset(path, binding, isolated=False, parameters=parameters | on) as asset:
            asset.reset(control={"load_factor": 0.0})
            own = [asset.observe().values]
            own += [asset.step({"load_factor": row["n"]}).values for row in inputs]
        rows.append(np.array(own))
    plain, shown = rows
    whole = ModelPatch(
        tuple(item for effect in parse_patch(content()).for_gauges(24).effects for item in effect.patch)
    )
    since = 0.05 * np.arange(steps + 1)
    seen = SensorRecord(CHANNELS, "ringdown", since, 2.0, np.zeros(steps + 1), release=0.03)
    expected, _ = apply_sensors(whole, seen, plain, filtered=filtered_record)
    scale = np.abs(expected).max(axis=0)
    np.testing.assert_allclose(shown / scale, expected / scale, rtol=0.0, atol=1e-12)


def test_switches_and_values_change_between_steps(patched: Path, fmu: Path, sending: Binding) -> None:
    with (
        FmiAsset(patched, sending, isolated=False) as asset,
        FmiAsset(fmu, ROOT / "scenarios/bindings/uav_wing.toml") as plain,
    ):
        expected = plain.step({"load_factor": 2.0}).values
        seen = [
            asset.step({"load_factor": 2.0}, load={"drift": on}).values[16] for on in (0.0, 1.0, 0.0, 1.0)
        ]
        assert seen[0] == seen[2] == expected[16]
        assert seen[1] - expected[16] == pytest.approx(4e-5 * math.sqrt(0.1 / 10.0), rel=1e-9)
        assert seen[3] - expected[16] == pytest.approx(4e-5 * math.sqrt(0.2 / 10.0), rel=1e-9)
        warm = asset.step(load={"drift": 0.0, "temperature": 5.0}).values
        np.testing.assert_array_equal(warm[:24], expected)  # the effect of temperature is off
        state = asset.save_state()
        with asset.fork() as other:
            other.restore_state(state)
            for one in (asset, other):
                one.step(load={"drift": 1.0})
            assert asset.observe().values.tobytes() == other.observe().values.tobytes()


def test_thermal_strain_follows_its_input(patched: Path, sending: Binding) -> None:
    with FmiAsset(
        patched, sending, isolated=False, parameters={"effect.thermal_strain.active": 1.0}
    ) as asset:
        cold = asset.step({"load_factor": 1.0}).values
        warm = asset.step(load={"temperature": 4.0}).values
    np.testing.assert_allclose(warm[:24] - cold[:24], 4.8e-5, rtol=1e-9)
    np.testing.assert_array_equal(warm[24:], cold[24:])


def test_values_that_cannot_be_are_refused_and_change_nothing(patched: Path, sending: Binding) -> None:
    with FmiAsset(
        patched, sending, isolated=False, parameters={"effect.coupling.active": 1.0, "response": 2.0}
    ) as asset:
        asset.step({"load_factor": 1.0})
        before = asset.save_state()
        with pytest.raises(FmuCallError, match="positive time constant") as caught:
            asset.step({"load_factor": 3.0}, load={"time_constant": -1.0})
        assert "the state is as it was" in str(caught.value)
        seen = asset.step({"load_factor": 3.0}, load={"time_constant": 0.7})
        asset.restore_state(before)
        assert asset.step({"load_factor": 3.0}).values.tobytes() == seen.values.tobytes()
        with pytest.raises(FmuInputError, match="range"):
            asset.step(load={"drift": 1.5})


@pytest.mark.parametrize("response", [1.0, 2.0])
def test_state_goes_on_to_the_bit_in_a_new_process(patched: Path, sending: Binding, response: float) -> None:
    on = {"effect.coupling.active": 1.0, "effect.hum.active": 1.0, "response": response, "release": 0.01}
    if response == 1.0:
        del on["release"]
    with FmiAsset(patched, sending, parameters=on) as one, FmiAsset(patched, sending, parameters=on) as other:
        for n in (1.0, 2.0, 0.5):
            one.step({"load_factor": n}, {"z1": 0.1 * n}, load={"drift": 1.0})
        other.restore_state(one.save_state())
        for n in (1.5, 3.0):
            seen = [asset.step({"load_factor": n}, load={"temperature": n}) for asset in (one, other)]
            assert seen[0].values.tobytes() == seen[1].values.tobytes()
            assert seen[0].extra == seen[1].extra


@given(st.data())
def test_values_and_patch_belong_together(data: st.DataObject) -> None:
    effects = parse_patch(content()).for_gauges(24).plain
    rows = effect_rows(effects, 7, {})
    assert [row.reference for row in rows] == list(range(7, 7 + len(rows)))
    value = {row.name: float(row.start or 0.0) for row in rows}
    assert active_primitives(effects, value) == []
    on = data.draw(st.sets(st.sampled_from(sorted(EFFECTS))))
    value |= {f"effect.{name}.active": 1.0 for name in on}
    changed = data.draw(st.sampled_from([name for effect in effects for name in numbers_of(effect)]))
    value[changed] = 0.125
    found = ModelPatch.from_list(active_primitives(effects, value)).to_list()
    expected = []
    for effect in effects:
        rows_of = [dict(item) for item in effect["primitives"]]
        for name, (number, key) in numbers_of(effect).items():
            if name == changed:
                rows_of[number][key] = 0.125
        expected += rows_of if effect["id"] in on else []
    assert found == expected


REFUSED = {
    "a clock": (content({"clock": [Clock(1e-3, 0.0)]}), "no meaning inside an FMU"),
    "an offset of a run": (content({"seat": [RunOffset("A", 1e-3)]}), "no meaning inside an FMU"),
    "a channel that is none": (content({"gain": [SensorGain("g9", 0.1)]}), "'g9', which is no output"),
    "a channel that is no gauge": (content({"hot": [ThermalStrain("tip", 1e-6)]}), "which is no output"),
    "half a stage": (content({"filter": [HighPass("g3", 1.0, 1.5)]}), "whole stages only"),
    "another quantity": (content({"gain": [SensorGain("*", 0.1, "velocity")]}), "strains and displacements"),
    "another schema": (content(schema="uav-twin patch 9"), "uav-twin patch 9"),
    "no effect": (content({}), "names no effect"),
    "an id that is no name": (content({"a b": [SensorGain("g3", 0.1)]}), "letters, digits and underscores"),
    "nothing to do": (content({"gain": []}), "no primitives"),
    "a wrong primitive": (content().replace(b"thermal_strain", b"magic"), "kind 'magic'"),
    "no JSON": (b"{", "is not valid JSON"),
    "a long number": (content().replace(b'"schema"', b'"n": ' + b"1" * 5000 + b', "schema"'), "5000 digits"),
    "a number that is none": (content({"gain": [SensorGain("g3", 0.1)]}).replace(b"0.1", b"NaN"), "NaN"),
    "a law that cannot be": (content({"slip": [MicroSlip("tip", 1.0, 2.0, 0.5)]}), "-chi of 'micro_slip'"),
    "a host of elements": (
        content({"slip": [MicroSlip("tip", 1.0, 2.0, 0.0, 10**12)]}), "must be 10000 at most"
    ),
    "a nest": (b"[" * 5000 + b"]" * 5000, "nested deeper than 32"),
    "a list for a kind": (content().replace(b'"kind": "thermal_strain"', b'"kind": []'), "the kind []"),
    "two bytes a letter": (content().decode().encode("utf-16"), "not text in UTF-8"),
}  # fmt: skip


@pytest.mark.parametrize("case", sorted(REFUSED))
def test_patches_that_mean_nothing_are_refused_in_one_sentence(
    case: str, model: ReducedModel, tmp_path: Path
) -> None:
    given, words = REFUSED[case]
    with pytest.raises(PatchFileError) as caught:
        build_fmu(model, tmp_path / "wing.fmu", patch=parse_patch(given))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_byte_order_mark_means_nothing() -> None:
    assert parse_patch(b"\xef\xbb\xbf" + content()).effects == parse_patch(content()).effects


def test_an_id_that_comes_twice_is_numbered() -> None:
    rows = json.loads(content({"gain": [SensorGain("g3", 0.1)]}))["effects"] * 3
    record = json.loads(content()) | {"effects": rows}
    assert [effect.id for effect in parse_patch(json.dumps(record).encode()).effects] == [
        "gain",
        "gain_2",
        "gain_3",
    ]


def test_the_command_line_refuses_before_it_models_a_wing(tmp_path: Path) -> None:
    (tmp_path / "patch.json").write_bytes(content())
    (tmp_path / "broken.json").write_bytes(b"{")
    out = tmp_path / "wing.fmu"
    for words, sentence in (
        (("--patch", tmp_path / "patch.json", "--kind", "compiled"), "build the kind 'python'"),
        (("--patch", tmp_path / "broken.json"), "is not valid JSON"),
        (("--patch", tmp_path / "none.json"), "cannot be read"),
        (("--activate",), "no --patch"),
        (("--script", "gear_pump", "--patch", tmp_path / "patch.json"), "are for the wing"),
    ):
        done = command("fmu", "build", "--out", out, *words)
        assert done.returncode != 0
        assert sentence in " ".join(done.stderr.replace("│", " ").split())
        assert "Traceback" not in done.stderr
        assert not out.exists()


@pytest.mark.slow
def test_the_command_line_packs_a_patch_and_lists_its_effects(tmp_path: Path) -> None:
    (tmp_path / "patch.json").write_bytes(content())
    done = command(
        "fmu", "build", "--out", tmp_path / "wing.fmu", "--patch", tmp_path / "patch.json", "--activate"
    )
    assert done.returncode == 0, done.stderr
    shown = command("fmu", "info", tmp_path / "wing.fmu")
    assert "gauge_zero_drift (on)" in " ".join(shown.stdout.split())
    assert "tunable" not in shown.stderr
    shown = command("fmu", "info", tmp_path / "wing.fmu", "--no-variables")
    assert "effect.gauge_zero_drift.amplitude" not in shown.stdout
