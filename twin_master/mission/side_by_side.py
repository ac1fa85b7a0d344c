"""Many twins of one scenario, flown side by side: each flies what `fly` flies, bit for bit.

What does not depend on the neighbours is the same for every size of a batch: sums run over the states, the
sensors and the draws of one twin, never over twins.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.errors import CalibrationError
from fe.runtime.errors import FiniteElementError
from fmu_asset.errors import FmuError
from reporting.arrays import Float, Index
from twin_master.assets.asset_source import Asset, StatelessAsset
from twin_master.errors import ImpossibleObservation, TwinMasterError
from twin_master.mission.loop import ended_sentence, fly
from twin_master.mission.preparation import Knowledge
from twin_master.mission.steps import History, Truth, checked_values, decided_to_end
from twin_master.network.estimator import Notice
from twin_master.network.inference import filter_many
from twin_master.network.planner import decision_probability, ration_controls

IN_FLIGHT = (TwinMasterError, FmuError, FiniteElementError, CalibrationError, OSError)
"""What may end the flight of one asset, and not that of the others."""


@dataclass
class Flights:
    """What is kept of B histories; a twin that failed or ended has NaN, and control -1, from there on.

    Attributes
    ----------
    row : (B, T, G + I)
        What came, as in `History`, SI; NaN where nothing did.
    control_index : (B, T)
        Control in force in each step.
    state : (B, T, F)
        True state, SI; NaN of a real asset.
    filtered : (B, T, S)
        p(D_t | o_0..o_t).
    log_evidence : (B, T)
        log p(o_t | o_0..o_{t-1}).
    unexplained : (B, T)
        Probability that no state explains the sensors, see `is_state_believed`; 0 of twins without notices.
    failure : list of str
        What ended the flight of each twin; empty for one that flew to its end.
    ended : list of str
        How the asset of each twin has ended its simulation before that, with what was flown; mostly empty.
    notices : list of list
        What each twin told its operator, each notice with its step.
    """

    row: Float
    control_index: Index
    state: Float
    filtered: Float
    log_evidence: Float
    unexplained: Float
    failure: list[str]
    ended: list[str]
    notices: list[list[tuple[int, Notice]]]

    @classmethod
    def empty(cls, knowledge: Knowledge, count: int) -> "Flights":
        """Return B missions before their first step."""
        steps, size = knowledge.scenario.mission.steps, knowledge.model.states.size
        width, factors = knowledge.scenario.row_width, len(knowledge.scenario.state)
        return cls(
            row=np.full((count, steps, width), np.nan),
            control_index=np.full((count, steps), -1, dtype=np.int64),
            state=np.full((count, steps, factors), np.nan),
            filtered=np.full((count, steps, size), np.nan),
            log_evidence=np.full((count, steps), np.nan),
            unexplained=np.full((count, steps), np.nan),
            failure=[""] * count,
            ended=[""] * count,
            notices=[[] for _ in range(count)],
        )

    def put(self, twin: int, history: History) -> None:
        """Take in the steps of a twin."""
        steps_flown = len(history.steps)
        names = ["row", "control_index", "filtered", "log_evidence", "unexplained"] if steps_flown else []
        for name in names + ["state"] * history.simulated:
            getattr(self, name)[twin, :steps_flown] = getattr(history, name)
        self.ended[twin], self.notices[twin] = history.ended, history.notices


class _Stateless:
    """Assets without memory: what one shows under a control and a state is asked once."""

    def __init__(self, knowledge: Knowledge, truths: Sequence[Truth], assets: Sequence[Asset]) -> None:
        self._scenario, self._states = knowledge.scenario, knowledge.model.states
        distinct = {id(asset): asset for asset in assets}
        self._assets = list(distinct.values())
        numbers = {key: number for number, key in enumerate(distinct)}
        self._asset = np.array([numbers[id(asset)] for asset in assets])
        self._truth = Truth.together(truths)
        self._before: tuple[Index | None, Index | None] = None, None
        self._seen: dict[tuple[int, int, bytes], Float | str] = {}

    def fly_step(
        self, step: int, control: Index, flying: NDArray[np.bool_], failure: list[str]
    ) -> tuple[Float, Float]:
        """Return what is observed (B, G + I) and the true states (B, F), under the controls (B,).

        Why an asset shows nothing is put where the failures of the twins stand.
        """
        place, state = self._grown(step, control)
        code = (self._asset * len(self._scenario.control) + control) * self._states.size + place
        _, first, inverse = np.unique(np.where(flying, code, -1), return_index=True, return_inverse=True)
        distinct = np.full((len(first), self._scenario.observation.count), np.nan)
        for row, twin in enumerate(first.tolist()):
            shown = self._shown(step, int(self._asset[twin]), int(control[twin]), state[twin])
            if isinstance(shown, str):
                for other in np.flatnonzero((inverse == row) & flying):
                    failure[other] = shown
            else:
                distinct[row] = shown
        sensed, read = self._truth.sense(step, distinct[inverse]), self._truth.inspected(step, state, control)
        return np.hstack((sensed, read)), state

    def _grown(self, step: int, control: Index) -> tuple[Index, Float]:
        """Return the true states: their numbers (B,), zeros where they are scripted, and levels (B, F)."""
        if self._scenario.truth.kind == "scripted":
            state = self._truth.state(step, None, None)
            return np.zeros_like(control), np.broadcast_to(state, (len(control), len(state)))
        place = self._truth.growth.following(*self._before, self._truth.uniform[step])
        self._before = control, place
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
    """Fly B missions of one scenario: in lock-step, or one by one where assets have a memory.

    Parameters
    ----------
    knowledge : Knowledge
        What all twins know; the scenario neither learns nor gives notice.
    truths : sequence of Truth
        One for each twin.
    assets : sequence of Asset
        One for each twin, at its start; one without memory may stand for several twins.
    """
    if not all(isinstance(asset, StatelessAsset) for asset in assets):
        return fly_one_by_one(knowledge, truths, lambda twin, _sound: assets[twin])
    scenario, model, count = knowledge.scenario, knowledge.model, len(truths)
    flights, plants = Flights.empty(knowledge, count), _Stateless(knowledge, truths, assets)
    control = np.full(count, scenario.control_names.index(scenario.mission.first_control))
    flying = np.ones(count, dtype=bool)
    ending = np.array([scenario.ends(index) for index in range(len(scenario.control))])
    budget, on_belief = scenario.planner.inspections_per_step, knowledge.plan.on_belief
    inspecting = sorted({place for place, *_ in scenario.readings})
    before: tuple[Float, Index] = model.log_prior, np.array(-1)
    for step in range(scenario.mission.steps):
        if step:
            for twin in np.flatnonzero(flying & ending[before[1]]).tolist():
                how = decided_to_end(scenario, before[1][twin])
                flights.ended[twin] = ended_sentence(scenario, step, how)
                flying[twin] = False
        observed, state = plants.fly_step(step, control, flying, flights.failure)
        flying &= np.array(flights.failure) == ""
        observed[~flying] = np.nan
        likelihood = knowledge.sensor_model.log_likelihood_sequence(observed, control)
        found, failed = filter_many(model.transition, control[:, None], likelihood[:, None], *before)
        now, impossible = found[:, 0], failed >= 0
        for twin in np.flatnonzero(impossible & flying).tolist():
            worst = knowledge.sensor_model.worst_residuals(observed[twin], int(control[twin]))
            flights.failure[twin] = str(ImpossibleObservation(scenario.mission.name, step, worst))
        flying &= ~impossible
        # Of a failed twin: anything that can be gone on with.
        now.filtered[impossible], now.log_filtered[impossible] = model.prior, model.log_prior
        for array, row in (
            (flights.row, observed),
            (flights.control_index, control),
            (flights.state, state),
            (flights.filtered, now.filtered),
            (flights.log_evidence, now.log_evidence),
            (flights.unexplained, np.zeros(count)),  # none of these gives notice
        ):
            array[flying, step] = row[flying]
        before = now.log_filtered, control
        asked = decision_probability(
            model.transition, now.filtered, control, knowledge.plan.policy, on_belief,
            ahead=scenario.planner.decide_on == "predicted",
        )  # fmt: skip
        control = np.argmax(asked, axis=1)
        if budget is not None and on_belief is not None:
            some = np.flatnonzero(flying)
            control[some] = ration_controls(
                model.transition, now.filtered[some], before[1][some], control[some], on_belief, inspecting,
                budget,
            )  # fmt: skip
    return flights


def fly_one_by_one(
    knowledge: Knowledge, truths: Sequence[Truth], asset_of: Callable[[int, bool], Asset]
) -> Flights:
    """Fly B missions one after the other with `fly`.

    Assets with a memory need it, and twins that learn or give notice.

    Parameters
    ----------
    knowledge, truths
        As of `fly_side_by_side`.
    asset_of : callable
        Returns the asset of a twin at its start, once its flight begins; told whether the flight before it
        went to its end.
    """
    flights, sound = Flights.empty(knowledge, len(truths)), True
    for number, truth in enumerate(truths):
        twin = knowledge.twin()
        history = History(twin, knowledge.scenario.observation.count)
        try:
            asset = asset_of(number, sound)
            fly(knowledge.scenario, twin, knowledge.plant(truth, asset), history=history)
        except IN_FLIGHT as error:
            flights.failure[number] = str(error)
        flights.put(number, history)
        sound = not flights.failure[number] and not history.ended
    return flights
