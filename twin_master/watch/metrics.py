"""Figures of a watch for a monitoring system, in the text format of Prometheus."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Literal

from twin_master.mission.residuals import residual_summary
from twin_master.mission.steps import History
from twin_master.watch.folder import Watch
from twin_master.watch.records import Decision

_PREFIX = "uav_twin_"
ALARM = "alarm"
"""The kind of notice that is counted from the beginning on, so that its counter is never absent."""


@dataclass(frozen=True)
class Sample:
    """A value of a metric.

    Attributes
    ----------
    value : float
        The value.
    labels : dict of str to str
        What distinguishes it from other values of the metric.
    """

    value: float
    labels: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Metric:
    """A figure with all its values.

    Attributes
    ----------
    name : str
        The name, without the prefix `uav_twin_`.
    kind : str
        "gauge" if it rises and falls; "counter" if it only rises while a process lives.
    meaning : str
        The meaning, with the unit.
    samples : list of Sample
        The values; a figure without any is left out.
    """

    name: str
    kind: Literal["gauge", "counter"]
    meaning: str
    samples: list[Sample]


class WatchMetrics:
    """The figures of a watch: its last decision, its notices, and the counts of its messages.

    Parameters
    ----------
    watch : Watch
        The watch, which runs in another thread; it is only read.

    Attributes
    ----------
    watch : Watch
        The watch.
    """

    def __init__(self, watch: Watch) -> None:
        self.watch = watch
        self._decision: Decision = {}
        self._notice_counts = Counter({ALARM: 0})

    def note_decision(self, decision: Decision) -> None:
        """Take a new decision, and count its notices."""
        self._decision = decision
        # A new counter, because another thread may be reading the present one
        new_kinds = Counter(notice["kind"] for notice in decision.get("notices", ()))
        self._notice_counts = self._notice_counts + new_kinds
        self._notice_counts.setdefault(ALARM, 0)

    def metrics(self) -> list[Metric]:
        """Return all figures; none before the watch has begun to read messages."""
        if not self.watch.has_begun:
            return []
        return [*self._decision_metrics(self._decision), *self._message_metrics()]

    def _decision_metrics(self, decision: Decision) -> Iterator[Metric]:
        """Yield the figures of the last decision; none before the first one."""
        if "health" not in decision:
            return
        yield Metric("step", "gauge", "Number of the last step.", [Sample(decision["step"])])
        yield self._belief_metric("mean", "Believed mean of a state, in its unit.")
        yield self._belief_metric(
            "standard_deviation", "Standard deviation of the belief about a state, in its unit."
        )
        yield Metric(
            "state_believed",
            "gauge",
            "1 if a state explains the sensors, 0 if none does.",
            [Sample(float(decision["state_believed"]))],
        )
        yield self._control_metric("control", "1 for the control in force, 0 for the others.")
        yield self._control_metric("next_control", "1 for the control decided for the next step.")
        yield Metric(
            "next_control_probability",
            "gauge",
            "Probability of the decided control.",
            [Sample(decision["probability"])],
        )
        yield Metric(
            "lost_sensors",
            "gauge",
            "Number of sensors without a reading in the last step.",
            [Sample(decision["lost_sensors"])],
        )
        yield Metric(
            "log_evidence",
            "gauge",
            "Log evidence of the readings of the last step [nats].",
            [Sample(decision["log_evidence"])],
        )
        hypotheses = decision.get("hypotheses", {})
        yield Metric(
            "hypothesis_probability",
            "gauge",
            "Probability of a hypothesis about sensors and model.",
            [Sample(value, {"hypothesis": name}) for name, value in hypotheses.items()],
        )
        yield Metric(
            "residual_rms",
            "gauge",
            "Root mean square residual of the last step [standard deviations of the noise].",
            self._residual_samples(),
        )

    def _belief_metric(self, moment: str, meaning: str) -> Metric:
        """Return mean or standard deviation of each state; NaN for a state that is not believed."""
        samples = []
        for name, health in self._decision["health"].items():
            value = math.nan if health[moment] is None else health[moment]
            samples.append(Sample(value, {"state": name, "unit": health["unit"]}))
        return Metric(f"state_{moment}", "gauge", meaning, samples)

    def _control_metric(self, key: str, meaning: str) -> Metric:
        """Return which control stands under a key of the decision, as 1, and 0 for the others."""
        samples = []
        for name in self.watch.scenario.control_names:
            samples.append(Sample(float(name == self._decision[key]), {"control": name}))
        return Metric(key, "gauge", meaning, samples)

    def _residual_samples(self) -> list[Sample]:
        """Return the residual of the last step; nothing if it has no reading."""
        step = self.watch.last_step
        if step is None:
            return []
        history = History(self.watch.twin, self.watch.scenario.observation.count, [step])
        summary = residual_summary(history, step.twin_step.step, self.watch.models)
        residual = summary["rms_residual"]
        return [] if residual is None else [Sample(residual)]

    def _message_metrics(self) -> Iterator[Metric]:
        """Yield the counts of messages and notices, and the times of the watch."""
        counts = self.watch.intake.counts
        meanings = {
            "messages_received": (counts.received, "Messages that were read."),
            "messages_refused": (counts.rejected, "Messages that were refused."),
            "messages_late": (counts.late, "Messages that came late and were assimilated."),
            "messages_duplicate": (counts.duplicates, "Messages that added nothing to their step."),
        }
        for name, (count, meaning) in meanings.items():
            yield Metric(f"{name}_total", "counter", meaning, [Sample(count)])
        yield Metric(
            "missing_steps",
            "gauge",
            "Steps that were predicted through because no message came.",
            [Sample(counts.missing)],
        )
        notices = [Sample(count, {"kind": kind}) for kind, count in self._notice_counts.items()]
        yield Metric("notices_total", "counter", "Notices to the operator.", notices)
        yield Metric(
            "seconds_since_step",
            "gauge",
            "Time since the last step [s].",
            [Sample(self.watch.seconds_since_step)],
        )
        yield Metric(
            "messages_waiting",
            "gauge",
            "Messages that a broker has sent and that wait to be processed.",
            [Sample(self.watch.intake.waiting_messages)],
        )


def exposition(metrics_of_asset: Mapping[str, Sequence[Metric]]) -> str:
    """Return metrics of assets in the text format of Prometheus, version 0.0.4.

    The values of a metric stand together, whatever asset they are of.

    Parameters
    ----------
    metrics_of_asset : dict of str to sequence of Metric
        The metrics of each asset, by its name, which becomes the label `asset`.
    """
    lines_of_metric: dict[str, list[str]] = {}
    for asset, metrics in metrics_of_asset.items():
        for metric in metrics:
            if metric.samples:
                lines = lines_of_metric.setdefault(metric.name, _heading_lines(metric))
                lines += [_sample_line(metric, sample, asset) for sample in metric.samples]
    all_lines = chain.from_iterable(lines_of_metric.values())
    return "".join(f"{line}\n" for line in all_lines)


def _heading_lines(metric: Metric) -> list[str]:
    """Return the lines that say what a metric is."""
    name = _PREFIX + metric.name
    meaning = metric.meaning.replace("\\", r"\\").replace("\n", r"\n")
    return [f"# HELP {name} {meaning}", f"# TYPE {name} {metric.kind}"]


def _sample_line(metric: Metric, sample: Sample, asset: str) -> str:
    """Return the line of a value."""
    labels = {"asset": asset, **sample.labels}
    texts = [f'{label}="{_escape_label(value)}"' for label, value in labels.items()]
    return f"{_PREFIX}{metric.name}{{{','.join(texts)}}} {_number_text(sample.value)}"


def _escape_label(value: str) -> str:
    """Return the value of a label with backslashes before backslash, quote and line feed."""
    return value.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def _number_text(value: float) -> str:
    """Return a number as Prometheus writes it."""
    if math.isnan(value):
        return "NaN"
    if math.isinf(value):
        return "+Inf" if value > 0.0 else "-Inf"
    return repr(float(value))
