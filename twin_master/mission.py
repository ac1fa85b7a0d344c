"""The mission loop: control, asset, observation, assimilate, smooth, predict, decide, control."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reporting.progress import Progress, SilentProgress
from twin_master.checkpoint import Checkpoint
from twin_master.errors import NotResumableError
from twin_master.plant import Plant, PlantRecord
from twin_master.scenario import Scenario
from twin_master.twin import Twin, TwinTurn

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
    predicted_joint : (T, H, S, U)
        p(D_{t+h}, U_{t+h} | o_0..o_t).
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
    predicted_joint: Float
    decision_probability: Float
    truth: PlantRecord
    timing: tuple[TurnTiming, ...]
    resumed_at: int = 0


def fly(
    scenario: Scenario,
    twin: Twin,
    plant: Plant,
    *,
    config_hash: str = "",
    checkpoint: Checkpoint | None = None,
    keep: Callable[[Checkpoint], None] | None = None,
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
    config_hash : str
        Identifies the configuration in the checkpoints.
    checkpoint : Checkpoint, optional
        Where an interrupted mission stopped.
    keep : callable, optional
        Called with a checkpoint after every turn.
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
    turns: list[TwinTurn] = []
    timing: list[TurnTiming] = []
    if checkpoint is not None:
        turns = _replay(twin, checkpoint)
        observed = list(checkpoint.observed)
        controls = checkpoint.control_index.tolist()
        plant.restore(checkpoint.plant, checkpoint.asset_state)
    resumed_at = len(turns)
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
            turns.append(turn)
            if keep is not None:
                keep(
                    Checkpoint(
                        config_hash=config_hash,
                        observed=np.array(observed),
                        control_index=np.array(controls, dtype=np.int64),
                        plant=plant.record(),
                        asset_state=plant.save_state(),
                    )
                )
            timing.append(TurnTiming(flown - begin, decided - flown, time.perf_counter() - decided))
            stage.advance(detail=scenario.control_names[controls[step]])
    return Flight(
        observed=np.array(observed),
        control_index=np.array(controls[:steps], dtype=np.int64),
        filtered=np.array([turn.filtered for turn in turns]),
        log_evidence=np.array([turn.log_evidence for turn in turns]),
        smoothed=turns[-1].smoothed,
        predicted=np.array([turn.prediction.predicted for turn in turns]),
        predicted_joint=np.array([turn.prediction.joint for turn in turns]),
        decision_probability=np.array([turn.decision_probability for turn in turns]),
        truth=plant.record(),
        timing=tuple(timing),
        resumed_at=resumed_at,
    )


def _replay(twin: Twin, checkpoint: Checkpoint) -> list[TwinTurn]:
    """Let the twin see again what was observed, and check that it decides as it did."""
    turns = []
    for step, observation in enumerate(checkpoint.observed):
        turn = twin.turn(observation, int(checkpoint.control_index[step]))
        if turn.next_control != checkpoint.control_index[step + 1]:
            raise NotResumableError(
                f"the checkpoint decided otherwise after turn {step} than this version does: "
                "fly the mission again with --replace."
            )
        turns.append(turn)
    return turns
