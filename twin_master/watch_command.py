"""The command that watches a real asset: `uav-twin watch`."""

import json
import os
import shlex
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from reporting import terminal
from twin_master.viewer.command import shown

if TYPE_CHECKING:
    from twin_master.scenario.schema import Scenario
    from twin_master.watch.folder import Watch


def watch(
    scenario: str | None = None,
    *,
    observations: str | None = None,
    out: Path | None = None,
    resume: bool = False,
    replace: bool = False,
    follow: bool = False,
    pace: float = 0.0,
    turns: int | None = None,
    model_patch: Path | None = None,
    from_turn: int | None = None,
    teach: bool = False,
    allow_unknown: bool = False,
    ca_file: Path | None = None,
    seed: int | None = None,
    calibration: Path | None = None,
    library: Path | None = None,
    last: int = 1000,
    view: bool = False,
    no_report: bool = False,
) -> None:
    """Watch a real asset: observations in, a decision for each turn out, as a line of JSON.

    The same scenario as for a simulated mission; its tables `asset` and `truth` are not needed. Everything is
    kept in the folder after every turn. Ctrl-C ends a watch in order; --resume takes it up again.
    """
    from twin_master.store.writing import REPORT_NAME
    from twin_master.watch import opening as from_python
    from twin_master.watch.feeds import is_broker
    from twin_master.watch.folder import Watch

    watches: list[Watch] = []
    live = follow or observations is None or observations == "-" or is_broker(observations)

    def decide(decision: Mapping[str, Any]) -> None:
        heard = _say(watches[0], decision, flush=live)
        time.sleep(pace)
        if not heard and not is_broker(observations or ""):
            signal.raise_signal(signal.SIGINT)  # which ends a watch in order

    with shown(view) as begun:

        def opened(watched: Watch) -> None:
            watches.append(watched)
            if begun is not None:
                begun(watched.folder)

        folder = from_python.watch(
            scenario, observations, out, {"seed": seed, "calibration": calibration, "library": library},
            decide=decide, resume=resume, follow=follow, turns=turns, model_patch=model_patch,
            from_turn=from_turn, teach=teach, allow_unknown=allow_unknown, ca_file=ca_file, replace=replace,
            last=last, report=not no_report, otherwise="-", begun=opened, progress=terminal.progress(),
        )  # fmt: skip
        _write("", flush=True)
        counts = watches[0].intake.counts
        refused = f", {counts.rejected} messages refused (see rejected.jsonl)" if counts.rejected else ""
        typer.echo(f"Watch: {folder}, {counts.received} messages{refused}.", err=True)
        if not no_report and (folder / REPORT_NAME).is_file():
            typer.echo(f"Report: {folder / REPORT_NAME}", err=True)


def _say(watched: "Watch", decision: Mapping[str, Any], *, flush: bool) -> bool:
    """Print a decision; return whether anybody reads it."""
    for notice in decision["notices"]:  # also where the decisions go to a program
        sentence = notice["sentence"].replace(" DIR", f" {shlex.quote(str(watched.folder))}")
        typer.secho(sentence, fg="yellow", err=True)
    if terminal.loudness.quiet:
        return True
    people = sys.stdout.isatty()
    if people and "control" not in decision:  # nothing was decided yet, and nothing comes
        return True
    line = _line(watched.scenario, decision) if people else json.dumps(decision)
    return _write(line + "\n", flush=flush or people)


def _write(text: str, *, flush: bool) -> bool:
    """Write to standard output; return whether it still leads anywhere."""
    try:
        sys.stdout.write(text)
        if flush:
            sys.stdout.flush()
    except BrokenPipeError:  # `watch | head`: what is left in the buffer goes nowhere, without a word
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return False
    return True


def _line(scenario: "Scenario", decision: Mapping[str, Any]) -> str:
    """Return a decision for people: a line of a terminal."""
    from twin_master.mission.loop import health_in_words

    health = ", ".join(f"{name} {said}" for name, said in health_in_words(decision).items())
    line = (
        f"{scenario.mission.step_name} {decision['turn']}: {decision['control']}, {health}; "
        f"next {decision['next_control']} with probability {decision['probability']:.3f}"
    )
    chosen = decision.get("decided_by", "model")
    return line if chosen == "model" else f"{line}; by {chosen} ({decision['hypotheses'][chosen]:.2f})"
