"""The command that watches a real asset: `uav-twin watch`."""

import json
import os
import shlex
import signal
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reporting import terminal
from twin_master.command import Calibration, Library, Seed
from twin_master.viewer.command import View, shown

if TYPE_CHECKING:
    from twin_master.assets.resolution import Overrides
    from twin_master.scenario.reading import LoadedScenario
    from twin_master.scenario.schema import Scenario
    from twin_master.watch.folder import Patched, Watch
    from twin_master.watch.intake import Counts, Feed

    Decide = Callable[[Mapping[str, Any]], bool]

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
    ca_file: Annotated[
        Path | None, typer.Option(help="Certificate of the authority of an mqtts:// broker.")
    ] = None,
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
    from twin_master.assets.resolution import Overrides
    from twin_master.store.outcome import REPORT_NAME
    from twin_master.watch.folder import Patched

    if (model_patch is None) != (from_turn is None) or (model_patch is not None and not resume):
        raise typer.BadParameter("--model-patch and --from-turn go together, with --resume.")
    loaded, observations = _asked(scenario, observations, follow, ca_file, teach)
    overrides = Overrides(seed=seed, calibration=calibration, library=library)
    with shown(view) as begun:
        watched, lock = _opened(loaded, observations, out, overrides, resume=resume, replace=replace)
        if begun is not None:
            begun(watched.folder)
        patched = None if model_patch is None or from_turn is None else Patched(model_patch, from_turn)
        try:
            source = observations or _recording(watched.scenario) or "-"
            feed = _feed(source, watched, follow, ca_file)
            counts = _watched(watched, feed, pace, turns, patched, teach)
            watched.store(counts, last=last, report=not no_report)
        except Exception as error:
            error.add_note(
                f"What was observed is kept: go on with `uav-twin watch --resume --out {watched.folder}`."
            )
            raise
        finally:
            os.close(lock)
        refused = f", {counts.rejected} messages refused (see rejected.jsonl)" if counts.rejected else ""
        typer.echo(f"Watch: {watched.folder}, {counts.received} messages{refused}.", err=True)
        if not no_report and counts.received:
            typer.echo(f"Report: {watched.folder / REPORT_NAME}", err=True)


def _recording(scenario: "Scenario") -> str | None:
    return None if scenario.watch.recording is None else str(scenario.watch.recording)


def _paced(decide: "Decide", seconds: float) -> "Decide":
    """Return what waits after each decision."""

    def waiting(decision: Mapping[str, Any]) -> bool:
        heard = decide(decision)
        time.sleep(seconds)
        return heard

    return waiting if seconds else decide


def _watched(
    watched: "Watch",
    fed: "tuple[Feed, Decide, Callable[[], None]]",
    pace: float,
    turns: int | None,
    patched: "Patched | None",
    teach: bool,
) -> "Counts":
    """Watch until the end, or until nobody reads the decisions, and end what the observations come from."""
    from twin_master.watch.teaching import Search

    feed, decide, close = fed
    decide = _paced(decide, pace)
    search = Search(watched.folder, watched.scenario.mission.seed) if teach else None

    def tell(decision: Mapping[str, Any]) -> None:
        if not decide(decision):
            signal.raise_signal(signal.SIGINT)  # which ends a watch in order

    try:
        untold = _untold(watched)
        if untold is not None:
            decide(untold)
        return watched.run(feed, tell, turns=turns, patched=patched, search=search)
    finally:
        close()


def _untold(watched: "Watch") -> dict[str, Any] | None:
    """Return the last decision, to be told again, where a kill may have left it untold."""
    from reporting.errors import DamagedFileError
    from reporting.json_file import read_json
    from twin_master.mission.journal import JOURNAL_NAME
    from twin_master.store.writing import SUMMARY_NAME
    from twin_master.watch.decision import last_decision

    model = watched.models[-1].knowledge.model
    last = last_decision(watched.folder / JOURNAL_NAME, watched.scenario, model)
    try:
        ended = read_json(watched.folder / SUMMARY_NAME, DamagedFileError)["steps"]
    except (DamagedFileError, KeyError, TypeError):
        return last
    return None if last is None or ended == last["turn"] + 1 else last


def _opened(
    loaded: "LoadedScenario | None", observations: str | None, out: Path | None, overrides: "Overrides", *,
    resume: bool, replace: bool,
) -> "tuple[Watch, int]":  # fmt: skip
    """Return the watch, begun or taken up, and what holds its folder."""
    from twin_master.assets.resolution import Overrides
    from twin_master.errors import MissionInputError
    from twin_master.watch.opening import begin_watch, resume_watch

    if resume and (replace or overrides != Overrides()):
        raise typer.BadParameter(
            "a watch is taken up with what its folder holds: give nothing that would change it.",
            param_hint="--resume",
        )
    progress = terminal.progress()
    if loaded is None:
        if out is None or not resume:
            raise typer.BadParameter("a scenario is needed, or --resume with --out.", param_hint="SCENARIO")
        return resume_watch(out, None, progress)
    folder = out or Path("runs") / loaded.scenario.mission.name
    if resume:
        return resume_watch(folder, loaded, progress)
    source = Path(observations or "-").resolve()
    if replace and folder.resolve() in (source, *source.parents):
        raise MissionInputError(
            f"--replace would remove the observations in {observations} before they are read: choose another "
            "--out."
        )
    return begin_watch(loaded, folder, overrides, progress, replace_run=replace)


def _asked(
    scenario: str | None, observations: str | None, follow: bool, ca_file: Path | None, teach: bool
) -> "tuple[LoadedScenario | None, str | None]":
    """Return the scenario, and where its observations come from, as far as either is said."""
    from twin_master.scenario.reading import load_scenario
    from twin_master.watch.teaching import check_teachable

    loaded = None if scenario is None else load_scenario(scenario)
    if teach and loaded is not None:
        check_teachable(loaded.scenario)
    if observations is None and loaded is not None:
        observations = _recording(loaded.scenario.moved(loaded.path.parent))
    if observations is not None:
        _check_source(observations, None if loaded is None else loaded.scenario, follow, ca_file)
    return loaded, observations


def _check_source(observations: str, scenario: "Scenario | None", follow: bool, ca_file: Path | None) -> None:
    """Find slips of the pen before a model is built and a folder made."""
    from twin_master.errors import MissionInputError
    from twin_master.watch.feeds import check_file, file_feed
    from twin_master.watch.mqtt import broker_of, is_broker

    if is_broker(observations):
        broker_of(observations, ca_file)
    elif observations != "-" and scenario is not None:
        file_feed(Path(observations), scenario, follow=follow)
    elif observations != "-":
        check_file(Path(observations), follow=follow)
    elif follow:
        raise MissionInputError("--follow belongs to a CSV file; standard input is read to its end anyway.")


def _feed(
    observations: str, watched: "Watch", follow: bool, ca_file: Path | None
) -> "tuple[Feed, Decide, Callable[[], None]]":
    """Return where observations come from, who is told the decisions, and what ends both."""
    from twin_master.watch.feeds import JsonLinesFeed, file_feed
    from twin_master.watch.mqtt import MqttFeed, broker_of, is_broker

    scenario = watched.scenario
    if is_broker(observations):
        broker = broker_of(observations, ca_file)
        mqtt = MqttFeed(broker, scenario, watched.folder, lambda text: typer.echo(text, err=True))

        def publish(decision: Mapping[str, Any]) -> bool:
            _say(watched, decision, flush=True)
            mqtt.decide(decision)
            return True

        return mqtt, publish, mqtt.close
    if observations == "-":
        return JsonLinesFeed(scenario), lambda decision: _say(watched, decision, flush=True), lambda: None
    feed = file_feed(Path(observations), scenario, follow=follow)
    return feed, lambda decision: _say(watched, decision, flush=follow), _flush


def _say(watched: "Watch", decision: Mapping[str, Any], *, flush: bool) -> bool:
    """Print a decision; return whether anybody reads it."""
    for notice in decision["notices"]:  # also where the decisions go to a program
        sentence = notice["sentence"].replace(" DIR", f" {shlex.quote(str(watched.folder))}")
        typer.secho(sentence, fg="yellow", err=True)
    if terminal.loudness.quiet:
        return True
    people = sys.stdout.isatty()
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


def _flush() -> None:
    _write("", flush=True)


def _line(scenario: "Scenario", decision: Mapping[str, Any]) -> str:
    """Return a decision for people: a line of a terminal."""
    from twin_master.report.view import printed_state

    health = []
    for name, known in decision["health"].items():
        scale, unit = printed_state(known["unit"])
        digits = ".0f" if unit == "%" else ".3g"
        mean, deviation = (f"{scale * known[moment]:{digits}}" for moment in ("mean", "standard_deviation"))
        health.append(f"{name} {mean} ± {deviation} {unit}")
    line = (
        f"{scenario.mission.step_name} {decision['turn']}: {decision['control']}, {', '.join(health)}; "
        f"next {decision['next_control']} with probability {decision['probability']:.3f}"
    )
    chosen = decision.get("decided_by", "model")
    return line if chosen == "model" else f"{line}; by {chosen} ({decision['hypotheses'][chosen]:.2f})"
