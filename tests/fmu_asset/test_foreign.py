"""FMUs of FMI 1, 2 and 3 as others export them, flown against closed forms or refused with their reason."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fmu_asset.archive.fmu_file import read_fmu
from fmu_asset.door.binding import Binding, parse_binding
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import (
    BindingError,
    FmuCallError,
    FmuEndedError,
    FmuFileError,
    FmuInputError,
    FmuUnsupportedError,
    FmuWorkerError,
)

BOTH = pytest.mark.parametrize("isolated", [True, False], ids=["worker", "in process"])


def binding(step_size: float, *, header: dict[str, Any] | None = None, **roles: Any) -> Binding:
    return parse_binding({"binding": {"name": "foreign", "step_size": step_size, **(header or {})}, **roles})


LAG = {
    "control": {"speed": {"variable": "In1 (rad/s)", "unit": "rad/s", "maximum": 2000.0}},
    "load": {"hold": {"variable": "Hold", "unit": "1"}},
    "parameter": {
        "gain": {"variable": "Lag/Gain [K]", "unit": "1"},
        "time": {"variable": "Lag/Time const", "unit": "ms"},
    },
    "observation": {"out": {"variables": "Out1", "unit": "rad/s"}},
    "monitor": {"count": {"variable": "Count", "unit": "1"}},
}


@BOTH
def test_fmi_1_co_simulation_without_units(foreign_fmu: Any, isolated: bool) -> None:
    described = binding(0.1, header={"fmi_version": "1.0"}, **LAG)
    with FmiAsset(foreign_fmu("lag1"), described, isolated=isolated, parameters={"gain": 3.0}) as asset:
        assert asset.state_method == "replay"
        for number in range(1, 11):
            seen = asset.step({"speed": 2.0})
            assert seen.values[0] == pytest.approx(6.0 * (1.0 - math.exp(-0.1 * number / 0.5)), rel=1e-12)
        held = asset.step(load={"hold": True})
        assert held.values[0] == seen.values[0]
        assert held.extra == {"count": 11.0}
        saved = asset.save_state()
        with pytest.raises(FmuInputError, match=r"parameter\.gain = 101\.0 lies outside .* 0 to 100"):
            asset.reset({"gain": 101.0})
        with pytest.raises(FmuCallError, match=r"(?s)fmiDoStep returned Error.*saturates"):
            asset.step({"speed": 1500.0})
        asset.reset({"gain": 1.0})
        assert asset.step({"speed": 1.0}).values[0] == pytest.approx(1.0 - math.exp(-0.2), rel=1e-12)
        asset.restore_state(saved)
        assert asset.observe().values[0] == held.values[0]


ROOM = {
    "control": {"power": {"variable": "heater.u[1].P", "unit": "kW"}},
    "load": {
        "outside": {"variable": "ambient.T", "unit": "degC", "minimum": -40.0, "maximum": 50.0},
        "on": {"variable": "'heater is on'", "unit": "1"},
    },
    "parameter": {"mode": {"variable": "heater.mode", "unit": "1", "value": 2.0}},
    "observation": {"room": {"variables": ["room.T", "room.sensor.T"], "unit": "degC"}},
    "record": {"variables": ["der(room.T)", "room.T"]},
}


@BOTH
def test_fmi_2_co_simulation_of_a_modelica_tool(foreign_fmu: Any, isolated: bool) -> None:
    with FmiAsset(foreign_fmu("room2"), binding(60.0, **ROOM), isolated=isolated) as asset:
        # Half of 3 kW, over 100 W/K, above 5 degC outside.
        seen = [asset.step({"power": 3.0}, load={"outside": 5.0}) for _ in range(5)][-1]
        expected = 20.0 + (20.0 - 20.0) * math.exp(-300.0 * 100.0 / 5e4)
        np.testing.assert_allclose(seen.values, [expected, expected], rtol=1e-12)
        cooling = asset.step(load={"on": False})
        expected = 5.0 + 15.0 * math.exp(-60.0 * 100.0 / 5e4)
        np.testing.assert_allclose(cooling.values, [expected, expected], rtol=1e-12)
        assert cooling.extra["room.T"] == pytest.approx(expected + 273.15)
        assert cooling.extra["der(room.T)"] == pytest.approx(-100.0 * (expected - 5.0) / 5e4)
        assert asset.recorded_units == {"der(room.T)": "K/s", "room.T": "K"}
        with pytest.raises(FmuInputError, match=r"load\.outside = -41\.0 lies outside"):
            asset.step(load={"outside": -41.0})
        with pytest.raises(FmuInputError, match=r"load\.on = 2 lies outside .* 0 to 1"):
            asset.step(load={"on": 2})


@BOTH
def test_a_fixed_step_is_flown_by_decimation_and_refused_otherwise(foreign_fmu: Any, isolated: bool) -> None:
    roles = {
        "control": {"u": {"variable": "u", "unit": "1"}},
        "observation": {"y": {"variables": "y", "unit": "1"}},
        "monitor": {"calls": {"variable": "calls", "unit": "1"}},
    }
    described = binding(0.01, header={"decimation": 100, "start_time": 5.0}, **roles)
    with FmiAsset(foreign_fmu("fixed2"), described, isolated=isolated) as asset:
        seen = asset.step({"u": 3.0})
        assert (seen.time, seen.extra["calls"]) == (6.0, 100.0)
        assert seen.values[0] == pytest.approx(3.0, rel=1e-12)
        saved = asset.save_state()
        following = asset.step({"u": -1.0}).values.tobytes()
        asset.restore_state(saved)
        assert asset.step({"u": -1.0}).values.tobytes() == following
        # A refusal between two observations leaves nothing to go on from.
        with pytest.raises(FmuCallError, match=r"It was step 5\d of the 100 between two observations"):
            asset.step({"u": 2e6})
        asset.restore_state(saved)
        assert asset.step({"u": -1.0}).values.tobytes() == following
    with (
        FmiAsset(foreign_fmu("fixed2"), binding(1.0, **roles), isolated=isolated) as asset,
        pytest.raises(FmuCallError, match=r"(?s)fmi2DoStep returned Error.*the sample time is 0\.01 s"),
    ):
        asset.step()


ARRAY = {
    "control": {"first": {"variable": "u[1]", "unit": "1"}},
    "load": {
        "offset": {"variable": "offset", "unit": "1"},
        "active": {"variable": "active", "unit": "1"},
        "third": {"variable": "u[3]", "unit": "1"},
    },
    "parameter": {
        "gain": {"variable": "gain", "unit": "1"},
        "corner": {"variable": "A[2,3]", "unit": "1"},
        "first": {"variable": "A[1,1]", "unit": "1"},
    },
    "observation": {"y": {"variables": "y", "unit": "m"}},
    "monitor": {"calls": {"variable": "calls", "unit": "1"}, "y": {"variable": "y_alias", "unit": "mm"}},
}


@BOTH
def test_fmi_3_co_simulation_with_arrays(foreign_fmu: Any, isolated: bool) -> None:
    parameters = {"gain": 0.5, "corner": 10.0}
    with FmiAsset(
        foreign_fmu("array3"), binding(1.0, **ARRAY), isolated=isolated, parameters=parameters
    ) as asset:
        assert asset.binding.observation_variables == ("y[1]", "y[2]")
        matrix = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 10.0]])
        seen = asset.step({"first": 2.0}, load={"third": -1.0, "offset": -3})
        expected = 0.5 * matrix @ [2.0, 0.0, -1.0] - 3.0
        np.testing.assert_allclose(seen.values, 1e-3 * expected, rtol=1e-12)
        assert seen.extra == pytest.approx({"calls": 1.0, "y[1]": expected[0], "y[2]": expected[1]})
        saved = asset.save_state()
        still = asset.step(load={"active": False})
        np.testing.assert_array_equal(still.values, seen.values)
        asset.restore_state(saved)
        assert asset.step(load={"active": False}).extra["calls"] == 2.0
        with pytest.raises(FmuInputError, match=r"load\.offset = 200 lies outside .* -128 to 127"):
            asset.step(load={"offset": 200})
        with pytest.raises(FmuInputError, match=r"control\.first = 11\.0 lies outside .* -10 to 10"):
            asset.step({"first": 11.0})
        with pytest.raises(FmuCallError, match="asked to end the simulation in the step"):
            asset.step(load={"offset": 99})
        asset.reset()
        with pytest.raises(FmuCallError, match="returned early"):
            asset.step(load={"offset": 98})


def test_whole_arrays_take_as_many_values(foreign_fmu: Any) -> None:
    roles = {
        "load": {"u": {"variable": "u", "unit": "1"}},
        "parameter": {"A": {"variable": "A", "unit": "1"}},
        "observation": {"y": {"variables": ["y[2]", "y[1]"], "unit": "mm"}},
    }
    matrix = np.arange(6.0).reshape(2, 3) ** 2
    parameters = {"A": matrix.ravel()}
    with FmiAsset(foreign_fmu("array3"), binding(1.0, **roles), parameters=parameters) as asset:
        seen = asset.step(load={"u": np.array([1.0, -2.0, 3.0])})
        np.testing.assert_allclose(seen.values, (matrix @ [1.0, -2.0, 3.0])[::-1], rtol=1e-12)
        saved = asset.save_state()
        asset.step()
        asset.restore_state(saved)
        other = asset.fork()
        for copy in (asset, other):
            np.testing.assert_array_equal(copy.observe().values, seen.values)
        other.close()
        for wrong, count in ((1.0, 1), ([1.0, 2.0], 2)):
            with pytest.raises(FmuInputError, match=rf"load\.u takes 3 values, but {count} came"):
                asset.step(load={"u": wrong})


def bounces(restitution: float, gravity: float, until: float) -> tuple[float, float, int]:
    """Return height, velocity and number of bounces of a ball let go at 1 m."""
    time = math.sqrt(2.0 / gravity)
    velocity = math.sqrt(2.0 * gravity)
    if until < time:
        return 1.0 - 0.5 * gravity * until**2, -gravity * until, 0
    count = 1
    while True:
        velocity *= restitution
        flight = 2.0 * velocity / gravity
        if time + flight > until:
            left = until - time
            return velocity * left - 0.5 * gravity * left**2, velocity - gravity * left, count
        time += flight
        count += 1


BALL = {
    "control": {"gravity": {"variable": "g", "unit": "m/s2"}},
    "parameter": {"restitution": {"variable": "e", "unit": "1"}},
    "observation": {"ball": {"variables": "h", "unit": "mm"}, "speed": {"variables": "v", "unit": "m/s"}},
    "monitor": {"bounces": {"variable": "bounces", "unit": "1"}},
}


@BOTH
def test_fmi_2_model_exchange_with_state_events(foreign_fmu: Any, isolated: bool) -> None:
    described = binding(0.05, header={"tolerance": 1e-8}, **BALL)
    with FmiAsset(
        foreign_fmu("ball2"), described, isolated=isolated, parameters={"restitution": 0.8}
    ) as asset:
        assert asset.description.interface == "model-exchange"
        counts = []
        for number in range(1, 31):
            seen = asset.step({"gravity": 9.81})
            height, speed, count = bounces(0.8, 9.81, 0.05 * number)
            np.testing.assert_allclose(seen.values, [1e3 * height, speed], rtol=1e-5, atol=2e-3)
            assert seen.extra["bounces"] == count
            counts.append(count)
        assert counts[-1] == 2
        saved = asset.save_state()
        expected = [asset.step().values.tobytes() for _ in range(3)]
        asset.restore_state(saved)
        assert [asset.step().values.tobytes() for _ in range(3)] == expected


def test_a_nominal_of_zero_counts_as_one_and_an_identifier_may_have_a_hyphen(
    foreign_fmu: Any, tmp_path: Path
) -> None:
    fmu = tmp_path / "ball-2.fmu"
    with zipfile.ZipFile(foreign_fmu("ball2", "NOMINAL=0.0")) as source, zipfile.ZipFile(fmu, "w") as target:
        for entry in source.namelist():
            content = source.read(entry).replace(b'modelIdentifier="ball2"', b'modelIdentifier="ball-2"')
            target.writestr(entry.replace("ball2", "ball-2"), content)
    with FmiAsset(fmu, binding(0.05, header={"tolerance": 1e-8}, **BALL), isolated=False) as asset:
        history = asset.simulate(steps=8)
    expected = [bounces(0.7, 9.81, time)[:2] for time in history.time]
    np.testing.assert_allclose(history.values * [1e-3, 1.0], expected, rtol=1e-6)


SECOND_BOUNCE = math.sqrt(2.0 / 9.81) * 2.4


@BOTH
@pytest.mark.parametrize(
    ("model", "observed", "size", "end", "value"),
    [
        ("hostile2", "y", 1.0, 2.5, 2.5),
        ("ball2", "h", 0.1, SECOND_BOUNCE, 0.0),
        ("decay1", "x", 0.3, 1.0, math.exp(-1.0)),
        ("swing3", "a", 0.3, 1.0, 1.0),
    ],
)
def test_an_fmu_that_ends_its_simulation_leaves_what_was_simulated(
    foreign_fmu: Any, isolated: bool, model: str, observed: str, size: float, end: float, value: float
) -> None:
    """Discard and `fmi2Terminated`; events of model exchange in FMI 2, 1 and 3."""
    unit = {"y": "m", "h": "m", "x": "K"}.get(observed, "1")
    sent = {"control": {"u": {"variable": "u", "unit": "m/s"}}} if model == "hostile2" else {}
    described = binding(size, observation={"y": {"variables": observed, "unit": unit}}, **sent)
    with FmiAsset(foreign_fmu(model, "ENDS"), described, isolated=isolated) as asset:
        history = asset.simulate(steps=50)
        assert f"ended at t = {end:g} s" in history.ended
        whole = int(end / size)
        np.testing.assert_allclose(history.time, [*(size * np.arange(1, whole + 1)), end], rtol=1e-6)
        assert history.values[-1, 0] == pytest.approx(value, abs=1e-5)
        with pytest.raises(FmuEndedError, match="has ended its simulation at t = "):
            asset.step()
        asset.reset()
        assert [asset.step().values[0] for _ in range(whole)] == history.values[:whole, 0].tolist()
        with pytest.raises(FmuEndedError, match="asked to end the simulation in the step") as caught:
            asset.step()
        assert caught.value.time == pytest.approx(end, rel=1e-6)
        assert asset.observe().values[0] == history.values[-1, 0]


@BOTH
def test_fmi_1_model_exchange_with_an_input_that_jumps(foreign_fmu: Any, isolated: bool) -> None:
    roles = {
        "control": {"u": {"variable": "u", "unit": "degC"}},
        "parameter": {"k": {"variable": "k", "unit": "1"}},
        "observation": {"x": {"variables": "x", "unit": "K"}},
    }
    described = binding(0.5, header={"tolerance": 1e-9, "start_time": -1.0}, **roles)
    with FmiAsset(foreign_fmu("decay1"), described, isolated=isolated, parameters={"k": 2.0}) as asset:
        asset.reset(control={"u": -273.15})
        x = 1.0
        for number, u in enumerate([0.0, 0.0, 4.0, 4.0, -2.0, -2.0], 1):
            x = u / 2.0 + (x - u / 2.0) * math.exp(-1.0)
            seen = asset.step({"u": u - 273.15})
            assert seen.values[0] == pytest.approx(x, abs=1e-7)
            assert seen.time == -1.0 + 0.5 * number
        asset.reset()
        assert asset.observe().values[0] == 1.0


@BOTH
def test_fmi_3_model_exchange_with_a_time_event(foreign_fmu: Any, isolated: bool) -> None:
    roles = {
        "parameter": {"w": {"variable": "w", "unit": "rad/s"}},
        "observation": {"x": {"variables": "x", "unit": "1"}, "a": {"variables": "a", "unit": "1"}},
    }
    described = binding(0.3, header={"tolerance": 1e-9}, **roles)
    with FmiAsset(foreign_fmu("swing3"), described, isolated=isolated, parameters={"w": 3.0}) as asset:
        for number in range(1, 9):
            seen = asset.step()
            time = 0.3 * number
            x, v = 0.5 * math.cos(3.0 * min(time, 1.0)), -1.5 * math.sin(3.0 * min(time, 1.0))
            if time > 1.0:
                phase = 3.0 * (time - 1.0)
                x, v = (
                    1.0 + (x - 1.0) * math.cos(phase) + v / 3.0 * math.sin(phase),
                    v * math.cos(phase) - 3.0 * (x - 1.0) * math.sin(phase),
                )
            np.testing.assert_allclose(seen.values, [x, v, float(time > 1.0)], atol=1e-6)


@pytest.mark.parametrize(
    ("variable", "sentence"),
    [
        ("ticked", "which changes with a clock; clocks are not supported"),
        ("blob", "is of type Binary; only numbers can be bound"),
        ("tick", "is of type Clock; only numbers can be bound"),
        ("u[4]", "but 'u' has 3 elements, counted from 1"),
        ("u[0]", "but 'u' has 3 elements, counted from 1"),
        ("u[1,1]", "but 'u' has 3 elements, counted from 1"),
        ("n", "must be of causality input, but 'n' is declared as structuralParameter"),
        ("activ", "not a variable of .*did you mean 'active'"),
    ],
)
def test_what_cannot_be_bound_is_named(foreign_fmu: Any, variable: str, sentence: str) -> None:
    roles = {
        "load": {"it": {"variable": variable, "unit": "1"}},
        "observation": {"y": {"variables": "y", "unit": "mm"}},
    }
    with pytest.raises(BindingError, match=rf"load\.it of the binding foreign .*{sentence}"):
        FmiAsset(foreign_fmu("array3"), binding(1.0, **roles))


@pytest.mark.parametrize(
    ("inputs", "sentence"),
    [
        (
            {"load": {"all": {"variable": "u", "unit": "1"}, "one": {"variable": "u[2]", "unit": "1"}}},
            r"load\.one and load\.all set the same value of 'u'; keep one",
        ),
        (
            {
                "port": {
                    "p": {
                        "force": {"variables": ["u[2]", "u[2]"], "unit": "N"},
                        "displacement": {"variables": ["y[1]", "y[2]"], "unit": "mm"},
                    }
                }
            },
            r"port\.p\.force and port\.p\.force set the same value of 'u'; keep one",
        ),
    ],
)
def test_one_value_is_set_by_one_input(foreign_fmu: Any, inputs: dict[str, Any], sentence: str) -> None:
    roles = {**inputs, "observation": {"y": {"variables": "y", "unit": "mm"}}}
    with pytest.raises(BindingError, match=sentence):
        FmiAsset(foreign_fmu("array3"), binding(1.0, **roles))


def test_other_kinds_are_refused_with_their_reason(foreign_fmu: Any, tmp_path: Path) -> None:
    with pytest.raises(BindingError, match=r"is for FMI 2\.0, but .* is of FMI 1\.0"):
        FmiAsset(foreign_fmu("lag1"), binding(0.1, header={"fmi_version": "2.0"}, **LAG))
    with pytest.raises(FmuUnsupportedError, match=r"offers model-exchange only, .* asks for co-simulation"):
        FmiAsset(foreign_fmu("ball2"), binding(0.1, header={"interface": "co-simulation"}, **BALL))
    scheduled = foreign_fmu.changed("swing3", "scheduled", ("<ModelExchange", "<ScheduledExecution"))
    with pytest.raises(FmuUnsupportedError, match="scheduled execution is not supported"):
        read_fmu(scheduled)
    outside = {**LAG, "control": {"speed": {"variable": "In1 (rad/s)", "unit": "m"}}}
    described = foreign_fmu.changed(
        "lag1", "unit", ('<Real start="0.0"/>', '<Real start="0.0" unit="rad/s"/>')
    )
    with pytest.raises(BindingError, match=r"control\.speed is in 'm', but the FMU has .* in 'rad/s'"):
        FmiAsset(described, binding(0.1, **outside))


PORT = {
    "observation": {"y": {"variables": "room.T", "unit": "K"}},
    "port": {
        "root": {
            "force": {"variables": "heater.u[1].P", "unit": "N"},
            "displacement": {"variables": "room.T", "unit": "mm"},
            "velocity": {"variables": "der(room.T)", "unit": "m/s"},
        }
    },
}


def test_ports_are_sent_and_read(foreign_fmu: Any) -> None:
    beam = foreign_fmu.changed(
        "room2", "beam", ('unit="W"', 'unit="kN"'), ('name="W"', 'name="kN"'),
        ('<BaseUnit kg="1" m="2" s="-3"/>', '<BaseUnit kg="1" m="1" s="-2" factor="1000"/>'),
        ('unit="K"', 'unit="m"'), ('name="K"', 'name="m"'), ('unit="K/s"', 'unit="m/s"'),
        ('<Unit name="K/s"/>', '<Unit name="m/s"/>'), ('<BaseUnit K="1"/>', '<BaseUnit m="1"/>'),
    )  # fmt: skip
    described = {**PORT, "observation": {"y": {"variables": "room.T", "unit": "m"}}}
    with FmiAsset(beam, binding(60.0, **described)) as asset:
        seen = asset.step(port={"root.force": 1.0e6})
        steady = 283.15 + 1000.0 / 100.0
        expected = steady + (293.15 - steady) * math.exp(-60.0 * 100.0 / 5e4)
        assert seen.extra["root.displacement"] == pytest.approx(1e3 * expected)
        assert asset.recorded_units == {"root.displacement": "mm", "root.velocity": "m/s"}
    both = {**described, "port": {"root": {**PORT["port"]["root"]}}}
    both["port"]["root"]["displacement"] = {"variables": "ambient.T", "unit": "m"}
    with pytest.raises(BindingError, match=r"force and motion are both inputs of the FMU"):
        FmiAsset(beam, binding(60.0, **both))


@pytest.mark.parametrize(
    ("port", "sentence"),
    [
        ({"force": {"variables": "f", "unit": "N"}}, "needs a displacement or a velocity"),
        (
            {"force": {"variables": "f", "unit": "N"}, "velocity": {"variables": "v", "unit": "m"}},
            "velocity is in 'm', but must be in m/s or rad/s",
        ),
    ],
)
def test_ports_that_are_none(port: dict[str, Any], sentence: str) -> None:
    with pytest.raises(BindingError, match=sentence):
        binding(1.0, observation={"y": {"variables": "y", "unit": "1"}}, port={"root": port})


def test_both_interfaces_in_one_fmu(foreign_fmu: Any) -> None:
    """Co-simulation is taken unless the binding says otherwise; a model without states is solved as well."""
    both = foreign_fmu.changed(
        "fixed2", "both", ("<CoSimulation", '<ModelExchange modelIdentifier="fixed2"/><CoSimulation')
    )
    roles = {
        "control": {"u": {"variable": "u", "unit": "1"}},
        "observation": {"y": {"variables": "y", "unit": "1"}},
    }
    for interface, expected in ((None, 0.03), ("co-simulation", 0.03), ("model-exchange", 0.0)):
        header = {} if interface is None else {"interface": interface}
        with FmiAsset(both, binding(0.01, header=header, **roles)) as asset:
            assert asset.description.interface == (interface or "co-simulation")
            assert asset.step({"u": 3.0}).values[0] == pytest.approx(expected)


def test_an_array_beyond_reason_is_refused(foreign_fmu: Any) -> None:
    huge = foreign_fmu.changed(
        "array3", "huge", ('<Dimension start="2"/>', '<Dimension start="2000000000"/>')
    )
    with pytest.raises(
        FmuFileError, match=r"cannot be read \('y' is an array of 2000000000 elements; 10000000 are the most"
    ):
        read_fmu(huge)


def test_events_that_pile_up_are_one_sentence(foreign_fmu: Any) -> None:
    with FmiAsset(foreign_fmu("ball2"), binding(1.0, **BALL)) as asset:
        asset.step(), asset.step()
        with pytest.raises(FmuCallError, match=r"10000 events in the step from t = 2 s .* pile up"):
            asset.step()
        with pytest.raises(FmuWorkerError, match="reset the asset"):
            asset.step()


def test_a_port_of_several_directions(foreign_fmu: Any) -> None:
    """Elements of an array go in, a whole array comes out."""
    port = {
        "force": {"variables": ["u[1]", "u[3]"], "unit": "kN"},
        "displacement": {"variables": "y", "unit": "m"},
    }
    roles = {"observation": {"y": {"variables": "y[1]", "unit": "mm"}}, "port": {"tip": port}}
    fmu = foreign_fmu.changed("array3", "forces", ('min="-10" max="10"', 'min="-10" max="10" unit="N"'))
    with FmiAsset(fmu, binding(1.0, **roles)) as asset:
        seen = asset.step(port={"tip.force": [0.002, -0.001]})
        expected = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]) @ [2.0, 0.0, -1.0]
        found = [seen.extra["tip.displacement[1]"], seen.extra["tip.displacement[2]"]]
        np.testing.assert_allclose(found, 1e-3 * expected, rtol=1e-12)
        with pytest.raises(FmuInputError, match=r"port\.tip\.force takes 2 values, but 1 came"):
            asset.step(port={"tip.force": 1.0})
    three = {**port, "force": {"variables": "u", "unit": "N"}}
    with pytest.raises(BindingError, match=r"port\.tip\.displacement .* has 2 values and the force 3"):
        FmiAsset(fmu, binding(1.0, **{**roles, "port": {"tip": three}}))
