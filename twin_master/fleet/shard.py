"""The flight of some twins of one group, by any process of any machine.

A shard contains all that its flight needs. However often it is flown, the result is the same to the
last bit.
"""

import pickle
import shutil
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import lru_cache
from pathlib import Path
from tempfile import mkdtemp
from typing import NamedTuple
from weakref import finalize

import numpy as np
from numpy.typing import NDArray

from reporting.files import write_members
from reporting.progress import SilentProgress
from twin_master.assets.asset_source import Asset, AssetSource, StatelessAsset
from twin_master.assets.fmu_source import FmuSource
from twin_master.assets.reduced_model import ReducedModelSource
from twin_master.errors import FleetError
from twin_master.feeds.feed import Feed
from twin_master.feeds.intake import Intake
from twin_master.feeds.message import FeedItem
from twin_master.fleet.checks import with_parameters
from twin_master.fleet.members import Member
from twin_master.fleet.storage.store import FAILED, stored_variables
from twin_master.mission.flights import Flights, fly_one_by_one, fly_side_by_side
from twin_master.mission.knowledge_file import load_knowledge
from twin_master.mission.parts import TwinParts
from twin_master.mission.plant import FLIGHT_ERRORS
from twin_master.mission.preparation import Knowledge
from twin_master.mission.replay import BelievedModel, refilter
from twin_master.mission.steps import History, Reading, log_notices, operate
from twin_master.network.estimator import Notice
from twin_master.scenario.schema import Scenario


def flights_of_recordings(
    knowledge: Knowledge, recordings: Sequence[Sequence[FeedItem]]
) -> Flights:
    """Let B twins follow recordings of real assets, each as `uav-twin watch` would do.

    If a recording cannot be processed, the reason is in `failure` of its twin.

    Parameters
    ----------
    recordings : sequence of sequence of FeedItem
        The messages of each of the B assets.
    """
    flights = Flights.empty(knowledge, len(recordings))
    most_steps = knowledge.scenario.mission.steps
    for number, messages in enumerate(recordings):
        try:
            history = _history_of_recording(knowledge, messages)
        except FLIGHT_ERRORS as error:
            flights.fail(number, str(error))
            continue
        step_count = len(history.steps)
        if step_count == 0:
            flights.fail(number, "its recording has no step yet.")
        elif step_count > most_steps:
            sentence = f"it has {step_count} steps, and {most_steps} at most are flown: "
            flights.fail(number, f"{sentence}set `steps` of the group.")
        else:
            flights.store_history(number, history)
    return flights


def _history_of_recording(knowledge: Knowledge, messages: Sequence[FeedItem]) -> History:
    """Let a twin follow the messages of one real asset, and return its beliefs and controls.

    If a late message changes the observation of an earlier step, all steps are filtered again with
    the final observations.
    """
    scenario = knowledge.scenario
    twin = knowledge.twin(lag=scenario.watch.lag)
    history = History(twin, scenario.observation.count)
    intake = Intake(scenario, Feed(messages))
    reading_of_step: dict[int, Reading] = {}
    has_late_message = False
    intake_notices: list[tuple[int, Notice]] = []
    for step in operate(twin, intake, history.add, log_notices):
        number = intake.observation_step
        reading_of_step[number] = Reading(step.reading.observed, twin.control_of(number))
        if step.reading.revises is not None:
            has_late_message = True
        intake_notices += [(number, notice) for notice in intake.notices]
    if has_late_message:
        history = refilter(reading_of_step, [BelievedModel(0, knowledge)])
    history.notices += intake_notices
    return history


class ShardResult(NamedTuple):
    """The result of the flights of B twins.

    Attributes
    ----------
    variables : dict of str to array
        The variables of the store, with B rows each.
    failures : dict of str to str
        The errors of flights that failed, by the name of the twin.
    ended : dict of str to str
        The reasons of assets that ended their simulations early, by the name of the twin.
    """

    variables: Mapping[str, NDArray[np.generic]]
    failures: dict[str, str]
    ended: dict[str, str]


def result_of_unflown(member: Member, reason: str) -> ShardResult:
    """Return the result of one twin that could not fly, given the reason."""
    variables = {"status": np.array([FAILED]), "seed": np.array([member.seed])}
    return ShardResult(variables, {member.name: reason}, {})


class Kit:
    """Everything that the twins of a scenario need to fly, on any machine.

    Parameters
    ----------
    packed : bytes
        Pickled: the portable scenario, the files of the prepared folder by their paths (knowledge
        and FMU), the model that is flown without an FMU, or None, and the user's sensor model and
        estimator.
    """

    def __init__(self, packed_kit: bytes) -> None:
        scenario, files, self.wing, parts = pickle.loads(packed_kit)
        folder = Path(mkdtemp(prefix="uav_twin_fleet_"))
        finalize(self, shutil.rmtree, folder, ignore_errors=True)
        write_members(folder, files)
        self._folder = folder
        self.scenario = Scenario.model_validate(scenario).with_paths_from(folder)
        self.knowledge: Knowledge = load_knowledge(folder, self.scenario, parts=parts)

    def without_folder(self, sentence: str) -> str:
        """Return a sentence with the temporary folder removed from all paths."""
        return sentence.replace(f"{self._folder}/", "")

    def open_asset(self, parameters: Mapping[str, float], seed: int | None = None) -> Asset:
        """Open a simulated asset: the reduced model if the kit has one, else an FMU.

        Parameters
        ----------
        parameters : mapping of str to float
            True parameters that replace those of the scenario, in SI units.
        seed : int, optional
            The seed with which the asset draws its own damage and noise, if it does.
        """
        scenario = with_parameters(self.scenario, parameters)
        if self.wing is not None:
            return ReducedModelSource(scenario, self.wing).open()
        if seed is not None:
            scenario = scenario.with_seed(seed)
        source: AssetSource = scenario.asset.source(scenario)
        if isinstance(source, FmuSource):
            source.use_prepared_folder(self._folder)  # it is packed already
        else:
            source.prepare(self._folder, SilentProgress())
        return source.open()


_unpacked_kit = lru_cache(maxsize=1)(Kit)
"""Unpacks a kit. The last one is kept in memory, because successive shards share their kit."""


def fly_shard(packed_kit: bytes, members: Sequence[Member]) -> ShardResult:
    """Fly some twins of one group, in a process of the cluster, and return what is stored of them.

    Parameters
    ----------
    packed_kit : bytes
        The pickled kit with everything that these flights need.
    members : sequence of Member
        The B twins.
    """
    kit = _unpacked_kit(packed_kit)
    recordings = [member.recording for member in members if member.recording is not None]
    if recordings:
        flights = flights_of_recordings(kit.knowledge, recordings)
    else:
        flights = _fly_assets(kit, members)
    return ShardResult(
        variables=stored_variables(kit.knowledge, flights, members),
        failures=_sentences_by_name(kit, members, flights.failure),
        ended=_sentences_by_name(kit, members, flights.ended),
    )


def _sentences_by_name(
    kit: Kit, members: Sequence[Member], sentences: Sequence[str]
) -> dict[str, str]:
    """Return one sentence for each twin by the twin's name; empty sentences are left out."""
    named_sentences = {}
    for member, sentence in zip(members, sentences, strict=True):
        if sentence:
            named_sentences[member.name] = kit.without_folder(sentence)
    return named_sentences


def _fly_assets(kit: Kit, members: Sequence[Member]) -> Flights:
    """Simulate the assets of some twins, and return the flights.

    Assets without memory are flown side by side in array operations, unless the twins learn or have
    the user's own estimator; others are flown one after the other.
    """
    knowledge = kit.knowledge
    scenario = kit.scenario
    truths = [knowledge.truth(member.seed) for member in members]
    with _AssetPool(kit, members) as pool:
        if not reason_flown_one_by_one(scenario, knowledge.parts):
            # An error is suppressed here: it comes again below and is recorded for each twin.
            with suppress(*FLIGHT_ERRORS):
                assets = pool.open_stateless_assets()
                if assets:
                    return fly_side_by_side(knowledge, truths, assets)
        return fly_one_by_one(knowledge, truths, pool.asset_at_start)


def reason_flown_one_by_one(scenario: Scenario, parts: TwinParts) -> str:
    """Return why the twins of a scenario have no common filter; empty if they have one.

    Twins with a common filter fly side by side in array operations, if their assets have no memory.
    """
    if scenario.learning is not None:
        return "they learn"
    if parts.estimator is not None:
        return "they have an estimator of your own"
    return ""


class _AssetKey(NamedTuple):
    """True parameters and seed of an asset; assets with equal keys are equal.

    The seed is None if the asset draws nothing itself.
    """

    parameters: Mapping[str, float]
    seed: int | None


class _AssetPool(ExitStack):
    """The simulated assets of some twins; at most one asset with memory is open at a time.

    After a failed flight the asset is closed, and a new one is opened for the next twin.
    """

    def __init__(self, kit: Kit, members: Sequence[Member]) -> None:
        super().__init__()
        assets_have_seeds = bool(getattr(kit.scenario.asset, "seeds", ()))
        self._kit = kit
        self._keys = [
            _AssetKey(member.parameters, member.seed if assets_have_seeds else None)
            for member in members
        ]
        self._open_asset: Asset | None = None
        self._open_key = self._keys[0]
        self._start_state = b""

    def open_stateless_assets(self) -> list[Asset]:
        """Return a stateless asset for each twin; empty if the assets have a memory.

        Twins with equal assets share one object. The list is also empty if assets other than the
        reduced model differ between the twins.
        """
        if self._kit.wing is not None:
            # Twins with equal parameters share one reduced model
            parameters_of_twins = [tuple(sorted(key.parameters.items())) for key in self._keys]
            models = {}
            for parameters in set(parameters_of_twins):
                models[parameters] = self._kit.open_asset(dict(parameters))
            return [models[parameters] for parameters in parameters_of_twins]
        if any(key != self._keys[0] for key in self._keys):
            return []
        asset = self._open_at_start(0, is_reusable=False)
        return [asset] * len(self._keys) if isinstance(asset, StatelessAsset) else []

    def asset_at_start(self, twin: int, is_reusable: bool) -> Asset:
        """Return the asset of a twin that flies alone, at the start of the mission.

        `is_reusable` says whether the previous flight ended without an error, so that its asset can
        be reset. An error is raised if the twins share inspections, and so cannot fly one after the
        other.
        """
        if self._kit.scenario.planner.inspections_per_step is not None:
            raise FleetError(
                "`inspections_per_step` needs assets without memory, which fly side by side"
            )
        return self._open_at_start(twin, is_reusable)

    def _open_at_start(self, twin: int, is_reusable: bool) -> Asset:
        """Return the asset of a twin in its start state.

        The open asset is reset if it has the same parameters and seed; otherwise it is closed and a
        new one is opened.
        """
        key = self._keys[twin]
        if self._open_asset is not None and is_reusable and key == self._open_key:
            self._open_asset.restore_state(self._start_state)
        else:
            self._open_asset = None
            self.close()
            self._open_asset = self._kit.open_asset(key.parameters, key.seed)
            self.callback(self._open_asset.close)
            self._start_state = self._open_asset.save_state()
            self._open_key = key
        return self._open_asset
