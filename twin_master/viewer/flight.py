"""A flight for its viewers: its steps, beliefs, decisions and predictions, from the journal.

The run or watch itself computes nothing for its viewers. The journal contains beliefs and
decisions; predictions and expected values are computed here from them by the functions of the
run, so that every number is that of the run.
"""

import os
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import groupby, islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from reporting.arrays import Float
from reporting.errors import DamagedFileError
from reporting.json_file import JsonObject, read_json
from twin_master.errors import RunFolderError
from twin_master.learning.expectation import (
    Expectation,
    LearntExpectation,
    concatenate_expectations,
    expectation_of_draws,
)
from twin_master.mission.decision_record import unexplained_probability
from twin_master.mission.journal import JOURNAL_NAME, records_in_file
from twin_master.mission.journal_packing import array_from_json
from twin_master.mission.knowledge_file import KNOWLEDGE_NAME, load_knowledge
from twin_master.mission.preparation import Knowledge
from twin_master.mission.recent_parts import RecentParts
from twin_master.network.estimator import Learnt, is_state_believed
from twin_master.network.inference import known_control, predict
from twin_master.run_folder import PICTURE, VERDICT, read_scenario

MOST_NEW_LINES = 200
"""Largest number of lines that an update reads, so that viewers are answered in between."""

StepRecord = JsonObject
"""The line of a step in the journal; `docs/reference/run_folder.md` lists its keys."""


class StepBeliefs(NamedTuple):
    """The beliefs in each of n steps, over S states and U controls.

    Attributes
    ----------
    probability : (n, S) array
        The probability of each state.
    is_believed : (n,) array of bool
        Whether the probabilities of states are believed: false if the readings are probably those
        of none of the states, see `is_state_believed`.
    expected : Expectation
        The expected sensors and rewards, without quantiles. The reward of the error is NaN if
        nothing was observed.
    control_probability : (n, U) array
        The probability of each control. For a step that was flown it is that of the control of the
        next step, from which the twin chose; for a predicted step, that of its own control.
    """

    probability: Float
    is_believed: NDArray[np.bool_]
    expected: Expectation
    control_probability: Float


class ForceDrawing(NamedTuple):
    """The drawing of the missing force that a verdict has found.

    Attributes
    ----------
    step : int
        The step after which the verdict came.
    path : Path
        The file of the drawing, SVG.
    sentence : str
        The sentence of the verdict.
    """

    step: int
    path: Path
    sentence: str


def find_force_drawing(step: int, verdict_folder: Path) -> ForceDrawing | None:
    """Return the drawing of a missing force from the folder of a verdict.

    Parameters
    ----------
    step : int
        The step after which the verdict came.

    Returns
    -------
    ForceDrawing or None
        None if the folder has no drawing, or no verdict that can be read.
    """
    drawing = verdict_folder / PICTURE
    if not drawing.is_file():
        return None
    with suppress(DamagedFileError, KeyError, TypeError):
        verdict = read_json(verdict_folder / VERDICT, DamagedFileError)["verdict"]
        return ForceDrawing(step, drawing, str(verdict["sentence"]))
    return None


@dataclass
class _StepLines:
    """The positions of the lines of a step in the journal [bytes].

    Attributes
    ----------
    belief : int
        The line with the belief and the decision. It is a later line if an earlier observation
        came late.
    observation : int
        The line with the observation. It is a later line if the observation came late.
    """

    belief: int
    observation: int


class _JournalledKnowledge(NamedTuple):
    """The knowledge of the twin, and the first line of the journal for which it holds.

    Attributes
    ----------
    begin : int
        The position in the journal at which this line begins [bytes].
    knowledge : Knowledge
        The model of the twin, with its plan.
    """

    begin: int
    knowledge: Knowledge


class Flight:
    """A run or a watch, read from its journal, with the beliefs and decisions of each step.

    Each step has the belief and the decision that the twin had at that time. The learnt quantities
    of a step are those of the last line up to it that contains them.

    Parameters
    ----------
    folder : Path
        The run folder, with a flight that has ended, goes on, or was interrupted.

    Raises
    ------
    NotResumableError, RunFolderError
        If it is not a run folder, if it is damaged, or if the flight is not prepared yet (see
        `is_prepared`).

    Attributes
    ----------
    scenario : Scenario
        The scenario of the flight.
    drawings : list of ForceDrawing
        The drawings of missing forces, in the order of their verdicts.
    number : int
        A number that grows when earlier steps are removed, as by a resumed run, or changed, as by
        an observation that came late. The steps that viewers have loaded are then out of date.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._path = folder / JOURNAL_NAME
        self.scenario = read_scenario(folder)
        self.number = 0
        self._start_with_file(0)

    def _start_with_file(self, inode: int) -> None:
        """Forget all steps, and read the journal from its beginning.

        Parameters
        ----------
        inode : int
            The inode of the file that is the journal now; 0 if there is no file yet.
        """
        self._inode = inode
        self._end = 0  # of the lines that were read [bytes]
        self._models: list[_JournalledKnowledge] = []
        self._add_model(0)
        self._lines_of_steps: list[_StepLines] = []
        self._recent = RecentParts(self.folder)
        self._learnt_steps: list[int] = []  # whose own lines contain what was learnt
        self._last_learnt: tuple[int, JsonObject] = (-1, {})  # begin of its line, and its entry
        # Notices of lines that are not steps, by the step before them
        self._later_notices: defaultdict[int, list[StepRecord]] = defaultdict(list)
        self.drawings: list[ForceDrawing] = []
        self.number += 1

    def _add_model(self, begin: int) -> None:
        """Load the next model that the twin believed, and add it to the list of models.

        Parameters
        ----------
        begin : int
            The position of the first journal line that was written with this model [bytes].
        """
        knowledge = load_knowledge(self.folder, self.scenario, len(self._models))
        self._models.append(_JournalledKnowledge(begin, knowledge))

    @property
    def knowledge(self) -> Knowledge:
        """The knowledge of the twin after the last line of the journal that was read."""
        return self._models[-1].knowledge

    def _knowledge_in(self, record: StepRecord) -> Knowledge:
        """Return the knowledge with which the twin computed the belief of a step."""
        begin = self._lines_of_steps[record["step"]].belief
        return next(model.knowledge for model in reversed(self._models) if model.begin <= begin)

    def _has_other_file(self, status: os.stat_result) -> bool:
        """Return whether the journal was replaced by another file, or lines were removed."""
        return status.st_ino != self._inode or status.st_size < self._end

    @property
    def steps(self) -> int:
        """The number of steps so far."""
        return len(self._lines_of_steps)

    def update(self) -> bool:
        """Read the new lines of the journal, at most `MOST_NEW_LINES`.

        Returns
        -------
        bool
            Whether there was anything new.

        Raises
        ------
        RunFolderError
            If the journal was changed.
        """
        state_before = (self.number, self._end)
        with suppress(FileNotFoundError), self._path.open("rb") as file:
            status = os.fstat(file.fileno())
            if self._has_other_file(status):
                self._start_with_file(status.st_ino)
            new_lines = islice(records_in_file(file, self._path, self._end), MOST_NEW_LINES)
            for record, begin, end in new_lines:
                self._add_line(record, begin)
                self._end = end
        return (self.number, self._end) != state_before

    def _add_line(self, record: StepRecord, begin: int) -> None:
        """Add a new line of the journal: a new step, a late observation, or an event.

        An event is a line that belongs to no step, such as a verdict. `number` counts the revisions
        of earlier steps: a late observation or an event changes steps that viewers have loaded, and
        increases it; a new step does not.

        Parameters
        ----------
        begin : int
            The position at which the line begins in the journal [bytes].
        """
        has_belief = "filtered" in record
        if has_belief and record["step"] == self.steps:
            # the line of a new step contains its belief and its observation
            if "learnt" in record:
                self._learnt_steps.append(self.steps)
            self._lines_of_steps.append(_StepLines(belief=begin, observation=begin))
            return
        self.number += 1
        last_step = self.steps - 1
        if has_belief:
            # The late observation of an earlier step, and the belief of the last step, which the
            # twin has filtered again with it
            observed_step = int(record.get("observation_step", int(record["step"])))
            if not 0 <= observed_step <= record["step"] == last_step:
                step_name = self.scenario.mission.step_name
                raise RunFolderError(
                    f"the journal in {self.folder} has a line of {step_name} {record['step']} "
                    f"where {step_name} {self.steps} is expected: it was written by another "
                    "version, or is damaged."
                )
            self._lines_of_steps[-1].belief = begin
            self._lines_of_steps[observed_step].observation = begin
            return

        # An event: its notices are shown with the last step before it, and the drawing of the
        # missing force of its verdict is added.
        step = max(last_step, 0)
        self._later_notices[step] += record.get("notices", [])
        verdict_folder = record.get("verdict", {}).get("folder", "")
        if "model" in record:
            self._add_model(begin)
            verdict_folder = record["model"].get("verdict", verdict_folder)
        if verdict_folder:
            drawing = find_force_drawing(step, self.folder / verdict_folder)
            if drawing is not None:
                self.drawings.append(drawing)

    def records_of_steps(self, first: int, end: int) -> list[StepRecord]:
        """Return the records of the steps first..end - 1 from the journal.

        The record of a step has its observation and its control also if they came late.

        Raises
        ------
        FileNotFoundError
            If another flight has taken the place of this one, which `update` notices.
        """
        with self._path.open("rb") as file:
            if self._has_other_file(os.fstat(file.fileno())):
                raise FileNotFoundError(self._path)
            return [self._record_of_step(file, step) for step in range(first, end)]

    def _record_of_step(self, file: BinaryIO, step: int) -> StepRecord:
        """Return the record of a step from the lines with its belief and its observation."""
        lines = self._lines_of_steps[step]
        record = self._record_at(file, lines.belief)
        earlier_steps = bisect_right(self._learnt_steps, step)
        if "learnt" not in record and earlier_steps:
            line_of_learnt = self._lines_of_steps[self._learnt_steps[earlier_steps - 1]].belief
            record["learnt"] = self._learnt_in(file, line_of_learnt)
        if lines.observation != lines.belief:
            observation = self._record_at(file, lines.observation)
            for name in ("observed", "control_index"):
                record[name] = observation[name]
        record["notices"] = record.get("notices", []) + self._later_notices.get(step, [])
        return record

    def _learnt_in(self, file: BinaryIO, begin: int) -> JsonObject:
        """Return the learnt quantities in the line that begins at a byte of the journal.

        The last result is kept, because successive steps ask for the same line.
        """
        last_begin, learnt = self._last_learnt
        if last_begin != begin:
            learnt = self._record_at(file, begin)["learnt"]
            self._last_learnt = (begin, learnt)
        return learnt

    def _record_at(self, file: BinaryIO, begin: int) -> StepRecord:
        """Return the record of the line that begins at a byte of the journal.

        It contains what was learnt only if its line or the files of recent parts do.
        """
        record, _, _ = next(records_in_file(file, self._path, begin, self._recent))
        return record

    def observations_in(self, records: Sequence[StepRecord]) -> Float:
        """Return the readings of G sensors in n steps, (n, G), SI; a lost reading is NaN."""
        count = self.scenario.observation.count
        return np.array([array_from_json(record["observed"][:count]) for record in records])

    def true_states_in(self, records: Sequence[StepRecord]) -> Float:
        """Return the true values of K state factors in n steps, (n, K), SI; NaN if unknown."""
        unknown_values = [None] * len(self.scenario.state)
        return np.array(
            [array_from_json(record.get("state", unknown_values)) for record in records]
        )

    def beliefs_in(self, records: Sequence[StepRecord]) -> StepBeliefs:
        """Return the beliefs of the twin in n steps, each at the time of the step."""
        beliefs_of_groups = []
        # Groups of successive steps with the same knowledge
        for _, records_of_group in groupby(records, lambda record: id(self._knowledge_in(record))):
            same_knowledge_records = list(records_of_group)
            beliefs_of_groups.append(
                self._beliefs_under(
                    self._knowledge_in(same_knowledge_records[0]), same_knowledge_records
                )
            )
        return StepBeliefs(
            probability=np.concatenate([beliefs.probability for beliefs in beliefs_of_groups]),
            is_believed=np.concatenate([beliefs.is_believed for beliefs in beliefs_of_groups]),
            expected=concatenate_expectations(beliefs.expected for beliefs in beliefs_of_groups),
            control_probability=np.concatenate(
                [beliefs.control_probability for beliefs in beliefs_of_groups]
            ),
        )

    def _beliefs_under(self, knowledge: Knowledge, records: Sequence[StepRecord]) -> StepBeliefs:
        """Return the beliefs of the twin in n steps that share the same knowledge."""
        filtered_beliefs = np.array([record["filtered"] for record in records])
        controls = [record["control_index"] for record in records]
        joint = known_control(
            filtered_beliefs, controls, len(knowledge.model.controls)
        )  # (n, S, U)
        if knowledge.expectation is None:
            observed_rows = np.array([array_from_json(record["observed"]) for record in records])
            expectation = _expectation_without_learning(knowledge, joint, observed_rows)
        else:
            expectation = self._expectation_with_learning(knowledge.expectation, joint, records)
        return StepBeliefs(
            probability=filtered_beliefs,
            is_believed=np.array(
                [is_state_believed(unexplained_probability(record)) for record in records]
            ),
            expected=expectation,
            control_probability=np.array([record["decision_probability"] for record in records]),
        )

    def _expectation_with_learning(
        self, expectation: LearntExpectation, joint: Float, records: Sequence[StepRecord]
    ) -> Expectation:
        """Return the sensor values and rewards that a learning twin expected in each of n steps.

        Parameters
        ----------
        joint : (n, S, U) array
            The beliefs over states and controls.
        """
        expectations = []
        observations = self.observations_in(records)
        for record, joint_of_step, observed_row in zip(records, joint, observations, strict=True):
            # Only the control in force has a probability that is not zero
            control = slice(record["control_index"], record["control_index"] + 1)
            learnt = _learnt_quantities(record)
            belief = joint_of_step[None, :, control]  # (1, S, 1)
            expectations.append(expectation.from_marginals(learnt, belief, control, observed_row))
        return concatenate_expectations(expectations)

    def prediction_after(self, record: StepRecord) -> StepBeliefs:
        """Return the predictions of the twin for the n steps after one step.

        n is the number of steps that the scenario predicts (`mission.prediction_steps`).
        """
        knowledge = self._knowledge_in(record)
        filtered_belief = array_from_json(record["filtered"])
        control = record["control_index"]
        horizon = self.scenario.mission.prediction_steps
        predicted_beliefs = predict(
            knowledge.model, filtered_belief, control, knowledge.plan.policy, horizon
        ).predicted
        unexplained = unexplained_probability(record)
        # p(state, control) = p(state) p(control | state), for n steps, S states, U controls
        joint = predicted_beliefs[..., None] * knowledge.policy_with_safest_control(
            unexplained
        )  # (n, S, U)
        if knowledge.expectation is None:
            expectation = _expectation_without_learning(knowledge, joint, None)
        else:
            all_controls = slice(None)
            expectation = knowledge.expectation.from_marginals(
                _learnt_quantities(record), joint, all_controls, None
            )
        return StepBeliefs(
            probability=predicted_beliefs,
            is_believed=np.full(len(predicted_beliefs), is_state_believed(unexplained)),
            expected=expectation,
            control_probability=joint.sum(axis=-2),
        )


def _expectation_without_learning(
    knowledge: Knowledge, joint: Float, rows: Float | None
) -> Expectation:
    """Return the sensors and rewards that a twin expects under beliefs if it learns nothing.

    Parameters
    ----------
    joint : (n, S, U) array
        The beliefs over states and controls.
    rows : (n, G + I) array or None
        The readings of G sensors and of I inspections, SI; None for steps to come.
    """
    return expectation_of_draws(
        knowledge.sensor_model, knowledge.rewards, joint, rows, quantiles=False
    )


def _learnt_quantities(record: StepRecord) -> dict[str, Learnt]:
    """Return the posterior of each quantity that the twin had learnt by a step."""
    return {name: Learnt(**learnt) for name, learnt in record.get("learnt", {}).items()}


def is_prepared(folder: Path) -> bool:
    """Return whether a run folder is complete up to the first step, so that it can be viewed."""
    return (folder / KNOWLEDGE_NAME).is_file()
