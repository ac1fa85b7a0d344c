"""Commands of one asset: `run`, which is `python -m twin_master`, too, `watch`, `view`, `scenario check`."""

import json
import os
import shlex
import signal
import sys
import time
import traceback
import webbrowser
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from reporting import terminal
from reporting.command_options import JsonOption, NoReportOption
from reporting.errors import ReportingError
from reporting.former_options import accepts_former_options, former_names_as_lines
from reporting.words import counted, number
from scenarios import scenario_files
from twin_master import parts
from twin_master.command_options import (
    CalibrationOption,
    CertificateOption,
    ClusterOption,
    LibraryOption,
    SeedOption,
    ViewOption,
    WorkersOption,
    complete_scenario,
)
from twin_master.errors import TwinMasterError, said
from twin_master.fleet_command import engine_of, fly_and_show, shown


def run(
    scenario: Annotated[
        str | None,
        typer.Argument(
            show_default=False,
            metavar="SCENARIO",
            autocompletion=complete_scenario,
            help="A shipped scenario (see `uav-twin scenarios`), the path of a TOML file, "
            "or of an SSP file (with --scenario).",
        ),
    ] = None,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            show_default="runs/SCENARIO",
            help="The run folder to make.",
        ),
    ] = None,
    seed: SeedOption = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            "--resume",
            help="Continue the interrupted run in this folder.",
        ),
    ] = None,
    replace: Annotated[
        bool,
        typer.Option(
            "--replace",
            help="Replace the run folder if it exists.",
        ),
    ] = False,
    fmu: Annotated[
        Path | None,
        typer.Option(
            "--fmu",
            help="Fly this FMU; the design of the scenario stays the twin's model.",
        ),
    ] = None,
    binding: Annotated[
        Path | None,
        typer.Option(
            "--binding",
            help="Which variable of the FMU plays which role; by default as in the scenario.",
        ),
    ] = None,
    strain_library: Annotated[
        Path | None,
        typer.Option(
            "--strain-library",
            help="Fly the authors' strain library (UAVconfig.json or its folder) as model "
            "and asset; in a scenario that flies a library, its file.",
        ),
    ] = None,
    calibration: CalibrationOption = None,
    library: LibraryOption = None,
    learnt: Annotated[
        Path | None,
        typer.Option(
            "--learnt",
            help="Fly with what a fleet has learnt, a file of `uav-twin fleet learn`.",
        ),
    ] = None,
    in_process: Annotated[
        bool,
        typer.Option(
            "--in-process",
            help="Run the FMU in this process instead of a worker.",
        ),
    ] = False,
    view: ViewOption = False,
    with_scenario: Annotated[
        str | None,
        typer.Option(
            "--scenario",
            autocompletion=complete_scenario,
            help="What is flown with the SSP file that SCENARIO names.",
        ),
    ] = None,
    no_report: NoReportOption = False,
    json: JsonOption = False,
    seeds: Annotated[
        str | None,
        typer.Option(
            "--seeds",
            metavar="FIRST:END",
            help="Fly one mission for each of these seeds, END left out, into a store; see `uav-twin fleet`.",
        ),
    ] = None,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    policy: Annotated[
        Path | None,
        typer.Option(
            "--policy",
            help="Fly this policy, a file of `uav-twin plan --out`, without planning.",
        ),
    ] = None,
) -> None:
    """Fly a scenario: model, reduce, pack, calibrate, fly, report.

    Example: `uav-twin run level_turns --seed 3 --out runs/first`
    """
    scenario, ssp = _flown(scenario, with_scenario)
    overrides = parts.Overrides(
        seed, fmu, binding, strain_library, in_process, calibration, ssp, library, learnt
    )
    if seeds is not None:
        if scenario is None or resume is not None or seed is not None or view or policy is not None:
            raise typer.BadParameter(said("fleet.seeds"), param_hint="--seeds")
        fleet = parts.ensemble(scenario, parts.seed_range(seeds), overrides)
        fly_and_show(
            fleet, out, engine_of(workers, cluster), replace=replace, report=not no_report, json=json
        )
        return
    if workers is not None or cluster is not None:
        given = "--workers" if cluster is None else "--cluster"
        raise typer.BadParameter("belongs to --seeds: one mission flies alone.", param_hint=given)
    loaded = None if scenario is None else parts.load_scenario(scenario)
    if resume is not None:
        if out is not None or replace or policy is not None or overrides != parts.Overrides():
            raise typer.BadParameter(said("run_folder.resume"), param_hint="--resume")
        folder = resume
    else:
        if loaded is None:
            raise typer.BadParameter("a scenario or --resume is needed.", param_hint="SCENARIO")
        folder = out if out is not None else Path("runs") / loaded.scenario.mission.name

    def kept() -> str:
        begun = (folder / "config.json").is_file()
        hint = f"continue with `uav-twin run --resume {folder}`" if begun else "no run was begun"
        return f"nothing is lost: {hint}"

    with shown(view) as begun, terminal.interruptible(kept):
        told: dict[str, Any] = {"progress": terminal.progress(), "report": not no_report, "begun": begun}
        if loaded is None or resume is not None:
            outcome = parts.resume(folder, loaded, **told)
        else:
            outcome = parts.fly(loaded, folder, overrides, policy=policy, replace=replace, **told)
        if json:
            terminal.print_json(_record(outcome))
        else:
            show_outcome(outcome)


def _flown(scenario: str | None, with_scenario: str | None) -> tuple[str | None, Path | None]:
    """Return the scenario, and the SSP file that is flown in the place of its asset."""
    if scenario is not None and Path(scenario).suffix.lower() == ".ssp":
        if with_scenario is None:
            raise typer.BadParameter(said("scenario.beside_ssp"), param_hint="--scenario")
        return with_scenario, Path(scenario)
    if with_scenario is not None:
        raise typer.BadParameter("belongs to an SSP file as SCENARIO.", param_hint="--scenario")
    return scenario, None


def _record(outcome: "parts.RunOutcome") -> dict[str, Any]:
    """Return the content of `summary.json` with the places of run and report."""
    record: dict[str, Any] = json.loads((outcome.folder / parts.SUMMARY_NAME).read_text(encoding="utf-8"))
    report = None if outcome.report is None else str(outcome.report)
    return {"folder": str(outcome.folder), "report": report} | record


def show_outcome(outcome: "parts.RunOutcome") -> None:
    """Print the figures of a run beside their references, and where the report is."""
    rows: list[list[str]] = []
    sources: dict[str, int] = {}
    for figure in outcome.figures:
        reference = _shown(figure.reference, figure.unit)
        if figure.reference_source:
            reference += f" ({sources.setdefault(figure.reference_source, len(sources) + 1)})"
        rows.append([figure.title, _shown(figure.value, figure.unit, "none"), reference])
    for part in ("asset", "twin", "checkpoint"):
        if entry := outcome.timing.get(f"{part}_seconds"):
            taken = f"{1e3 * entry['median']:.3g} ms (largest {1e3 * entry['largest']:.3g} ms)"
            rows.append([f"{part}, per {outcome.step_name}", taken, ""])
    rows.append(["whole run", f"{outcome.timing['total_seconds']:.3g} s", ""])
    terminal.show("run", "twin_master", outcome=outcome, rows=rows, sources=sources)


def _shown(value: float | int | str | None, unit: str, missing: str = "") -> str:
    return missing if value is None else f"{number(value)} {unit}".strip()


def guarded(application: Callable[[], None], *others: type[Exception]) -> None:
    """Run a command line; an error of this project's packages becomes one sentence and exit code 1.

    `others` are base classes of errors of packages that this one may not import.
    """
    try:
        with former_names_as_lines(lambda: terminal.loudness.quiet):
            application()
    except Exception as error:
        if terminal.loudness.verbose:
            traceback.print_exc()
        # The system's own refusals (a folder without permission, a full disk) are no defect of the program.
        ours = parts.FmuError, parts.FiniteElementError, parts.CalibrationError, ReportingError
        if not isinstance(error, (OSError, TwinMasterError, *ours, *others)):
            raise
        sentence = str(error)
        if isinstance(error, OSError):
            sentence = f"{error.filename or 'a file'}: {error.strerror or error}."
        for line in (sentence, *getattr(error, "__notes__", ())):
            typer.secho(line, fg="red", err=True)
        raise SystemExit(1) from None


def main() -> None:
    """Run `python -m twin_master`."""
    application = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    application.command()(run)
    guarded(lambda: terminal.with_common_options(application)(prog_name="python -m twin_master"))


@accepts_former_options(steps="--turns", from_step="--from-turn")
def watch(
    scenario: Annotated[
        str | None,
        typer.Argument(
            show_default=False,
            metavar="[SCENARIO]",
            autocompletion=complete_scenario,
            help="A shipped scenario, or the path of a TOML file.",
        ),
    ] = None,
    *,
    observations: Annotated[
        str | None,
        typer.Option(
            "--observations",
            metavar="SOURCE",
            show_default="the recording of the scenario, else -",
            help="A CSV or NetCDF file, the folder of a run or watch, `-` for JSON lines "
            "on standard input, or mqtt://[USER@]HOST[:PORT]/TOPIC (mqtts:// with "
            "TLS).",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            show_default="runs/SCENARIO",
            help="The folder of the watch.",
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Take up the watch in --out.",
        ),
    ] = False,
    replace: Annotated[
        bool,
        typer.Option(
            "--replace",
            help="Replace the folder if it exists.",
        ),
    ] = False,
    follow: Annotated[
        bool,
        typer.Option(
            "--follow",
            help="Wait at the end of a CSV file for more.",
        ),
    ] = False,
    pace: Annotated[
        float,
        typer.Option(
            "--pace",
            min=0.0,
            max=3600.0,
            help="Seconds to wait after each step, to look at a recording.",
        ),
    ] = 0.0,
    steps: Annotated[
        int | None,
        typer.Option(
            "--steps",
            min=0,
            help="End after so many steps in all.",
        ),
    ] = None,
    model_patch: Annotated[
        Path | None,
        typer.Option(
            "--model-patch",
            help="Believe this patch (`patch.json` of `discrepancy run`) from --from-step on.",
        ),
    ] = None,
    from_step: Annotated[
        int | None,
        typer.Option(
            "--from-step",
            min=0,
            help="The first step that --model-patch is believed in.",
        ),
    ] = None,
    teach: Annotated[
        bool,
        typer.Option(
            "--teach",
            help="Look for the cause of an alarm, and believe what is named.",
        ),
    ] = False,
    allow_unknown: Annotated[
        bool,
        typer.Option(
            "--allow-unknown",
            help="Pass over keys and columns that are no sensor.",
        ),
    ] = False,
    ca_file: CertificateOption = None,
    seed: SeedOption = None,
    calibration: CalibrationOption = None,
    library: LibraryOption = None,
    last: Annotated[
        int,
        typer.Option(
            "--last",
            min=1,
            help="Steps, the last ones, in run.nc and report.",
        ),
    ] = 1000,
    view: ViewOption = False,
    no_report: NoReportOption = False,
) -> None:
    """Watch a real asset: observations in, a decision for each step out, as a line of JSON.

    The same scenario as for a simulated mission; its tables `asset` and `truth` are not needed.

    Everything is kept in the folder after every step. Ctrl-C ends a watch in order; --resume takes it up.

    Example: `uav-twin watch watched_wing --out runs/watched`
    """
    watches: list[parts.Watch] = []
    live = follow or observations is None or observations == "-" or parts.is_broker(observations)

    def decide(decision: Mapping[str, Any]) -> None:
        heard = _say(watches[0], decision, flush=live)
        time.sleep(pace)
        if not heard and not parts.is_broker(observations or ""):
            signal.raise_signal(signal.SIGINT)  # which ends a watch in order

    with shown(view) as begun:

        def opened(watched: parts.Watch) -> None:
            watches.append(watched)
            begun(watched.folder)

        folder = parts.watch(
            scenario, observations, out, {"seed": seed, "calibration": calibration, "library": library},
            decide=decide, resume=resume, follow=follow, steps=steps, model_patch=model_patch,
            from_step=from_step, teach=teach, allow_unknown=allow_unknown, ca_file=ca_file, replace=replace,
            last=last, report=not no_report, otherwise="-", begun=opened, progress=terminal.progress(),
        )  # fmt: skip
        _write("", flush=True)
        if not terminal.loudness.quiet:
            _say_where(folder, watches[0], report=not no_report)
    complaint = watches[0].intake.complaint()
    if complaint:
        typer.secho(complaint, fg="red", err=True)
        raise typer.Exit(1)


def _say_where(folder: Path, watched: "parts.Watch", *, report: bool) -> None:
    """Print how many messages a watch has had, and where its folder and its report are."""
    counts = watched.intake.counts
    refused = ""
    if counts.rejected:
        refused = f", {counted(counts.rejected, 'message')} refused (see rejected.jsonl)"
    typer.echo(f"Watch: {folder}, {counted(counts.received, 'message')}{refused}.", err=True)
    if report and (folder / parts.REPORT_NAME).is_file():
        typer.echo(f"Report: {folder / parts.REPORT_NAME}", err=True)


def _say(watched: "parts.Watch", decision: Mapping[str, Any], *, flush: bool) -> bool:
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


def _line(scenario: "parts.Scenario", decision: Mapping[str, Any]) -> str:
    """Return a decision for people: a line of a terminal."""
    health = "no state is believed"
    if decision.get("state_believed", True):
        health = ", ".join(f"{name} {said}" for name, said in parts.health_in_words(decision).items())
    line = (
        f"{scenario.mission.step_name} {decision['step']}: {decision['control']}, {health}; "
        f"next {decision['next_control']} with probability {decision['probability']:.3f}"
    )
    chosen = decision.get("decided_by", "model")
    return line if chosen == "model" else f"{line}; by {chosen} ({decision['hypotheses'][chosen]:.2f})"


def view(
    folder: Annotated[
        Path,
        typer.Argument(
            show_default=False,
            metavar="DIR",
            help="Folder of a run, a watch or a fleet, finished or going on.",
        ),
    ],
    *,
    port: Annotated[
        int,
        typer.Option(
            "--port",
            min=0,
            max=65535,
            show_default="any that is free",
            help="Port on the loopback.",
        ),
    ] = 0,
    browser: Annotated[
        bool,
        typer.Option(
            "--browser",
            help="Open the page in the default browser.",
        ),
    ] = False,
) -> None:
    """Show a flight in the browser, step by step or while it goes on, or a whole fleet.

    Example: `uav-twin view runs/first --browser`
    """

    def ready(address: str) -> None:
        typer.echo(f"{folder}: {address} (Ctrl-C ends it)")
        if browser:
            webbrowser.open(address)

    (parts.serve_fleet if parts.is_fleet(folder) else parts.serve)(folder, port, ready)


def list_scenarios() -> None:
    """List the scenarios that are shipped.

    Example: `uav-twin scenarios`
    """
    files = scenario_files()
    shown = {name: parts.load_scenario(path).scenario for name, path in files.items()}
    terminal.show("scenarios", "twin_master", shown=shown, folder=next(iter(files.values())).parent)


def check_scenario(
    file: Annotated[
        str,
        typer.Argument(
            show_default=False,
            metavar="FILE",
            autocompletion=complete_scenario,
            help="A scenario file, or a shipped name.",
        ),
    ],
    *,
    calibration: CalibrationOption = None,
    json: JsonOption = False,
) -> None:
    """Say what a scenario flies and believes, and what it takes; exit code 1 if anything is wrong with it.

    Example: `uav-twin scenario check level_turns`
    """
    record = parts.check_scenario(parts.load_scenario(file), {"calibration": calibration})
    terminal.answer("scenario check", "twin_master", record, json=json)
