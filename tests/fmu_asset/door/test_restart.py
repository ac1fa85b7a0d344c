"""A start is a start: a reset that does nothing is not believed, and the FMU's tolerance reaches it."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fmu_asset.check import check_fmu
from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import Component, SystemStructure
from fmu_asset.door.session import FmiAsset
from twin_master.library.grid import GridSampler, SamplingGrid

from .conftest import bound

BOTH = pytest.mark.parametrize("isolated", [True, False], ids=["worker", "in process"])
SPRING = bound(0.1, {"motion": (["position", "velocity"], ["m", "m/s"])}, control={"push": ("force", "N")})
HOSTILE = bound(1.0, {"y": ("y", "m")}, control={"u": ("u", "m/s")})
BINDING = """
[binding]
name = "spring"
step_size = 0.1
[control.push]
variable = "force"
unit = "N"
[health.spring]
variable = "stiffness"
unit = "N/m"
[observation.motion]
variables = ["position"]
unit = "m"
"""


def motion(pushes: list[float]) -> list[float]:
    """Return position and velocity of the mass after steps of 0.1 s under forces."""
    position, velocity = 1.0, 0.0
    for push in pushes:
        for _ in range(100):
            velocity += (push - 4.0 * position) * 0.001
            position += velocity * 0.001
    return [position, velocity]


@BOTH
@pytest.mark.parametrize("what", [(), ("RESET_DOES_NOTHING",)], ids=["sound", "does nothing"])
def test_every_start_is_the_same(
    foreign_fmu: Any, isolated: bool, what: tuple[str, ...], caplog: pytest.LogCaptureFixture
) -> None:
    # A file of its own for each case: what is wrong with a file is said once in a process.
    fmu = foreign_fmu("spring2", *what, f"CASE={int(isolated)}")
    with caplog.at_level(logging.WARNING), FmiAsset(fmu, SPRING, isolated=isolated) as asset:
        process = asset.worker_process_id
        for push in (1.0, -2.0, 3.0):
            asset.reset()
            asset.step({"push": push})
            np.testing.assert_allclose(asset.step().values, motion([push, push]), rtol=1e-12)
        with asset.sibling() as other:
            other.step({"push": 5.0})
            other.reset()
            np.testing.assert_allclose(other.step({"push": 1.0}).values, motion([1.0]), rtol=1e-12)
        assert asset.worker_process_id == process
        assert asset.reset_trial.works is (not what)
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == len(what)
    assert all(
        f"{fmu}: Its reset returns OK and does not bring it back to its start" in text for text in said
    )


def test_a_start_at_rest_shows_nothing_and_is_right_all_the_same(foreign_fmu: Any) -> None:
    """The first flight stays where it began; the second one moves, and what follows it starts anew."""
    lag = bound(1.0, {"y": ("Out1", "1")}, control={"u": ("In1 (rad/s)", "1")})
    with FmiAsset(foreign_fmu("lag1"), lag) as asset:
        for u in (0.0, 0.0, 1.0):
            asset.reset()
            seen = asset.step({"u": u}).values[0]
        asset.reset()
        assert asset.reset_trial.works is True
        assert asset.step({"u": 1.0}).values[0] == seen != 0.0


CLOCKS = [("INSTANCE_CLOCK", True), ("INSTANCE_CLOCK", False), ("process_clock", True)]


@pytest.mark.parametrize(("clock", "isolated"), CLOCKS, ids=["instance", "in process", "process"])
@pytest.mark.parametrize("in_one_go", [False, True], ids=["steps", "run"])
@pytest.mark.parametrize("lengths", [(3, 7, 7), (1, 1, 1, 1, 1, 1, 1), (4, 1, 7, 1), (2, 3, 1, 6)], ids=str)
def test_a_hidden_clock_shows_at_no_start(
    foreign_fmu: Any,
    clock: str,
    isolated: bool,
    in_one_go: bool,
    lengths: tuple[int, ...],
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The clock adds 1 from its sixth step on: where the first reset is looked at, nothing is to be seen."""
    case = f"CASE={sum(lengths)}{len(lengths)}{isolated}{in_one_go}"  # what is wrong is said once for a file
    fmu = foreign_fmu("hostile2", f"CLOCK={clock}", "STAYS_LOADED", case)

    def flown(asset: FmiAsset, push: float, steps: int) -> list[float]:
        asset.reset()
        if in_one_go:
            return asset.simulate({"u": push}, steps=steps).values[:, 0].tolist()
        return [asset.step({"u": push}).values[0] for _ in range(steps)]

    with caplog.at_level(logging.WARNING), FmiAsset(fmu, HOSTILE, isolated=isolated) as asset:
        assert [flown(asset, 0.1, length)[0] for length in lengths] == [0.1] * len(lengths)
        # A start whose first step is another one has those that are known for its proof.
        flown(asset, 0.3, 7)
        seen = flown(asset, 0.3, 7)
        np.testing.assert_allclose(seen, [0.3, 0.6, 0.9, 1.2, 1.5, 2.8, 4.1], rtol=1e-12)
        assert asset.reset_trial.works is False
    assert "Flights that began by a reset before may be wrong" in caplog.messages[0]
    assert len(caplog.messages) == (2 if clock == "process_clock" else 1)


def test_what_never_starts_alike_is_not_started_in_ever_new_processes(foreign_fmu: Any) -> None:
    fmu = foreign_fmu("hostile2", "NOT_DETERMINISTIC", "STAYS_LOADED", "CLOCK=process_clock")
    with FmiAsset(fmu, HOSTILE) as asset:
        for _ in range(8):
            asset.reset()
            asset.step()
        process = asset.worker_process_id
        for _ in range(3):
            asset.reset()
            asset.step()
        assert asset.worker_process_id == process


def test_a_library_is_sampled_from_fresh_starts(foreign_fmu: Any, tmp_path: Path) -> None:
    """Every point is the equilibrium; without a new start the mass would stay where it was."""
    binding = tmp_path / "spring.toml"
    binding.write_text(BINDING)
    fmu = foreign_fmu("spring2", "RESET_DOES_NOTHING", "STANDS_STILL_ONCE_TERMINATED", "FRICTION=4.0")
    grid = SamplingGrid(
        fmu=str(fmu), binding=str(binding), role="motion", parameter="", draws=(0.0,), settling_steps=200,
        states={"spring": (4.0, 5.0, 8.0)}, controls={"weak": {"push": 2.0}, "strong": {"push": 4.0}},
    )  # fmt: skip
    sampler = GridSampler(grid)
    try:
        found = sampler.block(0, 6)[:, 0]
    finally:
        sampler.close()
    np.testing.assert_allclose(found, [0.5, 1.0, 0.4, 0.8, 0.25, 0.5], rtol=1e-9)


def test_components_of_a_coupled_asset_start_anew(foreign_fmu: Any) -> None:
    fmu = foreign_fmu("spring2", "RESET_DOES_NOTHING")
    structure = SystemStructure(name="one", components=(Component("spring", fmu),))
    described = bound(0.1, {"x": ("spring.position", "m")}, control={"push": ("spring.force", "N")})
    with CoupledAsset(structure, described) as asset:
        for push in (1.0, 2.0):
            asset.reset()
            asset.step({"push": push})
            seen = asset.step({"push": push}).values[0]
            assert seen == pytest.approx(motion([push, push])[0], rel=1e-12)


def test_the_check_names_it(foreign_fmu: Any) -> None:
    (problem,) = check_fmu(foreign_fmu("spring2", "RESET_DOES_NOTHING"), step_size=0.1).problems
    assert problem.startswith("Its reset returns OK and does not bring it back to its start")
    assert check_fmu(foreign_fmu("hostile2", "NEGATIVE_ZERO_AFTER_RESET")).passed


@BOTH
def test_the_tolerance_is_that_of_the_fmu_unless_the_binding_says_otherwise(
    foreign_fmu: Any, isolated: bool
) -> None:
    for header, expected in (({}, 1e-4), ({"tolerance": 1e-7}, 1e-7)):
        chosen = bound(0.1, {"tolerance": ("tolerance", "1")}, header=header)
        with FmiAsset(foreign_fmu("spring2"), chosen, isolated=isolated) as asset:
            assert asset.observe().values[0] == expected
