"""Many twins of one scenario, flown side by side: each flies what `fly` flies, bit for bit.

What does not depend on the neighbours is the same for every size of a batch: sums run over the states, the
sensors and the draws of one twin, never over twins.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from fe.runtime.errors import FiniteElementError
from fmu_asset.errors import FmuEndedError, FmuError
from twin_master.assets.interface import Asset, StatelessAsset
from twin_master.errors import ImpossibleObservation, TwinMasterError
from twin_master.mission.loop import Flight, decided_to_end, ended_sentence, fly
from twin_master.mission.plant import Plant, checked_values
from twin_master.mission.preparation import Knowledge
from twin_master.mission.truth import DamageGrowth, SensorStatus, Truth
from twin_master.network.estimator import Notice
from twin_master.network.step_many import decide_many, filter_step_many, rationed

__all__ = ["Flights", "fly_one_by_one", "fly_side_by_side"]

Float = NDArray[np.float64]
Index = NDArray[np.int64]

IN_FLIGHT = (TwinMasterError, FmuError, FiniteElementError, CalibrationError, OSError)
"""What may end the flight of one asset, and not that of the others."""


@dataclass(frozen=True)
class Flights:
    """B flown missions of T turns; a twin that failed or ended has NaN, and -1 as control, from there on.

    Attributes
    ----------
    observed : (B, T, G)
        What the sensors said, SI; NaN where lost.
    control_index : (B, T)
        Control in force in each turn.
    state : (B, T, F)
        True state, SI.
    filtered : (B, T, S)
        p(D_t | o_0..o_t).
    log_evidence : (B, T)
        log p(o_t | o_0..o_{t-1}).
    failure : tuple of str
        What ended the flight of each twin; empty for one that flew to its end.
    ended : tuple of str
        How the asset of each twin has ended its simulation before that, with what was flown; mostly empty.
    notices : tuple of tuple
        What each twin told its operator, each notice with its turn.
    """

    observed: Float
    control_index: Index
    state: Float
    filtered: Float
    log_evidence: Float
    failure: tuple[str, ...]
    ended: tuple[str, ...]
    notices: tuple[tuple[tuple[int, Notice], ...], ...]

    @classmethod
    def empty(cls, knowledge: Knowledge, count: int) -> "Flights":
        """Return B missions before their first turn."""
        steps, size = knowledge.scenario.mission.steps, knowledge.model.states.size
        sensors, factors = knowledge.scenario.observation.count, len(knowledge.scenario.state)
        return cls(
            observed=np.full((count, steps, sensors), np.nan),
            control_index=np.full((count, steps), -1, dtype=np.int64),
            state=np.full((count, steps, factors), np.nan),
            filtered=np.full((count, steps, size), np.nan),
            log_evidence=np.full((count, steps), np.nan),
            failure=("",) * count,
            ended=("",) * count,
            notices=((),) * count,
        )

    @classmethod
    def of(cls, knowledge: Knowledge, flight: Flight) -> "Flights":
        """Return one mission that `fly` has flown."""
        found = cls.empty(knowledge, 1)
        for name in ("observed", "control_index", "filtered", "log_evidence"):
            getattr(found, name)[0, : len(flight.observed)] = getattr(flight, name)
        found.state[0, : len(flight.observed)] = flight.happened.state
        ended = "".join(notice.sentence for _, notice in flight.notices if notice.kind == "ended")
        return replace(found, ended=(ended,), notices=(flight.notices,))

    @classmethod
    def joined(cls, parts: "Sequence[Flights]") -> "Flights":
        """Return the missions of several batches as one."""
        names = ("observed", "control_index", "state", "filtered", "log_evidence")
        arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        failure, ended = (
            tuple(text for part in parts for text in texts(part))
            for texts in (attrgetter("failure"), attrgetter("ended"))
        )
        notices = tuple(told for part in parts for told in part.notices)
        return cls(**arrays, failure=failure, ended=ended, notices=notices)


class _Plants(Protocol):
    """The assets of B twins with their truths."""

    def turn(self, step: int, control: Index, flying: NDArray[np.bool_]) -> tuple[Float, Float]:
        """Return what is observed (B, G + I) and the true states (B, F), under the controls (B,)."""

    failure: dict[int, str]
    """What ended the flight of a twin."""
    ended: dict[int, str]
    """How an asset has ended its simulation."""


class _Each:
    """Assets of any kind, each driven by its own `Plant`."""

    def __init__(self, knowledge: Knowledge, truths: Sequence[Truth], assets: Sequence[Asset]) -> None:
        pairs = zip(truths, assets, strict=True)
        self._plants: list[Plant] = [knowledge.plant(truth, asset) for truth, asset in pairs]
        self._shape = len(self._plants), knowledge.scenario.row_width, len(knowledge.scenario.state)
        self._before: Index | None = None
        self._scenario = knowledge.scenario
        self.failure: dict[int, str] = {}
        self.ended: dict[int, str] = {}

    def turn(self, step: int, control: Index, flying: NDArray[np.bool_]) -> tuple[Float, Float]:
        count, sensors, factors = self._shape
        observed, state = np.full((count, sensors), np.nan), np.full((count, factors), np.nan)
        for twin in np.flatnonzero(flying).tolist():
            before = None if self._before is None else int(self._before[twin])
            try:
                observed[twin] = self._plants[twin].turn(int(control[twin]), before)
                state[twin] = self._plants[twin].latest()[0]
            except FmuEndedError as error:
                if step:
                    self.ended[twin] = ended_sentence(self._scenario, step, error.sentence)
                else:
                    self.failure[twin] = str(error)
            except IN_FLIGHT as error:
                self.failure[twin] = str(error)
        self._before = control.copy()
        return observed, state


class _Stateless:
    """Assets without memory: what one shows under a control and a state is asked once."""

    def __init__(self, knowledge: Knowledge, truths: Sequence[Truth], assets: Sequence[Asset]) -> None:
        self._scenario, self._states = knowledge.scenario, knowledge.model.states
        distinct = {id(asset): asset for asset in assets}
        self._assets = list(distinct.values())
        numbers = {key: number for number, key in enumerate(distinct)}
        self._asset = np.array([numbers[id(asset)] for asset in assets])
        self._growth = DamageGrowth(knowledge.true_model)
        self._noise = np.stack([truth.noise for truth in truths])
        self._uniform = np.stack([truth.uniform for truth in truths])
        self._truths, self._truth = (
            truths,
            truths[0],
        )  # script, drift and losses are the scenario's, the same for all
        self._before: list[tuple[int | None, int | None]] = [(None, None)] * len(assets)
        self._seen: dict[tuple[int, int, bytes], Float | str] = {}
        self.failure: dict[int, str] = {}
        self.ended: dict[int, str] = {}  # without memory there is no end

    def turn(self, step: int, control: Index, flying: NDArray[np.bool_]) -> tuple[Float, Float]:
        place, state = self._grown(step, control)
        code = (self._asset * len(self._scenario.control) + control) * self._states.size + place
        _, first, inverse = np.unique(np.where(flying, code, -1), return_index=True, return_inverse=True)
        distinct = np.full((len(first), self._noise.shape[2]), np.nan)
        for row, twin in enumerate(first.tolist()):
            shown = self._shown(step, int(self._asset[twin]), int(control[twin]), state[twin])
            if isinstance(shown, str):
                self.failure |= {int(other): shown for other in np.flatnonzero(inverse == row)}
            else:
                distinct[row] = shown
        observed = distinct[inverse] + self._noise[:, step] + self._truth.drift[step]
        observed[:, self._truth.status[step] == SensorStatus.LOST] = np.nan
        turns = zip(self._truths, state, control.tolist(), strict=True)
        return np.hstack((observed, [truth.inspected(step, *turn) for truth, *turn in turns])), state

    def _grown(self, step: int, control: Index) -> tuple[Index, Float]:
        """Return the true states: their numbers (B,), zeros where they are scripted, and levels (B, F)."""
        if self._scenario.truth.kind == "scripted":
            state = self._truth.state(step, None, None)
            return np.zeros_like(control), np.broadcast_to(state, (len(control), len(state)))
        uniform = self._uniform[:, step].tolist()
        moved = zip(self._before, uniform, strict=True)
        grown = [self._growth.following(*before, value) for before, value in moved]
        self._before = list(zip(control.tolist(), grown, strict=True))
        place = np.array(grown)
        return place, self._states.coordinates[place]

    def _shown(self, step: int, asset: int, control: int, state: Float) -> Float | str:
        """Return what an asset shows without noise (G,), or why it does not."""
        key = asset, control, state.tobytes()
        if key not in self._seen:
            chosen = self._scenario.control[control]
            health = dict(zip(self._scenario.state_names, state.tolist(), strict=True))
            try:
                reading = self._assets[asset].step(chosen.values, health)
                self._seen[key] = checked_values(self._scenario, reading, step, chosen.name)
            except IN_FLIGHT as error:
                self._seen[key] = str(error)
        return self._seen[key]


def fly_side_by_side(knowledge: Knowledge, truths: Sequence[Truth], assets: Sequence[Asset]) -> Flights:
    """Fly B missions of one scenario in lock-step.

    Parameters
    ----------
    knowledge : Knowledge
        What all twins know; the scenario neither learns nor gives notice.
    truths : sequence of Truth
        One for each twin.
    assets : sequence of Asset
        One for each twin, at its start; one without memory may stand for several twins.
    """
    scenario, model = knowledge.scenario, knowledge.model
    count = len(truths)
    flights = Flights.empty(knowledge, count)
    stateless = all(isinstance(asset, StatelessAsset) for asset in assets)
    plants: _Plants = (_Stateless if stateless else _Each)(knowledge, truths, assets)
    control = np.full(count, scenario.control_names.index(scenario.mission.first_control))
    flying = np.ones(count, dtype=bool)
    ending = np.array([scenario.ends(index) for index in range(len(scenario.control))])
    budget, inspecting = (
        scenario.planner.inspections_a_turn,
        sorted({place for place, *_ in scenario.readings}),
    )
    before: tuple[Float | None, Index | None] = None, None
    for step in range(scenario.mission.steps):
        if before[1] is not None:
            for twin in np.flatnonzero(flying & ending[before[1]]).tolist():
                how = decided_to_end(scenario, before[1][twin])
                plants.ended[twin] = ended_sentence(scenario, step, how)
                flying[twin] = False
        observed, state = plants.turn(step, control, flying)
        flying[[*plants.failure, *plants.ended]] = False
        observed[~flying] = np.nan
        likelihood = knowledge.sensor_model.log_likelihood_sequence(observed, control)
        filtered, log_filtered, evidence, impossible = filter_step_many(model, *before, likelihood)
        for twin in np.flatnonzero(impossible & flying).tolist():
            worst = knowledge.sensor_model.worst_residuals(observed[twin], int(control[twin]))
            plants.failure[twin] = str(ImpossibleObservation(scenario.mission.name, step, worst))
        flying &= ~impossible
        log_filtered[impossible] = model.log_prior  # of a failed twin: anything that can be gone on with
        kept = (
            (flights.observed, observed[:, : scenario.observation.count]),
            (flights.control_index, control),
            (flights.state, state),
        )
        for array, row in (*kept, (flights.filtered, filtered), (flights.log_evidence, evidence)):
            array[flying, step] = row[flying]
        before = log_filtered, control
        flown, on_belief = control, knowledge.plan.on_belief
        control = decide_many(model, filtered, control, knowledge.plan, scenario.planner.decide_on)
        if budget is not None and on_belief is not None:
            some = np.flatnonzero(flying)
            control[some] = rationed(
                model, filtered[some], flown[some], control[some], on_belief, inspecting, budget
            )
    failure, ended = (
        tuple(told.get(twin, "") for twin in range(count)) for told in (plants.failure, plants.ended)
    )
    return replace(flights, failure=failure, ended=ended)


def fly_one_by_one(knowledge: Knowledge, truths: Sequence[Truth], assets: Iterable[Asset]) -> Flights:
    """Fly B missions one after the other with `fly`: for twins that learn, or give notice.

    Parameters
    ----------
    knowledge, truths, assets
        As of `fly_side_by_side`; an asset is asked for when its twin begins.
    """
    flown = []
    for truth, asset in zip(truths, assets, strict=True):
        try:
            flight = fly(knowledge.scenario, knowledge.twin(), knowledge.plant(truth, asset))
            flown.append(Flights.of(knowledge, flight))
        except IN_FLIGHT as error:
            flown.append(replace(Flights.empty(knowledge, 1), failure=(str(error),)))
    return Flights.joined(flown)
