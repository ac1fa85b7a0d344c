"""Many steps in one call are the same many calls of `step`, to the bit, whatever happens on the way."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fe.runtime.reduced import ReducedModel
from fmu_asset.compiled.compiler import find_compiler
from fmu_asset.door import session
from fmu_asset.door.binding import Binding
from fmu_asset.door.layout import Observation
from fmu_asset.door.saved_state import SavedState
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import (
    BindingError,
    FmuBuildError,
    FmuCallError,
    FmuInputError,
    FmuOutputError,
    FmuTimeoutError,
    FmuWorkerError,
)
from fmu_asset.packing.structure_fmu import build_fmu

from .conftest import bound

NOT_A_NUMBER, SLEEP, DIE, DISCARD = 1.0, 2.0, 3.0, 5.0
BOTH = pytest.mark.parametrize("isolated", [True, False], ids=["worker", "in process"])
Inputs = Mapping[str, Mapping[str, Any]]


def at_step(inputs: Inputs, index: int, arrays: Sequence[str] = ()) -> dict[str, dict[str, Any]]:
    """Return the inputs of one step, as `step` takes them."""
    return {
        role: {
            name: values[index] if np.ndim(values) > (name in arrays) else values
            for name, values in histories.items()
        }
        for role, histories in inputs.items()
    }


def assert_same_as_steps(
    path: Path,
    binding: Binding,
    inputs: Inputs,
    count: int,
    *,
    isolated: bool,
    arrays: Sequence[str] = (),
    parameters: Mapping[str, float] | None = None,
) -> None:
    with (
        FmiAsset(path, binding, isolated=False, parameters=parameters) as one,
        FmiAsset(path, binding, isolated=isolated, parameters=parameters) as all_at_once,
    ):
        seen: list[Observation] = [one.step(**at_step(inputs, i, arrays)) for i in range(count)]
        history = all_at_once.simulate(**inputs)
        assert history.time.tolist() == [item.time for item in seen]
        assert history.values.tobytes() == np.array([item.values for item in seen]).tobytes()
        assert list(history.extra) == list(seen[0].extra)
        for name, values in history.extra.items():
            assert values.tobytes() == np.array([item.extra[name] for item in seen]).tobytes()
        # Both are in the same state, and the inputs are held. An FMU may write addresses into its own.
        ours, theirs = (SavedState.from_bytes(asset.save_state()) for asset in (all_at_once, one))
        assert (ours.index, ours.inputs, ours.outputs) == (count, theirs.inputs, theirs.outputs)
        if ours.method == "replay":
            assert ours.body == theirs.body
        assert all_at_once.step().values.tobytes() == one.step().values.tobytes()


def wing_inputs(count: int) -> dict[str, dict[str, Any]]:
    draw = np.random.default_rng(5)
    return {
        "control": {"load_factor": draw.uniform(-1.0, 4.0, count)},
        "health": {"z1": draw.uniform(0.0, 0.8, count), "z2": 0.2},
        "load": {"tip_force": np.round(draw.uniform(-15.0, 15.0, count)).astype(int)},
    }


@BOTH
@pytest.mark.parametrize("response", [1.0, 2.0], ids=["quasi-static", "transient"])
@pytest.mark.parametrize("kind", ["python", "compiled"])
def test_the_wing(
    model: ReducedModel,
    tmp_path_factory: pytest.TempPathFactory,
    binding: Binding,
    kind: Any,
    response: float,
    isolated: bool,
) -> None:
    if kind == "compiled":
        try:
            find_compiler()
        except FmuBuildError as error:
            pytest.skip(f"no C compiler: {error}")
    folder = tmp_path_factory.getbasetemp() / "simulated"
    folder.mkdir(exist_ok=True)
    path = folder / f"{kind}.fmu"
    if not path.exists():
        build_fmu(model, path, kind=kind)
    parameters = {"response": response, "initial_tip_displacement": 0.01, "damping_alpha": 0.5}
    assert_same_as_steps(path, binding, wing_inputs(60), 60, isolated=isolated, parameters=parameters)


@BOTH
def test_units_decimation_whole_numbers_and_replay(foreign_fmu: Any, isolated: bool) -> None:
    lag = bound(
        0.05, {"out": ("Out1", "rad/s")}, header={"decimation": 3, "start_time": 1.0},
        control={"speed": ("In1 (rad/s)", "rad/s")}, load={"hold": ("Hold", "1")},
        monitor={"count": ("Count", "1")},
    )  # fmt: skip
    pushes = {"control": {"speed": np.linspace(-2.0, 2.0, 20)}, "load": {"hold": np.arange(20) % 7 == 6}}
    assert_same_as_steps(foreign_fmu("lag1"), lag, pushes, 20, isolated=isolated)
    room = bound(
        60.0, {"room": (["room.T", "room.sensor.T"], "degC")}, control={"power": ("heater.u[1].P", "kW")},
        load={"outside": ("ambient.T", "degC")}, record=["der(room.T)", "room.T"],
    )  # fmt: skip
    power, outside = np.linspace(0.0, 3.0, 25), np.linspace(-5.0, 9.0, 25)
    weather = {"control": {"power": power}, "load": {"outside": outside}}
    assert_same_as_steps(foreign_fmu("room2"), room, weather, 25, isolated=isolated)


@BOTH
def test_whole_arrays_and_model_exchange(foreign_fmu: Any, isolated: bool) -> None:
    load, monitor = {"u": ("u", "1"), "offset": ("offset", "1")}, {"calls": ("calls", "1")}
    array = bound(1.0, {"y": (["y[2]", "y[1]"], "mm")}, load=load, monitor=monitor)
    path, rows = foreign_fmu("array3"), np.random.default_rng(2).normal(size=(12, 3))
    given = {"load": {"u": rows, "offset": np.arange(12) - 5}}
    assert_same_as_steps(path, array, given, 12, isolated=isolated, arrays=["u"])
    assert_same_as_steps(
        path, array, {"load": {"u": rows[0], "offset": np.zeros(4)}}, 4, isolated=isolated, arrays=["u"]
    )
    with (
        FmiAsset(path, array, isolated=False) as asset,
        pytest.raises(FmuInputError, match=r"load\.u must be 3 values, .* has the shape \(12, 2\)"),
    ):
        asset.simulate(load={"u": rows[:, :2]})
    ball = bound(0.1, {"height": ("h", "m")}, header={"interface": "model-exchange"})
    with FmiAsset(foreign_fmu("ball2"), ball, isolated=isolated) as asset:
        history = asset.simulate(steps=15)
        asset.reset()
        assert history.values.tobytes() == np.array([asset.step().values for _ in range(15)]).tobytes()


@BOTH
def test_blocks_follow_one_another(
    spring_mass: Path, spring_binding: Binding, isolated: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session, "_BLOCK_BYTES", 7 * 6 * 8)
    inputs = {"control": {"push": np.sin(np.arange(30.0))}, "health": {"spring": 3.0}}
    assert_same_as_steps(spring_mass, spring_binding, inputs, 30, isolated=isolated)


@BOTH
@pytest.mark.parametrize("bad", [0, 1, 9])
def test_a_discarded_step_leaves_the_asset_before_it(
    spring_mass: Path, spring_binding: Binding, isolated: bool, bad: int
) -> None:
    push = np.linspace(0.0, 1.0, 10)
    misbehaviour = np.where(np.arange(10) == bad, DISCARD, 0.0)
    with (
        FmiAsset(spring_mass, spring_binding, isolated=isolated) as asset,
        FmiAsset(spring_mass, spring_binding, isolated=False) as other,
    ):
        asset.step({"push": 0.3})
        other.step({"push": 0.3})
        with pytest.raises(FmuCallError, match=rf"step {bad + 1} from t = .* returned Discard"):
            asset.simulate({"push": push}, load={"misbehaviour": misbehaviour})
        for value in push[:bad]:
            other.step({"push": value}, load={"misbehaviour": 0.0})
        assert asset.step_index == bad + 1
        assert asset.save_state() == other.save_state()
        assert asset.step().values.tobytes() == other.step().values.tobytes()


@BOTH
def test_a_value_that_is_not_finite_ends_the_run_at_its_step(
    spring_mass: Path, spring_binding: Binding, isolated: bool
) -> None:
    misbehaviour = np.where(np.arange(9) == 4, NOT_A_NUMBER, 0.0)
    with FmiAsset(spring_mass, spring_binding, isolated=isolated) as asset:
        with pytest.raises(FmuOutputError, match=r"not finite at t = 2\.5 s: position.* It was step 4\."):
            asset.simulate({"push": 1.0}, load={"misbehaviour": misbehaviour})
        assert asset.step_index == 5  # as after `step`: the step was made


def test_a_step_that_hangs_or_dies_ends_the_worker(spring_mass: Path, spring_binding: Binding) -> None:
    with FmiAsset(spring_mass, spring_binding, step_timeout=0.4) as asset:
        misbehaviour = np.where(np.arange(500) == 300, SLEEP, 0.0)
        with pytest.raises(FmuTimeoutError, match=r"step \d+ from .* took longer than 0\.4 s for a step"):
            asset.simulate(load={"misbehaviour": misbehaviour})
        assert asset.step_index <= 300
        with pytest.raises(FmuWorkerError, match="reset the asset"):
            asset.simulate(steps=2)
        asset.reset()
        with pytest.raises(FmuWorkerError, match="SIGABRT"):
            asset.simulate(load={"misbehaviour": np.where(np.arange(5) == 3, DIE, 0.0)})
        asset.reset()
        assert asset.simulate(steps=3).extra["steps"].tolist() == [1.0, 2.0, 3.0]


def test_the_limit_is_that_of_a_step_and_not_of_the_run(spring_mass: Path, spring_binding: Binding) -> None:
    with FmiAsset(spring_mass, spring_binding, step_timeout=0.4) as asset:
        # Thousands of steps in one message, which take longer than one may.
        count = 20_000
        assert asset.simulate({"push": 1.0}, steps=count).extra["steps"][-1] == count


def test_a_misspelt_keyword_is_refused(spring_mass: Path, spring_binding: Binding) -> None:
    with FmiAsset(spring_mass, spring_binding, isolated=False) as asset:
        for again in (asset.reset, asset.renew):
            with pytest.raises(TypeError, match="Inputs are control, health, load, port, and 'loads' came"):
                again(loads={})  # type: ignore[call-arg]


def test_inputs_that_are_refused(spring_mass: Path, spring_binding: Binding) -> None:
    both = {"control": {"push": [1.0, 1.0]}, "health": {"spring": [1.0]}}
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"control": {"push": 1.0}}, "Nothing says how many steps"),
        ({"control": {"push": []}}, "Nothing says how many steps"),
        ({"control": {"push": np.ones((3, 2))}}, r"control\.push must be a number, or one for"),
        ({"control": {"push": ["a", "b"]}}, r"control\.push must be numbers"),
        ({"control": {"push": [1.0, np.nan]}}, r"finite.*value of step 1 of the 2"),
        ({"control": {"push": [1.0, np.inf]}}, r"finite.*value of step 1 of the 2"),
        (both, r"health\.spring has 1 steps, but control\.push says 2"),
        ({"load": {"misbehaviour": [0.0, 0.5, 0.0]}}, r"whole number.*value of step 1 of the 3"),
        ({"load": {"lock": [True, 2]}}, r"outside the range.*value of step 1 of the 2"),
        ({"steps": 0}, "steps must be at least 1"),
        ({"control": {"push": [1.0, 2.0]}, "steps": 3}, r"control\.push has 2 steps, but `steps` says 3"),
    ]
    with FmiAsset(spring_mass, spring_binding, isolated=False) as asset:
        for inputs, sentence in wrong:
            with pytest.raises(FmuInputError, match=sentence):
                asset.simulate(**inputs)
        with pytest.raises(BindingError, match=r"has no control 'pull'; it has push"):
            asset.simulate({"pull": 1.0})
        assert asset.step_index == 0
        assert asset.simulate(steps=1).extra["steps"].tolist() == [1.0]


@given(
    power=st.lists(st.floats(-1e3, 1e3) | st.sampled_from([-0.0, 0, 1e-320, True]), min_size=1, max_size=6),
    outside=st.floats(-40.0, 50.0) | st.sampled_from([-40.0, 50.0]),
)
def test_what_is_sent_is_what_a_step_sends(foreign_fmu: Any, power: list[float], outside: float) -> None:
    from fmu_asset.archive.fmu_file import read_fmu
    from fmu_asset.door.exchange import Exchange

    ends = {"control": {"power": ("heater.u[1].P", "kW")}, "load": {"outside": ("ambient.T", "degC")}}
    binding = bound(60.0, {"room": ("room.T", "degC")}, **ends)
    limited = binding.load["outside"].model_copy(update={"minimum": -40.0, "maximum": 50.0})
    binding = binding.model_copy(update={"load": {"outside": limited}})
    exchange = Exchange(read_fmu(foreign_fmu("room2")), binding)
    target, sent, refused = exchange.start_values({}), [], ""
    held, roles = np.array(target), {"control": {"power": power}, "load": {"outside": outside}}
    try:
        for value in power:
            exchange.place(target, {"control": {"power": value}, "load": {"outside": outside}})
            sent.append(list(target))
    except FmuInputError as error:
        refused = error.sentence
    if refused:
        with pytest.raises(FmuInputError, match=re.escape(refused)):
            exchange.rows(held, roles, None)
    else:
        assert exchange.rows(held, roles, None).tobytes() == np.array(sent).tobytes()
