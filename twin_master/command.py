"""Commands of one asset: `run`, also as `python -m twin_master`, `watch` and `view`."""

import json
import os
import shlex
import signal
import sys
import time
import traceback
import webbrowser
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from reporting import terminal
from reporting.command_options import JsonOption, NoReportOption
from reporting.errors import ReportingError
from reporting.former_options import accepts_former_options, former_names_as_lines
from reporting.words import counted, number
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
from twin_master.errors import TwinMasterError
from twin_master.fleet_command import choose_engine, fly_and_print_fleet, view_beside
from twin_master.watch.cause_search import CauseSearch

if TYPE_CHECKING:
    from twin_master.assets.resolution import Overrides
    from twin_master.store.writing import RunOutcome
    from twin_master.watch.folder import Watch


Decision = Mapping[str, Any]
"""The decision of a twin in a step, as `decision_from_line` returns it."""


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
    from twin_master.assets.resolution import Overrides
    from twin_master.fleet.plan import ensemble, seed_range

    scenario, ssp = _scenario_and_ssp(scenario, with_scenario)
    overrides = Overrides(
        seed=seed,
        fmu=fmu,
        binding=binding,
        strain_library=strain_library,
        in_process=in_process,
        calibration=calibration,
        ssp=ssp,
        library=library,
        learnt=learnt,
    )
    if seeds is not None:
        has_other_options = resume is not None or seed is not None or policy is not None or view
        if scenario is None or has_other_options:
            raise _wrong_use_of_seeds()
        fleet = ensemble(scenario, seed_range(seeds), overrides)
        engine = choose_engine(workers, cluster)
        fly_and_print_fleet(fleet, out, engine, replace=replace, report=not no_report, json=json)
        return
    if workers is not None or cluster is not None:
        raise typer.BadParameter(
            "belongs to --seeds: one mission flies alone.",
            param_hint="--workers" if cluster is None else "--cluster",
        )
    has_changes = out is not None or policy is not None or overrides != Overrides()
    if resume is None:
        folder, fly_mission = _new_mission(scenario, out, overrides, policy, replace=replace)
    else:
        folder = resume
        fly_mission = _resumed_mission(scenario, folder, has_changes=replace or has_changes)
    _fly_and_print_mission(fly_mission, folder, report=not no_report, view=view, json=json)


def _wrong_use_of_seeds() -> typer.BadParameter:
    """Return the error that options do not go together with --seeds."""
    return typer.BadParameter(
        "many seeds need a scenario, and neither --resume (repeat the command), --seed, --policy nor --view.",
        param_hint="--seeds",
    )


def _new_mission(
    scenario_name: str | None,
    out: Path | None,
    overrides: "Overrides",
    policy: Path | None,
    *,
    replace: bool,
) -> "tuple[Path, Callable[..., RunOutcome]]":
    """Return the run folder of a new mission, and the function that flies it."""
    from twin_master.scenario.reading import load_scenario
    from twin_master.workflow import fly

    if scenario_name is None:
        raise typer.BadParameter("a scenario or --resume is needed.", param_hint="SCENARIO")
    loaded = load_scenario(scenario_name)
    folder = out if out is not None else Path("runs") / loaded.scenario.mission.name
    return folder, partial(fly, loaded, folder, overrides, policy=policy, replace=replace)


def _resumed_mission(
    scenario_name: str | None, folder: Path, *, has_changes: bool
) -> "Callable[..., RunOutcome]":
    """Return the function that continues an interrupted run."""
    from twin_master.scenario.reading import load_scenario
    from twin_master.workflow import resume

    loaded = None if scenario_name is None else load_scenario(scenario_name)
    if has_changes:
        raise typer.BadParameter(
            "a run is continued with what its folder holds: give nothing beside it that would change it.",
            param_hint="--resume",
        )
    return partial(resume, folder, loaded)


def _fly_and_print_mission(
    fly_mission: "Callable[..., RunOutcome]",
    folder: Path,
    *,
    report: bool,
    view: bool,
    json: bool,
) -> None:
    """Fly a mission, and print its outcome.

    Parameters
    ----------
    fly_mission : callable
        `workflow.fly` or `workflow.resume` with its arguments, except `progress`, `report` and
        `begun`.
    folder : Path
        The run folder.
    report : bool
        Whether to write the report.
    view : bool
        Whether to show the mission in the browser.
    json : bool
        Whether to print JSON.
    """

    def explain_interruption() -> str:
        if (folder / "config.json").is_file():
            return f"nothing is lost: continue with `uav-twin run --resume {folder}`"
        return "nothing is lost: no run was begun"

    with view_beside(view) as begun, terminal.interruptible(explain_interruption):
        outcome = fly_mission(progress=terminal.progress(), report=report, begun=begun)
        if json:
            terminal.print_json(_outcome_record(outcome))
        else:
            print_outcome(outcome)


def _scenario_and_ssp(scenario: str | None, with_scenario: str | None) -> tuple[str | None, Path | None]:
    """Return the scenario, and the SSP file that is flown instead of its asset.

    An SSP file in the place of the scenario is flown; the option --scenario then names the
    scenario.
    """
    if scenario is not None and Path(scenario).suffix.lower() == ".ssp":
        if with_scenario is None:
            raise typer.BadParameter(
                "an SSP file says what is flown, not how: name a scenario as well.",
                param_hint="--scenario",
            )
        return with_scenario, Path(scenario)
    if with_scenario is not None:
        raise typer.BadParameter("belongs to an SSP file as SCENARIO.", param_hint="--scenario")
    return scenario, None


def _outcome_record(outcome: "RunOutcome") -> dict[str, Any]:
    """Return the content of `summary.json` with the paths of run and report."""
    from twin_master.store.writing import SUMMARY_NAME

    summary = (outcome.folder / SUMMARY_NAME).read_text(encoding="utf-8")
    report = None if outcome.report is None else str(outcome.report)
    record: dict[str, Any] = {"folder": str(outcome.folder), "report": report}
    record |= json.loads(summary)
    return record


def print_outcome(outcome: "RunOutcome") -> None:
    """Print the figures of a run beside their references, and where the report is."""
    numbers_of_sources = _numbers_of_sources(outcome)
    rows = []
    for figure in outcome.figures:
        reference = printed_value(figure.reference, figure.unit)
        if figure.reference_source:
            reference += f" ({numbers_of_sources[figure.reference_source]})"
        value = printed_value(figure.value, figure.unit, missing="none")
        rows.append([figure.title, value, reference])
    terminal.print_table(["figure", "this run", "reference"], rows + _timing_rows(outcome))
    terminal.say(f"The twin {outcome.control}.")
    if outcome.origin.differ:
        terminal.say(
            f"Asset and twin's model differ: flown was the {outcome.origin.asset}, and the twin "
            f"believes the {outcome.origin.model}."
        )
    for notice in outcome.notices:
        terminal.say(notice.replace(" DIR", f" {outcome.folder}"), fg="yellow")
    for source, source_number in numbers_of_sources.items():
        terminal.say(f"  ({source_number}) {source}")
    if outcome.report is not None:
        terminal.say(f"Report: {outcome.report}")
    else:
        terminal.say(f"Run: {outcome.folder}")


def _numbers_of_sources(outcome: "RunOutcome") -> dict[str, int]:
    """Return a number from 1 for each source of a reference."""
    numbers: dict[str, int] = {}
    for figure in outcome.figures:
        if figure.reference_source and figure.reference_source not in numbers:
            numbers[figure.reference_source] = len(numbers) + 1
    return numbers


def _timing_rows(outcome: "RunOutcome") -> list[list[str]]:
    """Return the rows of the table with the time of asset, twin and checkpoints, and of all."""
    rows = []
    for part in ("asset", "twin", "checkpoint"):
        seconds = outcome.timing.get(f"{part}_seconds")
        if seconds:
            median = 1e3 * seconds["median"]
            largest = 1e3 * seconds["largest"]
            time_of_step = f"{median:.3g} ms (largest {largest:.3g} ms)"
            rows.append([f"{part}, per {outcome.step_name}", time_of_step, ""])
    rows.append(["whole run", f"{outcome.timing['total_seconds']:.3g} s", ""])
    return rows


def printed_value(value: float | int | str | None, unit: str, missing: str = "") -> str:
    """Return a value with its unit; the text `missing` for None."""
    return missing if value is None else f"{number(value)} {unit}".strip()


def run_command_line(application: Callable[[], None], *further_errors: type[Exception]) -> None:
    """Run a command line; an error of this project's packages becomes one sentence and exit code 1.

    Parameters
    ----------
    application : callable
        The command line.
    *further_errors : type of Exception
        The base classes of errors of packages that this one may not import.
    """
    try:
        with former_names_as_lines(lambda: terminal.loudness.quiet):
            application()
    except Exception as error:
        if terminal.loudness.verbose:
            traceback.print_exc()
        our_errors: tuple[type[Exception], ...] = (
            TwinMasterError,
            ReportingError,
            *_errors_of_lower_layers(),
            *further_errors,
        )
        # The system's refusals, such as a full disk, are no defects of the program either.
        if not isinstance(error, (OSError, *our_errors)):
            raise
        sentence = str(error)
        if isinstance(error, OSError):
            sentence = f"{error.filename or 'a file'}: {error.strerror or error}."
        for line in (sentence, *getattr(error, "__notes__", ())):
            typer.secho(line, fg="red", err=True)
        raise SystemExit(1) from None


def _errors_of_lower_layers() -> tuple[type[Exception], ...]:
    """Return the base classes of the errors of models, FMUs and calibrations."""
    from calibration.errors import CalibrationError
    from fe.runtime.errors import FiniteElementError
    from fmu_asset.errors import FmuError

    return FmuError, FiniteElementError, CalibrationError


def main() -> None:
    """Run `python -m twin_master`."""
    application = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    application.command()(run)
    run_with_options = terminal.with_common_options(application)
    run_command_line(lambda: run_with_options(prog_name="python -m twin_master"))


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
    cause_search: CauseSearch | None = None,
) -> None:
    """Watch a real asset: observations in, a decision for each step out, as a line of JSON.

    The same scenario as for a simulated mission; its tables `asset` and `truth` are not needed.

    Everything is kept in the folder after every step. Ctrl-C ends a watch in order; --resume takes it up.

    Example: `uav-twin watch watched_wing --out runs/watched`
    """
    from twin_master.watch import broker_address, opening

    watches: list[Watch] = []
    comes_from_broker = broker_address.is_broker(observations or "")
    is_live = follow or observations is None or observations == "-" or comes_from_broker

    def print_decision(decision: Decision) -> None:
        has_reader = _print_decision(watches[0], decision, flush=is_live)
        time.sleep(pace)
        if not has_reader and not comes_from_broker:
            signal.raise_signal(signal.SIGINT)  # which ends a watch in order

    with view_beside(view) as begun:

        def begin_watch(watched: "Watch") -> None:
            watches.append(watched)
            begun(watched.folder)

        folder = opening.watch(
            scenario,
            observations,
            out,
            {"seed": seed, "calibration": calibration, "library": library},
            decide=print_decision,
            resume=resume,
            follow=follow,
            steps=steps,
            model_patch=model_patch,
            from_step=from_step,
            teach=teach,
            allow_unknown=allow_unknown,
            ca_file=ca_file,
            replace=replace,
            last=last,
            report=not no_report,
            otherwise="-",
            begun=begin_watch,
            cause_search=cause_search,
            progress=terminal.progress(),
        )
        _print_end_of_watch(folder, watches[0], report=not no_report)
    _exit_on_complaint(watches[0])


def _exit_on_complaint(watched: "Watch") -> None:
    """End the command with exit code 1 if the observations of a watch were not in order."""
    complaint = watched.intake.complaint()
    if complaint:
        raise terminal.error_exit(complaint)


def _print_end_of_watch(folder: Path, watched: "Watch", *, report: bool) -> None:
    """Flush the decisions; print how many messages came, and where folder and report are."""
    from twin_master.store.writing import REPORT_NAME

    _write_to_output("", flush=True)
    if terminal.loudness.quiet:
        return
    counts = watched.intake.counts
    refused = ""
    if counts.rejected:
        refused = f", {counted(counts.rejected, 'message')} refused (see rejected.jsonl)"
    received = counted(counts.received, "message")
    typer.echo(f"Watch: {folder}, {received}{refused}.", err=True)
    if report and (folder / REPORT_NAME).is_file():
        typer.echo(f"Report: {folder / REPORT_NAME}", err=True)


def _print_decision(watched: "Watch", decision: Decision, *, flush: bool) -> bool:
    """Print a decision and its notices; return whether the output still has a reader."""
    from twin_master.mission.decision_record import decision_line

    # Notices go to the error stream, so that people see them also if a program reads the decisions.
    for notice in decision["notices"]:
        sentence = notice["sentence"].replace(" DIR", f" {shlex.quote(str(watched.folder))}")
        typer.secho(sentence, fg="yellow", err=True)
    if terminal.loudness.quiet:
        return True
    is_for_people = sys.stdout.isatty()
    if not is_for_people:
        return _write_to_output(json.dumps(decision) + "\n", flush=flush)
    if "control" not in decision:  # before the first observation nothing is decided
        return True
    return _write_to_output(decision_line(watched.scenario, decision) + "\n", flush=True)


def _write_to_output(text: str, *, flush: bool) -> bool:
    """Write to standard output; return whether it still has a reader."""
    try:
        sys.stdout.write(text)
        if flush:
            sys.stdout.flush()
    except BrokenPipeError:
        # The reader has ended, as in `watch | head`. Python would complain at its end that it
        # cannot write the rest of the buffer, so the rest goes to the null device.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return False
    return True


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
    from twin_master.fleet.view import is_fleet, serve_fleet
    from twin_master.viewer.server import serve as serve_flight

    def print_address(address: str) -> None:
        typer.echo(f"{folder}: {address} (Ctrl-C ends it)")
        if browser:
            webbrowser.open(address)

    serve = serve_fleet if is_fleet(folder) else serve_flight
    serve(folder, port, print_address)
