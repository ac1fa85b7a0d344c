"""The mission loop, its truth and journal: timing, faults, resuming, an FMU that hangs; in gymnasium."""

import importlib
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import xarray as xr
from gymnasium.utils.env_checker import check_env

from fmu_asset.errors import FmuTimeoutError
from tests.command_line import said
from tests.fmu_asset.making import limit_call_without_answer
from tests.kept import ROOT
from tests.refusals import Inputs
from tests.twin_master.runs import (
    changed_scenario,
    check_same,
    flight_of,
    journal,
    of_library,
    text_of,
    written,
)
from twin_master.assets.asset_source import AssetReading, StatelessAsset
from twin_master.assets.resolution import asset_source
from twin_master.assets.strain_library_source import StrainLibrarySource
from twin_master.errors import MissionInputError, NotResumableError
from twin_master.fleet.page.report import write_fleet_report
from twin_master.fleet.plan import ensemble
from twin_master.fleet.storage.store import ENDED
from twin_master.mission import replay
from twin_master.mission.flights import fly
from twin_master.mission.journal import JOURNAL_NAME, JournalFile, encode_line
from twin_master.mission.journal_packing import pack_numbers
from twin_master.mission.plant import Plant, SensorStatus, Truth
from twin_master.mission.preparation import Knowledge
from twin_master.mission.replay import journal_sink, restore_flight
from twin_master.mission.steps import History, MissionStep
from twin_master.network.graphical_model import build_graphical_model
from twin_master.scenario.reading import load_scenario
from twin_master.scenario.schema import Scenario
from twin_master.scenario.tables import SensorFault
from twin_master.seeds import PURPOSES, generator
from uav_twin import ScenarioEnvironment, fly_fleet, open_fleet, open_run, resume
from uav_twin import fly as new_run

pytestmark = pytest.mark.usefixtures("no_report")
Known = tuple[Knowledge, StrainLibrarySource]
ARRAYS = (
    "observed", "control_index", "filtered", "log_evidence", "smoothed", "predicted", "decision_probability",
    "state",
)  # fmt: skip


@pytest.fixture(scope="module")
def paper(library_file: Path) -> Known:
    return of_library("paper_level_turns", library_file, 1)


def part(known: Known, folder: Path, config_hash: str = "abc", kind: type[Plant] = Plant) -> History:
    """Fly a mission, or the rest of one."""
    knowledge, source = known
    plant = kind(knowledge.scenario, knowledge.truth(3), source.open())
    with JournalFile(folder, config_hash) as file:
        before = restore_flight(file, knowledge, plant)
        return fly(knowledge.scenario, before.twin, plant, journal_sink(file, plant), history=before)


STUCK_GAUGE = SensorFault(kind="stuck", sensors=(5,), first_step=14, last_step=30)
RESUMED = ["level_turns", "growing_damage", "failing_gauges", "level_turns_learning", "stuck gauge"]


def known_of(name: str, library: Path) -> Known:
    """Return what is known of a shipped scenario, or of level turns with a stuck gauge."""
    if name != "stuck gauge":
        return of_library(name, library)
    truth = load_scenario("level_turns").scenario.truth
    return of_library(
        "level_turns", library, truth=truth.model_copy(update={"sensor_faults": (STUCK_GAUGE,)})
    )


class WholeFlight:
    """A mission that was flown in one go, with its journal."""

    def __init__(self, name: str, library: Path, folder: Path) -> None:
        self.known = known_of(name, library)
        self.flight = part(self.known, folder)
        self.journal = (folder / JOURNAL_NAME).read_bytes()
        self.folder = folder

    def resume_after(self, steps: int) -> History:
        """Return the mission of which a kill left so many steps."""
        lines = self.journal.splitlines(keepends=True)[: steps + 1]
        (self.folder / JOURNAL_NAME).write_bytes(b"".join(lines))
        return part(self.known, self.folder)


@pytest.fixture(scope="module", params=RESUMED)
def whole_flight(
    request: pytest.FixtureRequest, library_file: Path, tmp_path_factory: pytest.TempPathFactory
) -> WholeFlight:
    return WholeFlight(request.param, library_file, tmp_path_factory.mktemp(request.param))


@pytest.mark.parametrize("steps", [17, 50])
def test_resuming_after_any_step_is_bit_identical(whole_flight, steps):
    resumed = whole_flight.resume_after(steps)
    assert (whole_flight.folder / JOURNAL_NAME).read_bytes() == whole_flight.journal
    assert resumed.notices == whole_flight.flight.notices
    for array in ARRAYS:
        np.testing.assert_array_equal(getattr(resumed, array), getattr(whole_flight.flight, array))


@pytest.mark.parametrize("steps", [17, 50])
def test_a_resumed_mission_flies_the_remaining_steps_alone(whole_flight, steps):
    resumed = whole_flight.resume_after(steps)
    is_flown = (resumed.seconds > 0.0).any(axis=1)
    assert resumed.resumed_at == steps
    assert np.all(is_flown == (np.arange(50) >= steps))


def test_the_journal_has_each_step(whole_flight):
    whole_flight.resume_after(50)
    assert len(journal(whole_flight.folder)) == 50


@pytest.mark.parametrize("whole_flight", ["failing_gauges"], indirect=True)
def test_failing_gauges_are_noticed(whole_flight):
    assert whole_flight.flight.notices


@pytest.mark.parametrize("whole_flight", ["failing_gauges"], indirect=True)
def test_notices_are_records_of_the_log_as_they_are_given(whole_flight, tmp_path, caplog):
    with caplog.at_level("INFO", logger="uav_twin"):
        flight = part(whole_flight.known, tmp_path)
    messages = [record.message for record in caplog.records if "twin_master.mission" in record.name]
    assert messages
    assert messages == [notice.sentence for _, notice in flight.notices]


WITHOUT = "import sys; sys.modules['numba'] = None; from uav_twin import cli; cli.main()"


def test_a_mission_without_numba_is_the_same(library_file, tmp_path):
    """The same loops as plain Python, and one sentence about it."""
    short = written(tmp_path, text_of("level_turns", ("steps = 50", "steps = 4")))
    words = "run", str(short), "--strain-library", str(library_file), "--no-report", "--out"
    said(*words, tmp_path / "fast")
    line = [sys.executable, "-c", WITHOUT, *words, str(tmp_path / "plain")]
    plain = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=False)
    assert plain.returncode == 0, plain.stderr
    assert plain.stderr.count("pip install 'uav-twin[fast]'") == 1
    found, expected = (open_run(tmp_path / name) for name in ("plain", "fast"))
    for group in ("observed", "filtered", "smoothed", "predicted"):
        xr.testing.assert_allclose(found[group].to_dataset(), expected[group].to_dataset(), rtol=1e-9)


def test_timing_of_a_step(paper):
    """Control u_t is in force while d_t, the gain of step t included, is observed; noise alone is added."""
    knowledge, source = paper
    asked: list[tuple[float, float, float]] = []
    inner = source.open()

    def observe(control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        asked.append((control["load_factor"], health["z1"], health["z2"]))
        return inner.step(control, health)

    flight = flight_of(*paper, seed=1, asset=StatelessAsset(observe))
    # Written out from the paper: z1 gains 2 at 10..19 and 20 at 20 and 30, z2 2 at 5..14 and 20 at 5 and 25.
    z1 = [0] * 10 + list(range(2, 21, 2)) + [40] * 10 + [60] * 20
    z2 = [0] * 5 + list(range(22, 41, 2)) + [40] * 10 + [60] * 25
    loads = [(2.0, 3.0)[index] for index in flight.control_index]
    np.testing.assert_array_equal(asked, np.array([loads, np.array(z1) / 100.0, np.array(z2) / 100.0]).T)
    assert loads[0] == 3.0
    for step in range(49):  # u_{t+1} is the mode of the policy at the state as observed at t
        assert flight.control_index[step + 1] == np.argmax(flight.filtered[step] @ knowledge.plan.policy)
    residual = flight.observed - flight.observation
    np.testing.assert_allclose(residual, knowledge.truth(1).noise, atol=1e-12)


def test_an_asset_that_returns_nan_or_the_wrong_number_stops_the_mission(paper):
    inner, kept = paper[1].open(), list[MissionStep]()

    def broken(control: Mapping[str, float], health: Mapping[str, float]) -> AssetReading:
        values = inner.step(control, health).values
        values[7] = np.nan if len(kept) == 3 else values[7]
        return AssetReading(values)

    def short(_control: object, _health: object) -> AssetReading:
        return AssetReading(np.zeros(3))

    with pytest.raises(MissionInputError, match=r"step 3: .*NaN.*`strain` 8 under the control `3g`"):
        flight_of(*paper, kept.append, asset=StatelessAsset(broken))
    with pytest.raises(MissionInputError, match="expects 24 values"):
        flight_of(*paper, asset=StatelessAsset(short))


def test_the_policy_on_the_published_library(published_library):
    knowledge, _ = of_library("paper_level_turns", published_library, 0)
    z1 = knowledge.model.states.coordinates[:, 0]
    np.testing.assert_array_equal(knowledge.plan.control_index, np.where(z1 < 0.59, 1, 0))
    margin = (knowledge.plan.action_value[:, 1] - knowledge.plan.action_value[:, 0]).reshape(5, 5)
    np.testing.assert_allclose(margin[2:4], np.repeat([[0.007], [-0.059]], 5, axis=1), atol=5e-4)


def truth_of(scenario: Scenario | str, seed: int = 1) -> Truth:
    found = load_scenario(scenario).scenario if isinstance(scenario, str) else scenario
    return Truth(found, build_graphical_model(found), seed)


def test_the_same_seed_meets_the_same_noise_whatever_else_is_drawn():
    noise = truth_of("level_turns", 7).noise
    np.testing.assert_array_equal(noise, truth_of("growing_damage", 7).noise)
    assert not np.array_equal(noise, truth_of("level_turns", 8).noise)
    assert noise.std() == pytest.approx(150e-6, rel=0.05)
    assert len({generator(3, purpose).random() for purpose in PURPOSES}) == len(PURPOSES)


@pytest.mark.parametrize(
    ("part", "status"),
    [
        (np.s_[36:38], SensorStatus.LOST),
        (np.s_[12:19, 16:20], SensorStatus.LOST),
        (np.s_[28:, 0], SensorStatus.LOST),
        (np.s_[:12, 16], SensorStatus.HEALTHY),
        (np.s_[8, 11], SensorStatus.DRIFTING),
        (np.s_[36, 11], SensorStatus.LOST),
    ],
)
def test_gauges_have_the_faults_of_the_scenario(part, status):
    assert np.all(truth_of("failing_gauges").status[part] == status)


def test_a_gauge_drifts_at_its_rate():
    drift = truth_of("failing_gauges").drift
    np.testing.assert_allclose(drift[:10, 11], [0] * 8 + [6e-6, 12e-6])


def test_faults_of_gauges_are_sensed_and_leave_the_quantity():
    without_noise = {"truth": {"noise": {"standard_deviation_microstrain": 0}}}
    truth = truth_of(changed_scenario("failing_gauges", without_noise).scenario)
    quantity = np.full(24, 1e-3)
    sensed = truth.sense(13, quantity, None)
    assert np.isnan(sensed[16:20]).all()
    assert sensed[11] == pytest.approx(1e-3 + 36e-6)
    assert np.isnan(truth.sense(36, quantity, sensed)).all()
    np.testing.assert_array_equal(quantity, 1e-3)


def test_a_stuck_gauge_shows_the_reading_before_until_it_moves(library_file):
    knowledge, source = known_of("stuck gauge", library_file)
    flight = fly(knowledge.scenario, knowledge.twin(), knowledge.plant(knowledge.truth(3), source.open()))

    stands_still = np.diff(flight.observed, axis=0) == 0.0

    assert [np.flatnonzero(of_gauge).tolist() for of_gauge in stands_still.T] == [
        [*range(13, 30)] if gauge == 4 else [] for gauge in range(24)
    ]


class Heavy(Plant):
    """A plant whose asset has a state of a hundred bytes: 144 characters in the file."""

    def save_state(self) -> bytes:
        return np.random.default_rng(self.step).bytes(100)

    def restore(self, flown: History, asset_state: bytes) -> None:
        super().restore(flown, b"")
        assert asset_state == self.save_state()


@pytest.fixture(scope="module", params=[4])
def known(request: pytest.FixtureRequest, library_file: Path) -> Known:
    """Of a mission of four steps, or of another number."""
    mission = load_scenario("level_turns").scenario.mission.model_copy(update={"steps": request.param})
    return of_library("level_turns", library_file, mission=mission)


def test_a_journal_that_was_cut_off_is_gone_on_with_and_a_changed_or_foreign_one_refused(known, tmp_path):
    """Also one that decided otherwise in any step."""
    part(known, tmp_path)
    path = tmp_path / JOURNAL_NAME
    whole = path.read_bytes()
    ends = [number + 1 for number, byte in enumerate(whole) if byte == ord("\n")]
    for cut in (0, 1, ends[0] - 1, ends[1] - 1, ends[3] + 1):  # a kill leaves it so: flown again
        path.write_bytes(whole[:cut])
        assert part(known, tmp_path).resumed_at == sum(end <= cut for end in ends[1:])
        assert path.read_bytes() == whole
    with pytest.raises(NotResumableError, match="another configuration"):
        part(known, tmp_path, "other")
    lines = whole.splitlines(keepends=True)
    strain = pack_numbers(journal(tmp_path)[0]["observed"]).encode()
    for damaged, line in (
        (whole.replace(strain, pack_numbers([0.25]).encode()), 2),
        (lines[0] + lines[2] + lines[1], 2),
        (lines[0] + lines[1] + lines[3], 3),
        (lines[0] + lines[2] + lines[3], 2),
        (whole[:-2] + b"\n", 5),
        (lines[0] + lines[1].replace(b"monitors", b"monit\rrs") + lines[2], 2),
        (b"no checkpoint\n" + whole, 1),
        (b"no checkpoint", 1),
        (b"PK\x03\x04\xff", 1),
    ):
        path.write_bytes(damaged)
        with pytest.raises(NotResumableError, match=rf"line {line} of .*changed or is damaged.*--replace"):
            part(known, tmp_path)
    path.write_bytes(whole)
    for step, record in enumerate(journal(tmp_path)):
        other = encode_line(record | {"next_control": 1 - record["next_control"]})
        path.write_bytes(b"".join([*lines[: step + 1], other, *lines[step + 2 :]]))
        with pytest.raises(NotResumableError, match=f"has another decision after step {step} .*--replace"):
            part(known, tmp_path)


@pytest.mark.parametrize("known", [12], indirect=True)
def test_large_states_are_kept_less_often_and_their_steps_flown_again(known, tmp_path, monkeypatch):
    monkeypatch.setattr(replay, "STATE_ALLOWANCE", 5000)
    monkeypatch.setattr(replay, "STATE_BYTES_PER_STEP", 50)
    part(known, tmp_path, kind=Heavy)
    journal_before = (tmp_path / JOURNAL_NAME).read_bytes()
    has_state = ["asset_state" in record for record in journal(tmp_path)]
    last_state = max(step for step, is_kept in enumerate(has_state) if is_kept)
    resumed = part(known, tmp_path, kind=Heavy)
    assert (has_state[-6:].count(False), last_state < 11) == (4, True)
    assert resumed.resumed_at == last_state + 1
    assert (tmp_path / JOURNAL_NAME).read_bytes() == journal_before


# ---------------------------------------------------------------- an FMU that hangs or ends

INPUTS = Inputs(__file__)
BINDING = INPUTS.text("hostile_binding.toml")


def hostile(folder: Path, fmu: Path, *changes: tuple[str, str], binding: str = BINDING) -> Any:
    written(folder, binding, name="binding.toml")
    text = INPUTS.text("hostile.toml")
    return load_scenario(written(folder, text, ("FMU", str(fmu)), *changes, name="scenario.toml"))


def test_a_run_is_resumed_once_the_cause_is_gone(foreign_fmu, tmp_path, monkeypatch):
    fmu, flag = foreign_fmu("hostile2", "HANG", "STATELESS", "AFTER=20"), tmp_path / "flag"
    monkeypatch.setenv("HOSTILE_FLAG", str(flag))
    loaded = hostile(tmp_path, fmu)
    whole = new_run(loaded, tmp_path / "whole").folder
    flag.touch()
    sentence = r"step 20 from t = 20 s: .*longer than 2 s for the step"
    with monkeypatch.context() as patch:
        limit_call_without_answer(patch, "step", 21)
        with pytest.raises(FmuTimeoutError, match=sentence):
            new_run(loaded, tmp_path / "part")
    with monkeypatch.context() as patch:
        limit_call_without_answer(patch, "step", since="restore")
        with pytest.raises(FmuTimeoutError, match=sentence):
            resume(tmp_path / "part")
    flag.unlink()
    resume(tmp_path / "part")
    check_same(tmp_path / "part", whole, "run.nc", "config.json", "summary.json", "csv/observed.csv")


class EndedMission:
    """A mission whose FMU ends its simulation after 20 of 30 steps, and one whose FMU does not."""

    def __init__(self, fmu: Path, folder: Path) -> None:
        self.flag = folder / "flag"
        self.scenario_file = folder / "scenario.toml"
        self.loaded = hostile(folder, fmu)
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("HOSTILE_FLAG", str(self.flag))
            self.whole = new_run(self.loaded, folder / "whole")
            self.flag.touch()
            self.part = new_run(self.loaded, folder / "part")


@pytest.fixture(scope="module")
def ended_mission(foreign_fmu, no_report, tmp_path_factory) -> EndedMission:
    fmu = foreign_fmu("hostile2", "ENDS", "STATELESS", "AFTER=20")
    return EndedMission(fmu, tmp_path_factory.mktemp("ended"))


@pytest.fixture
def is_ending(ended_mission: EndedMission, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the FMU end its simulation."""
    monkeypatch.setenv("HOSTILE_FLAG", str(ended_mission.flag))


def test_a_mission_says_that_its_fmu_ended_the_simulation(ended_mission):
    (sentence,) = ended_mission.part.notices
    assert ended_mission.whole.notices == ()
    assert sentence.startswith("The asset ended the mission after 20 of 30 steps: ")
    assert "The FMU asked to end the simulation in the step from t = 20 s" in sentence


def test_an_fmu_that_ends_its_simulation_ends_the_mission_with_what_was_flown(ended_mission):
    names = ("observed/y", "truth/y", "truth/state", "truth/sensor_status", "filtered/belief")
    whole_store, part_store = ended_mission.whole.folder / "run.nc", ended_mission.part.folder / "run.nc"
    with xr.open_datatree(whole_store) as whole, xr.open_datatree(part_store) as part:
        for name in names:
            if name in whole:
                np.testing.assert_array_equal(part[name].values, whole[name].values[:20])
        assert part["truth/sensor_status"].shape == (20, 1)


@pytest.mark.usefixtures("is_ending")
def test_a_mission_that_ended_is_resumed_to_the_same_end(ended_mission):
    assert resume(ended_mission.part.folder).notices == ended_mission.part.notices


@pytest.fixture(scope="module")
def ended_fleet(ended_mission: EndedMission, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A fleet of one asset, which ends its simulation as well."""
    fleet = ensemble(str(ended_mission.scenario_file), range(4, 5))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOSTILE_FLAG", str(ended_mission.flag))
        return fly_fleet(fleet, tmp_path_factory.mktemp("ended_fleet") / "fleet")


def test_an_asset_of_a_fleet_that_ends_is_no_failure(ended_mission, ended_fleet):
    (sentence,) = ended_mission.part.notices
    without_folder = sentence.replace(f"{ended_mission.part.folder}/", "")
    assert ended_fleet.failures == {}
    assert [*ended_fleet.ended.values()] == [without_folder]


def test_an_asset_of_a_fleet_that_ends_keeps_what_it_has_flown(ended_fleet):
    (group,) = open_fleet(ended_fleet.folder).values()
    assert group["status"].values.tolist() == [ENDED]
    assert (group["observed/control_index"].values >= 0).sum() == 20


def test_the_report_of_a_fleet_counts_assets_that_ended(ended_fleet):
    page = write_fleet_report(ended_fleet.folder).read_text()
    assert "1 of 1 assets ended their simulation" in page


@pytest.mark.usefixtures("is_ending")
def test_an_fmu_that_ends_its_simulation_terminates_an_episode(ended_mission):
    with ScenarioEnvironment(ended_mission.loaded) as environment:
        environment.reset(seed=4)
        steps = [environment.step(0) for _ in range(20)]
        assert [terminated for _, _, terminated, _, _ in steps] == [False] * 19 + [True]
        assert "asked to end" in steps[-1][4]["ended"]
        with pytest.raises(gymnasium.error.ResetNeeded):
            environment.step(0)


def test_an_fmi_3_asset_with_an_array_is_watched(foreign_fmu, tmp_path):
    """Its outputs grow with every step, so that only the way through twin, store and names is looked at."""
    fmu = foreign_fmu.changed("array3", "names", ('name="calls"', 'name="state/calls"'))
    changes = ("steps = 30", "steps = 3"), *[("standard_deviation = 0.1", "standard_deviation = 0.05")] * 2
    binding = INPUTS.text("array_binding.toml")
    two, three = (
        hostile(tmp_path, fmu, *changes, ("count = 1", f"count = {count}"), binding=binding)
        for count in (2, 3)
    )
    truth = open_run(new_run(two, tmp_path / "run").folder)["truth"]
    assert truth["state_calls"].values.tolist() == [1.0, 2.0, 3.0]
    assert (truth["y[1]"].attrs["units"], truth["y"].attrs["units"]) == ("mm", "m")
    np.testing.assert_allclose(truth["y"].values[:, 1], 1e-3 * truth["y[2]"].values, rtol=1e-6)
    with pytest.raises(Exception, match=r"observes 2 values of `y`, but the scenario expects 3"):
        new_run(three, tmp_path / "other")
    assert not (tmp_path / "other").exists()


@pytest.fixture(params=["level_turns", "growing_damage", "failing_gauges"])
def environment(request: pytest.FixtureRequest, library_file: Path) -> Iterator[ScenarioEnvironment]:
    made = ScenarioEnvironment(request.param, {"strain_library": library_file})
    yield made
    made.close()


@pytest.mark.filterwarnings("ignore:.*Box observation space:UserWarning", "ignore:.*render:UserWarning")
def test_it_passes_the_checker_of_gymnasium(environment):
    check_env(environment)


def test_our_policy_flies_the_mission_of_the_loop(environment):
    """To the last bit, with the seed of the mission; rewards by enumeration. Wrong use is refused."""
    scenario, knowledge = environment.scenario, environment.knowledge
    flight = flight_of(knowledge, asset_source(scenario))
    for seed in (4, 3):  # an episode leaves nothing to the next one
        twin, (observation, info) = knowledge.twin(), environment.reset(seed=seed)
        observed, controls, rewards, truncated = [info["observed"]], [info["control"]], [], False
        while not truncated:
            action = twin.step(info["observed"], info["control"]).next_control
            observation, reward, terminated, truncated, info = environment.step(action)
            assert not terminated
            np.testing.assert_array_equal(observation, np.nan_to_num(info["observed"]))
            observed.append(info["observed"])
            controls.append(info["control"])
            rewards.append(reward)
    np.testing.assert_array_equal(observed, flight.observed)
    np.testing.assert_array_equal(controls, flight.control_index)
    assert info["state"] == dict(zip(scenario.state_names, flight.state[-1], strict=True))
    section = scenario.rewards
    worst = (flight.observation / section.health_limit).max(axis=1)
    worth = np.array([section.control[scenario.control_names[u]] for u in controls])
    expected = section.health_weight * (1 - worst) + section.control_weight * worth
    np.testing.assert_allclose(rewards, expected[1:], rtol=1e-14)
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
        environment.step(0)
    environment.reset(seed=1)
    with pytest.raises(gymnasium.error.InvalidAction, match="controls 2g, 3g, but it is 2"):
        environment.step(2)
    environment.close()
    with pytest.raises(MissionInputError, match="is closed"):
        environment.reset()


def test_an_action_that_ends_the_mission_terminates_the_episode(tmp_path):
    land = '[[action]]\nname = "land"\ncontrol = "2g"\ncost = 0.0\nends = true\n\n[observation]'
    text = text_of("inspected_wing", ("[observation]", land), ('policy = "belief"', 'policy = "mode"'))
    environment = ScenarioEnvironment(written(tmp_path, text), {"in_process": True})
    environment.reset(seed=1)
    assert not any(environment.step(0)[2:4])
    _, reward, terminated, truncated, info = environment.step(5)
    assert (terminated, truncated, info["ended"]) == (True, False, "the twin decided on `land`.")
    assert reward != 0.0
    environment.close()


def test_chance_inside_the_asset_begins_with_the_seed_of_the_episode():
    loaded = changed_scenario("three_fmus", {"mission": {"steps": 3}, "calibration": {"draws": 5}})
    environment, other = (ScenarioEnvironment(loaded, {"in_process": True, "seed": seed}) for seed in (1, 5))
    first, second, again = (environment.reset(seed=seed)[0] for seed in (5, 6, 5))
    np.testing.assert_array_equal(again, first)
    np.testing.assert_array_equal(other.reset(seed=5)[0], first)
    assert not np.array_equal(first, second)
    environment.close()
    other.close()


def test_without_gymnasium_there_is_a_sentence(monkeypatch):
    monkeypatch.delitem(sys.modules, "twin_master.environment")
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(MissionInputError, match=r"needs gymnasium: pip install 'uav-twin\[gym\]'\.$"):
        importlib.import_module("twin_master.environment")
