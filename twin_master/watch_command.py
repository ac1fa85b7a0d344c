"""The command that watches a real asset: `uav-twin watch`."""

import json
import os
import shlex
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reporting import terminal
from twin_master.command import Calibration, Library, Seed
from twin_master.viewer.command import View, shown

if TYPE_CHECKING:
    from twin_master.scenario.schema import Scenario
    from twin_master.watch.folder import Watch

Observations = Annotated[
    str | None,
    typer.Option(
        metavar="SOURCE",
        help="A CSV or NetCDF file, the folder of a run or watch, `-` for JSON lines on standard input, or "
        "mqtt://[USER@]HOST[:PORT]/TOPIC (mqtts:// with TLS).",
        show_default="the recording of the scenario, else -",
    ),
]

Pace = Annotated[
    float,
    typer.Option(min=0.0, max=3600.0, help="Seconds to wait after each turn, to look at a recording."),
]
Teach = Annotated[
    bool, typer.Option("--teach", help="Look for the cause of an alarm, and believe what is named.")
]
Unknown = Annotated[
    bool, typer.Option("--allow-unknown", help="Pass over keys and columns that are no sensor.")
]
Authority = Annotated[Path | None, typer.Option(help="Certificate of the authority of an mqtts:// broker.")]


def watch(
    scenario: Annotated[
        str | None,
        typer.Argument(metavar="[SCENARIO]", help="A shipped scenario, or the path of a TOML file."),
    ] = None,
    observations: Observations = None,
    out: Annotated[
        Path | None, typer.Option(help="The folder of the watch.", show_default="runs/SCENARIO")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Take up the watch in --out.")] = False,
    replace: Annotated[bool, typer.Option("--replace", help="Replace the folder if it exists.")] = False,
    follow: Annotated[bool, typer.Option("--follow", help="Wait at the end of a CSV file for more.")] = False,
    pace: Pace = 0.0,
    turns: Annotated[int | None, typer.Option(min=0, help="End after so many turns in all.")] = None,
    model_patch: Annotated[
        Path | None,
        typer.Option(help="Believe this patch (`patch.json` of `discrepancy run`) from --from-turn on."),
    ] = None,
    from_turn: Annotated[
        int | None, typer.Option(min=0, help="The first turn that --model-patch is believed in.")
    ] = None,
    teach: Teach = False,
    allow_unknown: Unknown = False,
    ca_file: Authority = None,
    seed: Seed = None,
    calibration: Calibration = None,
    library: Library = None,
    last: Annotated[int, typer.Option(min=1, help="Turns, the last ones, in run.nc and report.")] = 1000,
    view: View = False,
    no_report: terminal.NoReport = False,
) -> None:
    """Watch a real asset: observations in, a decision for each turn out, as a line of JSON.

    The same scenario as for a simulated mission; its tables `asset` and `truth` are not needed. Everything is
    kept in the folder after every turn. Ctrl-C ends a watch in order; --resume takes it up again.
    """
    from twin_master.store.writing import REPORT_NAME
    from twin_master.watch import opening as from_python
    from twin_master.watch.broker import is_broker
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
        counts = watches[0].keep.intake.counts
        refused = f", {counts.rejected} messages refused (see rejected.jsonl)" if counts.rejected else ""
        typer.echo(f"Watch: {folder}, {counts.received} messages{refused}.", err=True)
        if not no_report and counts.received:
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
    from twin_master.mission.replay import health_in_words

    health = ", ".join(f"{name} {said}" for name, said in health_in_words(decision).items())
    line = (
        f"{scenario.mission.step_name} {decision['turn']}: {decision['control']}, {health}; "
        f"next {decision['next_control']} with probability {decision['probability']:.3f}"
    )
    chosen = decision.get("decided_by", "model")
    return line if chosen == "model" else f"{line}; by {chosen} ({decision['hypotheses'][chosen]:.2f})"
