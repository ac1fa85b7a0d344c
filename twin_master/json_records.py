"""The JSON records that runs and watches write, key by key, for their schemas and pages.

A key with `NotRequired` is left out of a record in which it would be empty.
"""

from typing import Annotated, NotRequired

from pydantic import Field
from typing_extensions import TypedDict

WholeNumberInQuotes = Annotated[str, Field(pattern=r"^[0-9]+(\.0*)?$")]


class NoticeRecord(TypedDict):
    """A notice to the operator."""

    kind: str
    """The kind of notice, such as "alarm" or "gauge_left_out"."""
    sensors: list[int]
    """The sensors that the notice concerns, numbered from 1."""
    value: float | None
    """The number on which the notice is based; null if there is none [SI]."""
    sentence: str
    """The notice in words."""
    since: int | None
    """The step in which the fault probably began; null if it is not known."""


class LearntRecord(TypedDict):
    """Posterior of a quantity that does not change in time."""

    mean: float
    """Mean [unit of the entry]."""
    standard_deviation: float
    """Standard deviation [unit of the entry]."""
    lower: float
    """Lower end of the central 90 % interval [unit of the entry]."""
    upper: float
    """Upper end of the central 90 % interval [unit of the entry]."""
    unit: str
    """Unit of the numbers."""


class FactorRecord(TypedDict):
    """The belief about one factor of the state."""

    mean: float | None
    """Mean; null if no state is believed [unit of the entry]."""
    standard_deviation: float | None
    """Standard deviation; null if no state is believed [unit of the entry]."""
    unit: str
    """Unit of the numbers; "1" for a fraction."""


class DecisionRecord(TypedDict):
    """A decision, as a watch prints and publishes it."""

    step: int
    """The step that was observed; -1 before the first one."""
    control: NotRequired[str]
    """The control that was in force in the step."""
    state_believed: NotRequired[bool]
    """Whether a state of the model explains the sensors."""
    health: NotRequired[dict[str, FactorRecord]]
    """The belief about each factor of the state, by its name."""
    next_control: NotRequired[str]
    """The control that the twin proposes for the next step."""
    probability: NotRequired[float]
    """Probability of the proposed control [1]."""
    lost_sensors: NotRequired[int]
    """Number of sensors without a reading."""
    log_evidence: NotRequired[float]
    """Logarithm of the probability density of the observation given the earlier ones [nat]."""
    notices: list[NoticeRecord]
    """The notices to the operator."""
    none_of_these: NotRequired[float]
    """Probability that no state explains the sensors; only if the twin gives notices [1]."""
    hypotheses: NotRequired[dict[str, float]]
    """Probability of each hypothesis by its name; only if the twin gives notices [1]."""
    decided_by: NotRequired[str]
    """The hypothesis that decided; only if the twin gives notices."""
    learnt: NotRequired[dict[str, LearntRecord]]
    """The quantities learnt so far, by name; only if the twin learns."""
    revised_by_step: NotRequired[int]
    """The step whose late message changed the decision."""
    message_step: NotRequired[int]
    """The number of the step in the messages, if that differs from `step`."""
    told_again: NotRequired[bool]
    """Whether the decision may have been sent before."""
    asset: NotRequired[str]
    """Name of the asset; only of a fleet."""


class ObservationMessage(TypedDict):
    """A message of a publisher to a watch.

    Every other key is a sensor, `ROLE_NUMBER` or its title, an inspection, `ACTION_STATE`, or the
    role with a list of all sensors. A key may end with its unit: `strain_7_microstrain`. Keys that
    begin with `_` are ignored.
    """

    step: NotRequired[int | WholeNumberInQuotes]
    """Whole number of the step, also in quotes; counting begins with that of the first message.
    Without `step` and `time` the message is the next step.
    """
    time: NotRequired[float | str]
    """Time of the step, in place of `step`: a number in the unit of `watch.time_unit`, also in
    quotes, or a date and time by ISO 8601, which is in UTC if it has no offset
    [unit of `watch.time_unit`].
    """
    control: NotRequired[str]
    """The control in force; by default the proposed one."""
    unit: NotRequired[str]
    """Unit of the list of all sensors."""
    covariance: NotRequired[list[list[float]]]
    """Covariance of identified features of modes, row by row [SI]."""


class HeartbeatRecord(TypedDict):
    """The state of a watch, which it publishes every 10 s."""

    state: str
    """The words "watching", "quiet" (no step was received for too long), "ended" or "lost" (an
    error).
    """
    step: NotRequired[int]
    """The last step; of a single asset."""
    seconds_since_step: NotRequired[float]
    """Time since the last step; of a single asset [s]."""
    lag: int
    """Number of messages that were received but not processed yet."""
    received: NotRequired[int]
    """Number of messages that were received; of a single asset."""
    refused: int
    """Number of messages that were refused."""
    busy: NotRequired[float]
    """Fraction of the time since the last heartbeat in which messages were processed [1]."""
    keeps_up: NotRequired[bool]
    """Whether, at some time since the last heartbeat, no message waited to be processed."""
    assets: NotRequired[int]
    """Number of assets; of a fleet."""
    steps: NotRequired[int]
    """Number of steps of all assets; of a fleet."""
    quiet: NotRequired[int]
    """Number of assets that have sent no step for too long; of a fleet."""


class RejectedRecord(TypedDict):
    """A message that was refused, a line of `rejected.jsonl`."""

    message: int
    """Number of the message among those of the watch, from 1."""
    reason: str
    """The reason of the refusal."""
    text: str
    """The first 200 characters of the message."""


class SuspicionRecord(TypedDict):
    """How well the model explains the sensors up to a step."""

    none_of_these: float
    """Posterior probability that no state of the model explains the sensors [1]."""
    gauge_off: float
    """Posterior probability that a single sensor is off [1]."""
    log_evidence_none: float
    """Log e-value that no state explains the sensors [nat]."""
    log_evidence_any_gauge: float
    """Log e-value that a single sensor is off [nat]."""
    log_evidence_gauge: list[float]
    """Log e-value of each sensor [nat]."""
    left_out: list[bool]
    """Whether the readings of each sensor are left out: absurd, or stuck."""
    hypotheses: dict[str, float]
    """Probability of each hypothesis by its name [1]."""
    decided_by: str
    """The hypothesis that adds most to the probability of the chosen control."""


class PackedLearntRecord(TypedDict):
    """The quantities learnt so far."""

    names: list[str]
    """Names of the quantities."""
    units: list[str]
    """Unit of each quantity."""
    figures: str
    """`mean`, `standard_deviation`, `lower` and `upper` of the first quantity, then of the second,
    and so on; doubles in base 64 [unit of the entry].
    """


class PackedSuspicionRecord(TypedDict):
    """How well the model explains the sensors up to a step, in a line of the journal.

    The files of recent parts have all entries of a suspicion for the last steps.
    """

    hypotheses: dict[str, float]
    """Probability of each hypothesis by its name [1]."""
    decided_by: NotRequired[str]
    """The hypothesis that adds most to the probability of the chosen control."""
    none_of_these: NotRequired[float]
    """Posterior probability that no state of the model explains the sensors, if it is not that of
    the hypothesis "none of these" [1].
    """
    log_evidence_none: NotRequired[float]
    """Log e-value that no state explains the sensors; only in a watch, after an alarm [nat]."""
    log_evidence_any_gauge: NotRequired[float]
    """Log e-value that a single sensor is off; only in a watch, after an alarm [nat]."""


class JournalRecord(TypedDict):
    """A line of `journal.jsonl` after its hash.

    The first line has the hash of the configuration and the format alone. A line with `quiet`,
    `refused`, `verdict` or `model` is an event between two steps. Numbers in base 64 are doubles of
    8 bytes, little-endian; a lost sensor is NaN. Probabilities have 10 decimals. In journals of
    earlier versions, without `format`, each line has all entries, and numbers are JSON lists.
    """

    config_hash: NotRequired[str]
    """SHA-256 of `config.json`; only in the first line."""
    format: NotRequired[int]
    """Version of the format, 2; only in the first line."""
    step: NotRequired[int]
    """Number of the step, from 0; for an event, the number of the last step before it."""
    observed: NotRequired[str]
    """Readings of the sensors and, after them, of inspections, in base 64 [SI]."""
    control_index: NotRequired[int]
    """Index of the control in force, from 0."""
    next_control: NotRequired[int]
    """Index of the proposed control, from 0."""
    decision_probability: NotRequired[list[float]]
    """Probability of each control in the decision [1]."""
    filtered: NotRequired[dict[str, float] | str]
    """Belief over all joint states after the step: the probabilities that are not zero, by the
    index of the state, and `of`, the number of states; or all in base 64, if that is shorter [1].
    """
    log_evidence: NotRequired[float]
    """Logarithm of the probability density of the observation given the earlier ones [nat]."""
    state: NotRequired[list[float | None]]
    """True value of each factor of the state, of a simulated asset [SI]."""
    observation_difference: NotRequired[list[int]]
    """True values at the sensors without noise, of a simulated asset: their difference to the
    readings minus noise and drift of the simulation, in units in the last place. `run.nc` has the
    values.
    """
    observation: NotRequired[str]
    """True values at the sensors without noise, in base 64, if that is shorter [SI]."""
    monitors: NotRequired[dict[str, float | None]]
    """Further quantities that a simulated asset reports, by name [unit of the binding]."""
    asset_state: NotRequired[str]
    """State of the asset after the step, compressed and in base 64; only in every 64th step."""
    learnt: NotRequired[PackedLearntRecord]
    """The quantities learnt so far; only in the steps 1, 4, 16 and every 64th step."""
    notices: NotRequired[list[NoticeRecord]]
    """The notices to the operator."""
    suspicion: NotRequired[PackedSuspicionRecord]
    """How well the model explains the sensors."""
    observation_step: NotRequired[int]
    """The step that the message belongs to, if it is not `step`; only in a watch."""
    control_in_force: NotRequired[int]
    """Index of the control of the last step, if a late message changed an earlier step; only in a
    watch.
    """
    intake: NotRequired[dict[str, object]]
    """The position in the stream of messages from which the watch resumes; only in a watch."""
    settled: NotRequired[dict[str, object]]
    """The state of the twin before all steps that a late message can still change; only in a
    watch, in every 2048th step.
    """
    begin: NotRequired[int]
    """Position of the line in the file, if it has no `standing`; only in a watch [bytes]."""
    standing: NotRequired[dict[str, object]]
    """Position of the line in the file, and the state of the search for causes before the line;
    only in a watch, in the steps with `learnt` and in events.
    """
    quiet: NotRequired[DecisionRecord]
    """The decision that was written again because no step came; only in a watch."""
    refused: NotRequired[DecisionRecord]
    """The decision that was written again because messages were refused; only in a watch."""
    verdict: NotRequired[dict[str, object]]
    """The verdict of a search for the cause of an alarm; only in a watch."""
    model: NotRequired[dict[str, object]]
    """The patched model that was adopted; only in a watch."""


class RecentRecord(TypedDict):
    """A line of `recent_0.jsonl` or `recent_1.jsonl` after its hash.

    It contains the entries that a line of the journal leaves out. They depend on the twin.
    """

    line: str
    """SHA-256 with which the line of the journal begins."""
    step: int
    """Number of the step."""
    asset_state: NotRequired[str]
    """State of the asset after the step, compressed and in base 64, from which a run resumes."""
    learnt: NotRequired[dict[str, LearntRecord]]
    """The quantities learnt so far, by name."""
    settled: NotRequired[dict[str, object]]
    """The state of the twin before all steps that a late message can still change; only in a
    watch, in every 32nd step.
    """
    suspicion: NotRequired[SuspicionRecord]
    """How well the model explains the sensors."""


class FigureRecord(TypedDict):
    """A result of a mission, with its reference."""

    key: str
    """Name of the result for programs."""
    title: str
    """Name of the result for people."""
    value: float | str | None
    """The result; null if the mission gave none [unit of the entry]."""
    unit: str
    """Unit of `value` and `reference`, as printed."""
    reference: float | str | None
    """The value that the scenario states to compare with [unit of the entry]."""
    reference_source: str
    """Source of the reference."""


class SummaryNotice(NoticeRecord):
    """A notice of a mission, with its step."""

    step: int
    """The step of the notice."""


class LearntSummary(TypedDict):
    """The posterior of a learnt quantity; lists have an entry for each sensor."""

    title: str
    """The quantity in words."""
    unit: str | list[str]
    """Unit of the numbers."""
    prior: dict[str, object]
    """`mean`, `standard_deviation`, `lower` and `upper` before the first step."""
    posterior: dict[str, object]
    """`mean`, `standard_deviation`, `lower` and `upper` after the last step."""
    truth: object
    """True value; null if it is not known."""


class SummaryRecord(TypedDict):
    """The content of `summary.json`."""

    scenario: str
    """Name of the scenario."""
    title: str
    """Title of the scenario."""
    seed: int
    """Seed of the mission."""
    steps: int
    """Number of steps that were flown."""
    control: str
    """The changes of the control, in words."""
    asset: str
    """The asset that flew, in words."""
    twin_model: str
    """The model that the twin believed, in words."""
    asset_and_model_differ: bool
    """Whether the asset is known to differ from the model that the twin believed."""
    figures: list[FigureRecord]
    """The results of the mission."""
    learnt: NotRequired[dict[str, LearntSummary]]
    """The learnt quantities by name; only if the twin learns."""
    notices: NotRequired[list[SummaryNotice]]
    """The notices that the operator received."""


class FileHash(TypedDict):
    """A file by its name and hash."""

    name: str
    """Name of the file."""
    sha256: str
    """SHA-256 of the file's bytes."""


class ProvenanceRecord(TypedDict):
    """The program and the inputs that made the results."""

    seed: int
    """Seed of all random numbers."""
    versions: dict[str, str]
    """Version of each package that was used, by its name."""
    source_hashes: dict[str, str]
    """SHA-256 of the source code of each package of this program, by its name."""
    input_hashes: dict[str, str]
    """SHA-256 of each input, by its name."""
    plug_ins: NotRequired[dict[str, str]]
    """Distribution and version of each installed plug-in, by the group and the name of its entry
    point, such as `uav_twin.laws: my_law`; runs of earlier versions have none."""


class ConfigRecord(TypedDict):
    """The content of `config.json` of a run, a watch or a fleet."""

    format: int
    """Version of the format."""
    kind: str
    """The words "uav-twin run" for a run or a watch, "uav-twin fleet" for a fleet."""
    provenance: ProvenanceRecord
    """The program and the inputs that made the results."""
    scenario: NotRequired[dict[str, object]]
    """The resolved scenario of a run, in SI; its keys are those of a scenario file."""
    scenario_file: NotRequired[FileHash]
    """The file of the scenario of a run."""
    inputs: NotRequired[dict[str, str]]
    """SHA-256 of the files in `asset/` of a run, by their names; once they are prepared."""
    watched: NotRequired[bool]
    """Whether a real asset is watched."""
    fleet: NotRequired[dict[str, object]]
    """The plan of a fleet, with the scenarios, members and seeds of its groups."""


class PartSeconds(TypedDict):
    """Wall-clock times of one part of a step."""

    total: float
    """Sum over all steps [s]."""
    median: float
    """Median over the steps [s]."""
    largest: float
    """Longest step [s]."""
    last: float
    """Last step [s]."""


class TimingRecord(TypedDict):
    """The content of `timing.json`: wall-clock times of the last process of a run."""

    resumed_at: int
    """The first step that the process flew."""
    steps: int
    """Number of steps that the process flew."""
    asset_seconds: NotRequired[PartSeconds]
    """Times of the asset."""
    twin_seconds: NotRequired[PartSeconds]
    """Times of the twin."""
    checkpoint_seconds: NotRequired[PartSeconds]
    """Times of writing the journal."""
    stages_seconds: dict[str, float]
    """Time of each stage of the run, by its name [s]."""
    total_seconds: float
    """Time of the whole run [s]."""
