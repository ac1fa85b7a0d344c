"""A start is a start: a reset that does nothing is not believed; many instances share one extracted FMU."""

import logging
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from fmu_asset.archive.declared import FmuDescription
from fmu_asset.check import check_fmu
from fmu_asset.coupling.asset import CoupledAsset
from fmu_asset.coupling.structure import Component
from fmu_asset.door import placement
from fmu_asset.door.session import FmiAsset
from fmu_asset.errors import FmuStateError
from tests.fmu_asset.door.kinds import BINDINGS_FOLDER, HOSTILE
from tests.fmu_asset.making import bound, system
from twin_master.library.grid import GridSampler, SamplingGrid

PUSH = {"push": ("force", "N")}
SPRING = bound(0.1, {"motion": (["position", "velocity"], ["m", "m/s"])}, control=PUSH)


def motion(pushes: list[float]) -> list[float]:
    """Return position and velocity of the mass after steps of 0.1 s under forces."""
    position, velocity = 1.0, 0.0
    for push in pushes:
        for _ in range(100):
            velocity += (push - 4.0 * position) * 0.001
            position += velocity * 0.001
    return [position, velocity]


@pytest.mark.parametrize("what", [(), ("RESET_DOES_NOTHING",)], ids=["sound", "does nothing"])
def test_every_start_is_the_same(foreign_fmu, isolated, what, caplog) -> None:
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
    assert len(caplog.messages) == len(what)
    sentence = f"{fmu}: Its reset returns OK and does not bring it back to its start"
    assert all(sentence in text for text in caplog.messages)


def test_a_start_at_rest_shows_nothing_and_is_right_all_the_same(foreign_fmu) -> None:
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
def test_a_hidden_clock_shows_at_no_start(foreign_fmu, clock, isolated, in_one_go, lengths, caplog) -> None:
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


def test_what_never_starts_alike_is_not_started_in_ever_new_processes(foreign_fmu) -> None:
    fmu = foreign_fmu("hostile2", "NOT_DETERMINISTIC", "STAYS_LOADED", "CLOCK=process_clock")
    with FmiAsset(fmu, HOSTILE) as asset:
        seen = []
        for _ in range(11):
            asset.reset()
            asset.step()
            seen.append(asset.worker_process_id)
        assert len(set(seen[7:])) == 1


def test_a_library_is_sampled_from_fresh_starts(foreign_fmu) -> None:
    """Every point is the equilibrium; without a new start the mass would stay where it was."""
    binding = BINDINGS_FOLDER / "spring2.toml"
    fmu = foreign_fmu("spring2", "RESET_DOES_NOTHING", "STANDS_STILL_ONCE_TERMINATED", "FRICTION=4.0")
    grid = SamplingGrid(
        fmu=str(fmu), binding=str(binding), role="motion", parameter="", draws=(0.0,), settling_steps=200,
        states={"spring": (4.0, 5.0, 8.0)}, controls={"weak": {"push": 2.0}, "strong": {"push": 4.0}},
    )  # fmt: skip
    with closing(GridSampler(grid)) as sampler:
        found = sampler.block(0, 6)[:, 0]
    np.testing.assert_allclose(found, [0.5, 1.0, 0.4, 0.8, 0.25, 0.5], rtol=1e-9)


def test_a_check_names_it_and_components_of_a_system_start_anew(foreign_fmu) -> None:
    fmu = foreign_fmu("spring2", "RESET_DOES_NOTHING")
    described = bound(0.1, {"x": ("spring.position", "m")}, control={"push": ("spring.force", "N")})
    with CoupledAsset(system([Component("spring", fmu)], []), described) as asset:
        for push in (1.0, 2.0):
            asset.reset()
            asset.step({"push": push})
            seen = asset.step({"push": push}).values[0]
            assert seen == pytest.approx(motion([push, push])[0], rel=1e-12)
    (problem,) = check_fmu(fmu, step_size=0.1).problems
    assert problem.startswith("Its reset returns OK and does not bring it back to its start")
    assert check_fmu(foreign_fmu("hostile2", "NEGATIVE_ZERO_AFTER_RESET")).passed


def test_the_tolerance_is_that_of_the_fmu_unless_the_binding_says_otherwise(foreign_fmu, isolated) -> None:
    for header, expected in (({}, 1e-4), ({"tolerance": 1e-7}, 1e-7)):
        chosen = bound(0.1, {"tolerance": ("tolerance", "1")}, header=header)
        with FmiAsset(foreign_fmu("spring2"), chosen, isolated=isolated) as asset:
            assert asset.observe().values[0] == expected


# ---------------------------------------------------------------------- many instances of one FMU


@pytest.fixture
def extractions(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Return the folders into which FMUs are extracted during the test."""
    made: list[Path] = []
    extract = placement.extract_fmu

    def counting(description: FmuDescription) -> Path:
        made.append(extract(description))
        return made[-1]

    monkeypatch.setattr(placement, "extract_fmu", counting)
    return made


def test_copies_share_the_extracted_fmu_until_the_last_is_closed(foreign_fmu, extractions, isolated) -> None:
    with pytest.raises(FmuStateError, match="no state to save"):
        FmiAsset(foreign_fmu("hostile2"), HOSTILE).fork()
    with FmiAsset(foreign_fmu("hostile2"), HOSTILE, isolated=isolated) as asset:
        asset.step({"u": 2.0})
        forks = [asset.fork() for _ in range(3)]
        for number, fork in enumerate(forks):
            assert (fork.time, fork.step_index) == (1.0, 1)
            assert fork.step({"u": float(number)}).values[0] == 2.0 + number
        forks[0].close()
        process = asset.worker_process_id
        for _ in range(20):
            asset.renew()
            assert asset.step({"u": 3.0}).values[0] == 3.0
        assert asset.worker_process_id == process
    assert not isolated or not (Path("/proc") / str(process)).exists()  # gone at once
    assert len(extractions) == 1
    assert extractions[0].is_dir()
    assert [fork.step().values[0] for fork in forks[1:]] == [4.0, 6.0]
    for fork in forks:
        fork.close()
    assert not extractions[0].exists()


def test_siblings_have_parameters_of_their_own(foreign_fmu, extractions) -> None:
    roles = {"control": {"u": ("In1 (rad/s)", "1")}, "parameter": {"gain": ("Lag/Gain [K]", "1")}}
    binding = bound(0.5, {"y": ("Out1", "1")}, **roles)
    with FmiAsset(foreign_fmu("lag1"), binding, parameters={"gain": 1.0}) as first:
        others = [first.sibling({"gain": float(gain)}) for gain in (2, 3)]
        values = [asset.step({"u": 1.0}).values[0] for asset in (first, *others)]
        np.testing.assert_allclose(values, (1.0 - np.exp(-1.0)) * np.array([1.0, 2.0, 3.0]), rtol=1e-12)
        for other in others:
            other.close()
    assert len(extractions) == 1


def test_after_a_crash_the_files_are_extracted_again(foreign_fmu, extractions) -> None:
    with FmiAsset(foreign_fmu("hostile2", "ABORT"), HOSTILE) as asset, asset.fork() as fork:
        asset.step(), asset.step()
        saved = asset.save_state()
        with pytest.raises(Exception, match="SIGABRT"):
            asset.step()
        asset.restore_state(saved)
        assert len(extractions) == 2
        assert fork.step().values[0] == 1.0
