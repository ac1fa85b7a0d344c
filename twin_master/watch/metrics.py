"""Metrics of watches for a monitoring system, served over HTTP in Prometheus' text format."""

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import NamedTuple

from prometheus_client import CollectorRegistry, generate_latest, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

from twin_master.errors import MissionInputError
from twin_master.feeds.feed import Decision
from twin_master.mission.residuals import residual_summary
from twin_master.mission.steps import History
from twin_master.watch.folder import Watch

ALARM = "alarm"
"""The kind of notice that is counted from the beginning on, so that its counter is never absent."""
LOOPBACK = "127.0.0.1"
"""The address that is served where the user names none: that of this machine alone."""
_ADDRESS = re.compile(r"(?:(\[[\w.:]+\]|[\w.-]+):)?(\d{1,5})")
_LARGEST_PORT = 65_535


class Sample(NamedTuple):
    """A value of a metric.

    Attributes
    ----------
    name : str
        The name of the metric, without the prefix `uav_twin_`.
    meaning : str
        The meaning of the metric, with the unit.
    labels : dict of str to str
        Labels that distinguish the value from others of the metric.
    is_counter : bool
        Whether the metric is a counter, which only rises while a process lives; else a gauge.
    """

    name: str
    meaning: str
    value: float
    labels: Mapping[str, str] = {}
    is_counter: bool = False


class WatchMetrics:
    """The metrics of a watch: its last decision, its notices, and its message counts.

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
        """Record a new decision, and count its notices."""
        self._decision = decision
        # A new counter, because another thread may be reading the present one
        new_kinds = Counter(notice["kind"] for notice in decision.get("notices", ()))
        self._notice_counts = self._notice_counts + new_kinds
        self._notice_counts.setdefault(ALARM, 0)

    def samples(self) -> Iterator[Sample]:
        """Yield all metrics; none before the watch has begun to read messages."""
        if self.watch.has_begun:
            yield from self._decision_samples(self._decision)
            yield from self._message_samples()

    def _decision_samples(self, decision: Decision) -> Iterator[Sample]:
        """Yield the metrics of the last decision; none before the first one."""
        if "health" not in decision:
            return
        figures = {
            "step": (decision["step"], "Number of the last step."),
            "state_believed": (
                decision["state_believed"],
                "1 if a state explains the sensors, 0 if none does.",
            ),
            "next_control_probability": (
                decision["probability"],
                "Probability of the decided control.",
            ),
            "lost_sensors": (
                decision["lost_sensors"],
                "Number of sensors without a reading in the last step.",
            ),
            "log_evidence": (
                decision["log_evidence"],
                "Log evidence of the readings of the last step [nats].",
            ),
        }
        residual = self._rms_residual()
        if residual is not None:
            meaning = (
                "Root mean square residual of the last step [standard deviations of the noise]."
            )
            figures["residual_rms"] = (residual, meaning)
        for name, (value, meaning) in figures.items():
            yield Sample(name, meaning, value)
        for name, probability in decision.get("hypotheses", {}).items():
            meaning = "Probability of a hypothesis about sensors and model."
            yield Sample("hypothesis_probability", meaning, probability, {"hypothesis": name})
        yield from self._state_samples(decision)
        for name in self.watch.scenario.control_names:
            labels = {"control": name}
            meaning = "1 for the control in force, 0 for the others."
            yield Sample("control", meaning, name == decision["control"], labels)
            meaning = "1 for the control decided for the next step."
            yield Sample("next_control", meaning, name == decision["next_control"], labels)

    def _state_samples(self, decision: Decision) -> Iterator[Sample]:
        """Yield the belief about each state; NaN for a state that is not believed."""
        meanings = {
            "mean": "Believed mean of a state, in its unit.",
            "standard_deviation": "Standard deviation of the belief about a state, in its unit.",
        }
        for name, health in decision["health"].items():
            labels = {"state": name, "unit": health["unit"]}
            for moment, meaning in meanings.items():
                value = math.nan if health[moment] is None else health[moment]
                yield Sample(f"state_{moment}", meaning, value, labels)

    def _rms_residual(self) -> float | None:
        """Return the root mean square residual of the last step; None without a reading."""
        step = self.watch.last_step
        if step is None:
            return None
        history = History(self.watch.twin, self.watch.scenario.observation.count, [step])
        summary = residual_summary(history, step.twin_step.step, self.watch.models)
        residual: float | None = summary["rms_residual"]
        return residual

    def _message_samples(self) -> Iterator[Sample]:
        """Yield the counts of messages and notices, and the time since the last step."""
        counts = self.watch.intake.counts
        meanings = {
            "messages_received": (counts.received, "Messages that were read."),
            "messages_refused": (counts.rejected, "Messages that were refused."),
            "messages_late": (counts.late, "Messages that came late and were assimilated."),
            "messages_duplicate": (counts.duplicates, "Messages that added nothing to their step."),
        }
        for name, (count, meaning) in meanings.items():
            yield Sample(name, meaning, count, is_counter=True)
        yield Sample(
            "missing_steps",
            "Steps that were predicted through because no message came.",
            counts.missing,
        )
        for kind, count in self._notice_counts.items():
            labels = {"kind": kind}
            yield Sample("notices", "Notices to the operator.", count, labels, is_counter=True)
        yield Sample(
            "seconds_since_step", "Time since the last step [s].", self.watch.seconds_since_step
        )
        yield Sample(
            "messages_waiting",
            "Messages that a broker has sent and that wait to be processed.",
            self.watch.intake.waiting_messages,
        )


class MetricsServer:
    """Serves the metrics of watches, each from the time at which it is attached.

    Parameters
    ----------
    host : str
        The address or name of the interface to serve.
    port : int
        The port; 0 for any free one.

    Attributes
    ----------
    address : str
        The address of the page.

    Raises
    ------
    MissionInputError
        If nothing can be served there, for example because the port is taken.
    """

    def __init__(self, host: str, port: int) -> None:
        self._metrics_of_asset: dict[str, WatchMetrics] = {}
        self._collectors = CollectorRegistry()
        self._collectors.register(self)
        with MissionInputError.instead_of(
            OSError, before=f"the metrics cannot be served at {host}:{port}: ", after="."
        ):
            self._server, self._thread = start_http_server(port, host, self._collectors)
        self.address = f"http://{host}:{self._server.server_port}/metrics"

    def attach(self, asset: str, watch: Watch) -> WatchMetrics:
        """Serve the metrics of a watch from now on, and return them.

        Parameters
        ----------
        asset : str
            The name of the asset, a label of all its metrics.
        watch : Watch
            A watch that replaces another one of the asset starts its counters again.
        """
        metrics = self._metrics_of_asset.get(asset)
        if metrics is None or metrics.watch is not watch:
            metrics = WatchMetrics(watch)
            self._metrics_of_asset[asset] = metrics
        return metrics

    def collect(self) -> Iterable[CounterMetricFamily | GaugeMetricFamily]:
        """Return the metrics of all assets for the registry of Prometheus.

        The values of a metric stand together, for all assets. A metric without values is omitted.
        """
        families: dict[str, CounterMetricFamily | GaugeMetricFamily] = {}
        # A copy, because the thread of the watches may attach another one meanwhile
        for asset, metrics in self._metrics_of_asset.copy().items():
            for sample in metrics.samples():
                labels = {"asset": asset, **sample.labels}
                if sample.name not in families:
                    family = CounterMetricFamily if sample.is_counter else GaugeMetricFamily
                    families[sample.name] = family(
                        f"uav_twin_{sample.name}", sample.meaning, labels=list(labels)
                    )
                families[sample.name].add_metric(list(labels.values()), sample.value)
        return families.values()

    def text(self) -> str:
        """Return the metrics in the text format of Prometheus; empty before a watch is attached."""
        text: str = generate_latest(self._collectors).decode()
        return text

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


@contextmanager
def serve_metrics(address: str | int | None) -> Iterator[MetricsServer | None]:
    """Serve the metrics of watches within a context; None if no address is given.

    Parameters
    ----------
    address : str, int or None
        A port of this machine, or ``HOST:PORT``, where the host is the interface to serve.

    Raises
    ------
    MissionInputError
        If the address has another form, or cannot be served.
    """
    if address is None:
        yield None
        return
    match = _ADDRESS.fullmatch(str(address))
    if match is None or int(match[2]) > _LARGEST_PORT:
        raise MissionInputError(
            f"metrics are served at a port such as 9100, or at HOST:PORT, but {address} was given."
        )
    server = MetricsServer((match[1] or LOOPBACK).strip("[]"), int(match[2]))
    try:
        yield server
    finally:
        server.close()
