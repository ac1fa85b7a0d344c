"""A coupled flight interrupted anywhere goes on to the bit, in this process or in workers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import Component, Setting, SystemStructure
from fmu_asset.door.binding import Binding, parse_binding
from fmu_asset.errors import FmuInputError, FmuOutputError, FmuStateError, FmuWorkerError

from .conftest import linear, system, watch

NAN, DIE = 1.0, 3.0


@pytest.fixture(scope="module")
def three(companions: dict[str, Path], fmu: Path) -> SystemStructure:
    """Damage growth, the small wing and the gauges."""
    damage = {"probability.z1": Setting(0.5), "probability.z2": Setting(0.4), "seed": Setting(7)}
    gauges = {"noise": Setting(150.0, "microstrain"), "dropout_probability": Setting(10.0, "%")}
    return system(
        [
            Component("damage", companions["damage_growth"], damage),
            Component("gauges", companions["strain_gauges"], gauges),
            Component("wing", fmu, {"response": Setting("transient"), "damping.alpha": Setting(1.0)}),
        ],
        [
            ("load_factor", "wing.load_factor"),
            ("load_factor", "damage.load_factor"),
            ("damage.z1", "wing.health.z1"),
            ("damage.z2", "wing.health.z2"),
            ("wing.strain[{1..24}]", "gauges.strain[{1..24}]"),
        ],
    )


@pytest.fixture(scope="module")
def readings() -> Binding:
    return parse_binding(
        {
            "binding": {"name": "three", "step_size": 0.5},
            "control": {"load_factor": {"variable": "load_factor", "unit": "1"}},
            "observation": {
                "strain": {"variables": "gauges.reading[{1..24}]", "unit": "microstrain"},
                "received": {"variables": "gauges.received[{1..24}]", "unit": "1"},
            },
            "parameter": {"seed": {"variable": "gauges.seed", "unit": "1"}},
            "monitor": {"z1": {"variable": "damage.z1", "unit": "%"}},
        }
    )


def fly(asset: CoupledAsset, steps: range) -> list[bytes]:
    seen = []
    for index in steps:
        observation = asset.step({"load_factor": 2.0 + index % 2})
        seen.append(observation.values.tobytes() + np.float64(observation.extra["z1"]).tobytes())
    return seen


def test_worker_process_and_resumption_are_equal_to_the_bit(
    three: SystemStructure, readings: Binding
) -> None:
    with CoupledAsset(three, readings, isolated=False, parameters={"seed": 5.0}) as asset:
        assert asset.schedule.order == ("damage", "wing", "gauges")
        whole = fly(asset, range(12))
    assert len(set(whole)) == 12
    with CoupledAsset(three, readings, parameters={"seed": 5.0}) as asset:
        part = fly(asset, range(5))
        state = asset.save_state()
        assert asset.save_state() == state
        part += fly(asset, range(5, 7))
    assert part == whole[:7]
    for isolated in (True, False):
        with CoupledAsset(three, readings, isolated=isolated) as asset:
            asset.restore_state(state)
            assert asset.step_index == 5
            assert fly(asset, range(5, 12)) == whole[5:]
            assert asset.time == 6.0
    with CoupledAsset(three, readings, isolated=False, parameters={"seed": 6.0}) as asset:
        assert fly(asset, range(3)) != whole[:3]


def test_a_system_is_flown_in_one_go_and_forked_as_one_fmu_is(
    three: SystemStructure, readings: Binding
) -> None:
    inner = {"variables": ["wing.tip_displacement", "damage.z2"]}
    binding = parse_binding(readings.model_dump(exclude_none=True, exclude={"limits"}) | {"record": inner})
    with CoupledAsset(three, binding, isolated=False) as asset:
        history = asset.simulate({"load_factor": [2.0, 3.0, 2.0, 3.0]})
        with asset.fork() as other:
            there = [other.step({"load_factor": 2.0}).values.tobytes() for _ in range(2)]
        assert [asset.step({"load_factor": 2.0}).values.tobytes() for _ in range(2)] == there
        asset.reset()
        seen = [asset.step({"load_factor": 2.0 + index % 2}) for index in range(4)]
    assert history.values.tobytes() == np.array([item.values for item in seen]).tobytes()
    for name in ("z1", "wing.tip_displacement", "damage.z2"):
        assert history.extra[name].tolist() == [item.extra[name] for item in seen]


def test_a_state_of_something_else_is_refused(three: SystemStructure, readings: Binding) -> None:
    with CoupledAsset(three, readings, isolated=False) as asset:
        asset.step({"load_factor": 2.0})
        state = asset.save_state()
        for damaged in (b"", state[:-1], b"x" + state[1:], state[:40]):
            with pytest.raises(FmuStateError, match=r"not a state of .*, or it is damaged"):
                asset.restore_state(damaged)
    delayed = tuple(replace(c, delayed=bool(c.source.component)) for c in three.connections)
    with (
        CoupledAsset(replace(three, connections=delayed), readings, isolated=False) as other,
        pytest.raises(FmuStateError, match="another FMU than the system test"),
    ):
        other.restore_state(state)
    with pytest.raises(FmuStateError, match="no state to save"):
        CoupledAsset(three, readings, isolated=False).save_state()


def test_a_refused_value_names_its_component(three: SystemStructure, readings: Binding) -> None:
    with CoupledAsset(three, readings, isolated=False) as asset:
        with pytest.raises(FmuInputError, match=r"component (damage|wing): load.load_factor = 99"):
            asset.step({"load_factor": 99.0})
        with pytest.raises(FmuStateError, match="no longer stand at the same time"):
            asset.step({"load_factor": 2.0})
        asset.reset()
        asset.step({"load_factor": 2.0})


def test_what_an_fmu_does_wrong_names_its_component(spring_mass: Path, linear_fmu: Path) -> None:
    law = linear("law", linear_fmu, d=np.eye(2))
    joined = system([Component("spring", spring_mass), law], [("spring.position", "law.u1")])
    binding = parse_binding(
        {
            "binding": {"name": "watch", "step_size": 0.1},
            "load": {"misbehaviour": {"variable": "spring.misbehaviour", "unit": "1"}},
            "observation": {"y": {"variables": ["law.y1"], "unit": "1"}},
        }
    )
    for behaviour, kind, words in (
        (NAN, FmuOutputError, "component spring: .*not finite.*position"),
        (DIE, FmuWorkerError, "component spring: .*ended by signal"),
    ):
        with CoupledAsset(joined, binding) as asset:
            asset.step()
            with pytest.raises(kind, match=words):
                asset.step(load={"misbehaviour": behaviour})


def test_the_face_is_that_of_one_fmu(linear_fmu: Path) -> None:
    one = system([linear("one", linear_fmu, d=[[2.0, 0.0], [0.0, 1.0]])], [("push", "one.u1")])
    asset = CoupledAsset(one, watch("one.y1", inputs=["push"], step_size=0.1), isolated=False)
    assert asset.step({"push": 3.0}).values.tolist() == [6.0]  # opened by its first use
    assert asset.step().values.tolist() == [6.0]  # an input keeps its value
    assert asset.time == 0.2
    assert asset.describe()["order"] == ["one"]
    asset.close()
    with pytest.raises(FmuStateError, match="is closed; reset it"):
        asset.step()
    asset.reset(control={"push": 1.0})
    assert asset.observe().values.tolist() == [2.0]
    asset.close()
