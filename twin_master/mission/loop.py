"""The mission loop: control, asset, observation, assimilate, predict, decide, control; at its end, smooth."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from reporting.progress import Progress, SilentProgress
from twin_master.errors import NotResumableError
from twin_master.mission.checkpoint import Checkpoint, FlownTurn
from twin_master.mission.plant import Plant, PlantRecord
from twin_master.network.twin import Twin, TwinTurn
from twin_master.scenario.schema import Scenario

Float = NDArray[np.float64]
Index = NDArray[np.int64]


@dataclass(frozen=True)
class TurnTiming:
    """Wall-clock seconds of one turn."""

    asset: float
    twin: float
    checkpoint: float


@dataclass(frozen=True)
class Flight:
    """A flown mission of T turns.

    Attributes
    ----------
    observed : (T, G)
        What the sensors said, SI; NaN where lost.
    control_index : (T,)
        Control in force in each turn.
    filtered : (T, S)
        p(D_t | o_0..o_t).
    log_evidence : (T,)
        log p(o_t | o_0..o_{t-1}).
    smoothed : (T, S)
        p(D_t | o_0..o_{T-1}).
    predicted : (T, H, S)
        p(D_{t+h} | o_0..o_t), h = 1..H.
    decision_probability : (T, U)
        What the control of turn t + 1 was decided by: its mode is flown.
    truth : PlantRecord
        What really happened.
    timing : tuple of TurnTiming
        Of the turns flown by this process.
    resumed_at : int
        Turn at which this process took over; 0 for an uninterrupted mission.
    """

    observed: Float
    control_index: Index
    filtered: Float
    log_evidence: Float
    smoothed: Float
    predicted: Float
    decision_probability: Float
    truth: PlantRecord
    timing: tuple[TurnTiming, ...]
    resumed_at: int = 0


def fly(
    scenario: Scenario,
    twin: Twin,
    plant: Plant,
    *,
    checkpoint: Checkpoint | None = None,
    keep: Callable[[FlownTurn], None] | None = None,
    progress: Progress | None = None,
) -> Flight:
    """Fly a mission, or the rest of one.

    Parameters
    ----------
    scenario : Scenario
        Number of turns and first control.
    twin : Twin
        A twin that has seen nothing yet.
    plant : Plant
        The asset with its truth, before its first turn.
    checkpoint : Checkpoint, optional
        Where an interrupted mission stopped.
    keep : callable, optional
        Called with what cannot be computed again after every turn.
    progress : Progress, optional
        Shows the turns.

    Raises
    ------
    ImpossibleObservation, AssetOutputError, FmuError
        The mission cannot go on; the last checkpoint is that of the turn before.
    NotResumableError
        The decisions of the checkpoint do not follow from its observations.
    """
    steps = scenario.mission.steps
    controls: list[int] = [scenario.control_names.index(scenario.mission.first_control)]
    observed: list[Float] = []
    beliefs = _Beliefs()
    timing: list[TurnTiming] = []
    if checkpoint is not None:
        _replay(twin, checkpoint, beliefs)
        observed = list(checkpoint.observed)
        controls = checkpoint.control_index.tolist()
        plant.restore(checkpoint.plant, checkpoint.asset_state)
    resumed_at = len(observed)
    unit = f"{scenario.mission.step_name}s"
    with (progress or SilentProgress()).stage("Flying", total=steps, unit=unit) as stage:
        stage.advance(resumed_at)
        for step in range(resumed_at, steps):
            begin = time.perf_counter()
            observation = plant.turn(controls[step], controls[step - 1] if step else None)
            flown = time.perf_counter()
            turn = twin.turn(observation, controls[step])
            decided = time.perf_counter()
            observed.append(observation)
            controls.append(turn.next_control)
            beliefs.add(turn)
            if keep is not None:
                state, noise_free, monitors = plant.latest()
                keep(
                    FlownTurn(
                        control_index=controls[step],
                        next_control=turn.next_control,
                        observed=observation,
                        state=state,
                        observation=noise_free,
                        monitors=monitors,
                        asset_state=plant.save_state(),
                    )
                )
            timing.append(TurnTiming(flown - begin, decided - flown, time.perf_counter() - decided))
            stage.advance(detail=scenario.control_names[controls[step]])
    return Flight(
        observed=np.array(observed),
        control_index=np.array(controls[:steps], dtype=np.int64),
        filtered=np.array(beliefs.filtered),
        log_evidence=np.array(beliefs.log_evidence),
        smoothed=twin.smoothed(),
        predicted=np.array(beliefs.predicted),
        decision_probability=np.array(beliefs.decision_probability),
        truth=plant.record(),
        timing=tuple(timing),
        resumed_at=resumed_at,
    )


@dataclass
class _Beliefs:
    """What is kept of each turn of the twin, for the store."""

    filtered: list[Float] = field(default_factory=list)
    log_evidence: list[float] = field(default_factory=list)
    predicted: list[Float] = field(default_factory=list)
    decision_probability: list[Float] = field(default_factory=list)

    def add(self, turn: TwinTurn) -> None:
        self.filtered.append(turn.filtered)
        self.log_evidence.append(turn.log_evidence)
        self.predicted.append(turn.prediction.predicted)
        self.decision_probability.append(turn.decision_probability)


def _replay(twin: Twin, checkpoint: Checkpoint, beliefs: _Beliefs) -> None:
    """Let the twin see again what was observed, and check that it decides as it did."""
    for step, observation in enumerate(checkpoint.observed):
        turn = twin.turn(observation, int(checkpoint.control_index[step]))
        if turn.next_control != checkpoint.control_index[step + 1]:
            raise NotResumableError(
                f"the checkpoint decided otherwise after turn {step} than this version does: "
                "fly the mission again with --replace."
            )
        beliefs.add(turn)
