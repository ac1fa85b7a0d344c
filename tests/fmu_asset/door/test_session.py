"""FmiAsset on the wing FMU: right values, refusals in one sentence, state across processes."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fe.runtime.reduced import ReducedModel
from fe.runtime.state import TIP_FORCE
from fmu_asset.door.binding import Binding, parse_binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import BindingError, FmuCallError, FmuInputError, FmuStateError
from tests.wings import wing_integrator

ROOT = Path(__file__).parents[3]
BOTH = pytest.mark.parametrize("isolated", [True, False], ids=["worker", "in process"])


def bind(original: Binding, **changes: object) -> Binding:
    """Return the wing's binding with some tables replaced."""
    content = json.loads(original.model_dump_json(exclude_none=True))
    for observation in content["observation"].values():
        observation["variables"] = list(observation["variables"])
    return parse_binding(content | changes)


@BOTH
def test_quasi_static_step_is_the_static_response(
    model: ReducedModel, fmu: Path, binding: Binding, isolated: bool
) -> None:
    with FmiAsset(fmu, binding, isolated=isolated) as asset:
        for index, (n, z1, z2, force) in enumerate(
            [(3.0, 0.0, 0.0, 0.0), (2.0, 0.4, 0.2, 0.0), (-1.0, 0.8, 0.8, 5.0)]
        ):
            observation = asset.step({"load_factor": n}, {"z1": z1, "z2": z2}, {"tip_force": force})
            expected = model.static_response({"z1": z1, "z2": z2, "load_factor": n, "tip_force": force})
            np.testing.assert_array_equal(observation.values, expected.strain)
            assert observation.extra["tip_displacement"] == expected.displacement[0]
            assert observation.extra["strain_error_bound"] == expected.strain_error_bound
            assert observation.time == index + 1.0


@BOTH
def test_parameters_reach_the_fmu(model: ReducedModel, fmu: Path, binding: Binding, isolated: bool) -> None:
    with FmiAsset(fmu, binding, isolated=isolated, parameters={"young_modulus_factor": 1.05}) as asset:
        for factor in (1.05, 0.95):
            expected = model.static_response({"young_modulus_factor": factor, "load_factor": 3.0})
            seen = asset.step({"load_factor": 3.0})
            assert seen.time == 1.0
            np.testing.assert_array_equal(seen.values, expected.strain)
            asset.reset({"young_modulus_factor": 0.95})


def test_time_is_never_accumulated(fmu: Path, binding: Binding) -> None:
    changed = bind(binding, binding={"name": "wing", "step_size": 0.1, "start_time": 7.0})
    with FmiAsset(fmu, changed, isolated=False) as asset:
        times = [asset.step().time for _ in range(1000)]
    assert times == [7.0 + i * 0.1 for i in range(1, 1001)]


def test_transient_follows_the_modal_integrator(model: ReducedModel, fmu: Path, binding: Binding) -> None:
    """A release, a step in load and a loss of stiffness, to the bit."""
    changed = bind(binding, binding={"name": "wing", "step_size": 0.005})
    damping = {"damping_alpha": 1.0, "damping_beta": 1e-4}
    parameters = {"response": 2.0, "initial_tip_displacement": 0.03, **damping}
    integrator, damaged = (wing_integrator(model, stiffness_loss=(z1, 0.0), **damping) for z1 in (0.0, 0.4))
    state = integrator.released(0.03, (1.0, 0.0), TIP_FORCE)
    with FmiAsset(fmu, changed, parameters=parameters) as asset:
        np.testing.assert_array_equal(asset.observe().values, integrator.outputs(state)[:-1])
        for load_factor, z1 in ((1.0, 0.0), (1.0, 0.0), (3.0, 0.0), (3.0, 0.4), (2.0, 0.4)):
            if z1 and integrator is not damaged:
                state, integrator = damaged.take_over(state, integrator), damaged
            seen = asset.step({"load_factor": load_factor}, {"z1": z1})
            state = integrator.advance(state, 0.005, (load_factor, 0.0))
            expected = integrator.outputs(state)
            np.testing.assert_array_equal(seen.values, expected[:-1])
            assert seen.extra["tip_displacement"] == expected[-1]


@BOTH
@pytest.mark.parametrize("response", [1.0, 2.0], ids=["quasi-static", "transient"])
def test_state_is_restored_to_the_bit_in_a_new_process(
    fmu: Path, binding: Binding, tmp_path: Path, isolated: bool, response: float
) -> None:
    changed = bind(binding, binding={"name": "wing", "step_size": 0.01})
    parameters = {"response": response, "initial_tip_displacement": 0.02, "young_modulus_factor": 1.01}

    def further(asset: FmiAsset) -> list[str]:
        seen = (asset.step({"load_factor": 2.5}, {"z1": z1}) for z1 in (0.2, 0.6))
        return [
            f"{o.values.tobytes().hex()} {o.time.hex()} {o.extra['tip_displacement'].hex()}" for o in seen
        ]

    with FmiAsset(fmu, changed, isolated=isolated, parameters=parameters) as asset:
        asset.step({"load_factor": 2.0}, {"z1": 0.1, "z2": 0.3})
        asset.step({"load_factor": 3.0}, {"z1": 0.2, "z2": 0.3})
        saved = asset.save_state()
        later = further(asset)
        asset.restore_state(saved)
        assert further(asset) == later
    (tmp_path / "state").write_bytes(saved)
    (tmp_path / "binding.json").write_text(changed.model_dump_json(exclude_none=True), encoding="utf-8")
    program = (
        "import json, sys\n"
        "from pathlib import Path\n"
        "from fmu_asset.door.binding import parse_binding\n"
        "from fmu_asset.door.session import FmiAsset\n"
        "folder = Path(sys.argv[2])\n"
        "binding = parse_binding(json.loads((folder / 'binding.json').read_text()))\n"
        "with FmiAsset(sys.argv[1], binding, isolated=sys.argv[3] == 'True') as asset:\n"
        "    asset.restore_state((folder / 'state').read_bytes())\n"
        "    for z1 in (0.2, 0.6):\n"
        "        seen = asset.step({'load_factor': 2.5}, {'z1': z1})\n"
        "        print(seen.values.tobytes().hex(), seen.time.hex(), seen.extra['tip_displacement'].hex())\n"
    )
    words = [sys.executable, "-c", program, fmu, tmp_path, str(isolated)]
    done = subprocess.run(words, cwd=ROOT, check=True, capture_output=True, text=True)
    assert done.stdout.split("\n")[:2] == later


def test_state_of_another_fmu_or_nonsense_is_refused(
    fmu: Path, binding: Binding, spring_mass: Path, spring_binding: Binding
) -> None:
    with FmiAsset(spring_mass, spring_binding, isolated=False) as other:
        other.step()
        foreign = other.save_state()
    with FmiAsset(fmu, binding) as asset:
        before = asset.step({"load_factor": 2.0})
        saved = asset.save_state()
        with pytest.raises(FmuStateError, match="another FMU"):
            asset.restore_state(foreign)
        for nonsense in (b"", b"x" * 40, saved[:30]):
            with pytest.raises(FmuStateError, match="damaged"):
                asset.restore_state(nonsense)
        after = asset.step({"load_factor": 2.0})
        np.testing.assert_array_equal(before.values, after.values)
        with pytest.raises(FmuStateError, match=r"refused the state"):
            asset.restore_state(saved[:-40] + b"\0" * 8)
        with pytest.raises(FmuStateError, match="reset the asset"):
            asset.step()
        asset.reset()
        assert asset.step({"load_factor": 2.0}).time == 1.0


@BOTH
@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (({"load_factor": 9.0},), r"control\.load_factor = 9\.0 lies outside .* 'load_factor', -1 to 4;"),
        (({"load_factor": float("nan")},), r"control\.load_factor must be finite, but is nan"),
        (({"load_factor": float("inf")},), r"must be finite, but is inf"),
        (({}, {"z1": -0.1}), r"health\.z1 = -0\.1 lies outside"),
        (({"load_factor": "fast"},), r"must be a number, but is 'fast'"),
    ],
)
def test_inputs_out_of_range_are_refused_before_they_are_sent(
    fmu: Path, binding: Binding, arguments: tuple[dict[str, float], ...], sentence: str, isolated: bool
) -> None:
    with FmiAsset(fmu, binding, isolated=isolated) as asset:
        before = asset.step({"load_factor": 3.0})
        with pytest.raises(FmuInputError, match=sentence):
            asset.step(*arguments)
        assert asset.step_index == 1
        assert asset.log == ()
        np.testing.assert_array_equal(asset.step().values, before.values)


def test_parameters_are_checked(fmu: Path, binding: Binding) -> None:
    for parameters, kind, sentence in (
        (
            {"young_modulus_factor": 3.0},
            FmuInputError,
            r"parameter\.young_modulus_factor = 3\.0 lies",
        ),
        ({"response": 1.5}, FmuInputError, "whole number"),
        ({"e": 1.0}, BindingError, "no parameter 'e'"),
    ):
        with pytest.raises(kind, match=sentence):
            FmiAsset(fmu, binding, parameters=parameters)
    with FmiAsset(fmu, binding, isolated=False) as asset, pytest.raises(BindingError, match="no control 'n'"):
        asset.step({"n": 1.0})


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"control": {"n": {"variable": "load_facto", "unit": "1"}}}, r"did you mean 'load_factor'"),
        ({"control": {"n": {"variable": "load_factor", "unit": "N"}}}, r"is in 'N', but the FMU has"),
        ({"control": {"n": {"variable": "load_factor", "unit": "furlong"}}}, "no conversion between the two"),
        ({"control": {"n": {"variable": "strain[1]", "unit": "1"}}}, r"must be of causality input"),
        ({"parameter": {"a": {"variable": "load_factor", "unit": "1"}}, "control": {}}, "ity parameter"),
        ({"monitor": {"a": {"variable": "load_factor", "unit": "1"}}}, r"must be of causality output"),
        ({"observation": {"s": {"variables": "strain[{1..25}]", "unit": "1"}}}, r"'strain\[25\]', which is"),
    ],
)
def test_a_binding_that_does_not_fit_is_one_sentence(
    fmu: Path, binding: Binding, table: dict[str, object], sentence: str
) -> None:
    with pytest.raises(BindingError, match=sentence):
        FmiAsset(fmu, bind(binding, **table))


def test_units_are_converted(model: ReducedModel, fmu: Path, binding: Binding) -> None:
    changed = bind(
        binding,
        health={
            "z1": {"variable": "health.z1", "unit": "percent"},
            "z2": {"variable": "health.z2", "unit": "%"},
        },
        load={"tip_force": {"variable": "tip_force", "unit": "kN"}},
        observation={"strain": {"variables": "strain[{1..24}]", "unit": "microstrain"}},
        monitor={"tip": {"variable": "tip_displacement", "unit": "mm"}},
    )
    with FmiAsset(fmu, changed) as asset:
        seen = asset.step({"load_factor": 3.0}, {"z1": 85.0, "z2": 20.0}, {"tip_force": 0.005})
        with pytest.raises(FmuInputError, match=r"0 to 0\.85"):
            asset.step({}, {"z1": 85.1})
    expected = model.static_response({"z1": 0.85, "z2": 0.2, "load_factor": 3.0, "tip_force": 5.0})
    np.testing.assert_allclose(seen.values, 1e6 * expected.strain, rtol=1e-12)
    assert seen.extra["tip"] == pytest.approx(1e3 * expected.displacement[0], rel=1e-12)


def test_the_fmu_itself_refuses_and_says_why(
    fmu: Path, binding: Binding, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the door's own check out of the way, the FMU's is seen: Discard, a sentence, nothing changed."""
    monkeypatch.setattr("fmu_asset.door.layout.Slot.numbers", lambda slot, value: np.array([value]))
    with FmiAsset(fmu, binding) as asset:
        before = asset.step({"load_factor": 3.0})
        for value, sentence in ((99, "lies outside its range"), (float("nan"), "not finite")):
            said = rf"(?s)step 1 from t = 1 s.*Discard.*load_factor.*{sentence}"
            with pytest.raises(FmuCallError, match=said):
                asset.step({"load_factor": value})
        after = asset.step()
        np.testing.assert_array_equal(before.values, after.values)
        assert after.time == 2.0


@pytest.mark.parametrize("response", [1.0, 2.0], ids=["quasi-static", "transient"])
def test_the_load_point_moves_by_its_compliance(
    fmu: Path, binding: Binding, model: ReducedModel, response: float
) -> None:
    monitor = {"load_point": {"variable": "load_point_displacement", "unit": "mm"}}
    changed = bind(binding, binding={"name": "wing", "step_size": 60.0}, monitor=monitor)
    with FmiAsset(fmu, changed, isolated=False, parameters={"response": response}) as asset:
        asset.step({"load_factor": 0.0}, {"z1": 0.2}, {"tip_force": 10.0})
        seen = asset.step().extra["load_point"]
    assert seen == pytest.approx(1e3 * 10.0 / model.tip_stiffness(1.0, (0.2, 0.0)), rel=1e-9)
