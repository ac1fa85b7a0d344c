"""Commands of one mission: `run`, also as `python -m twin_master`, and `view`."""

import traceback
import webbrowser
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from reporting import terminal
from reporting.errors import InvalidChoiceError, ReportingError
from reporting.files import NO_SPACE
from reporting.formats.former_options import former_names_as_lines
from reporting.terminal import JsonOption, NoReportOption
from reporting.words import number
from twin_master.command_options import (
    CalibrationOption,
    ClusterOption,
    EstimatorOption,
    LibraryOption,
    PolicyOption,
    SeedOption,
    SensorModelOption,
    StoreOption,
    ViewOption,
    WorkersOption,
    choose_engine,
    complete_scenario,
)
from twin_master.errors import TwinMasterError
from twin_master.fleet_command import fly_and_print_fleet, view_beside

if TYPE_CHECKING:
    from reporting.json_file import JsonObject
    from twin_master.assets.resolution import Overrides
    from twin_master.mission.parts import TwinParts
    from twin_master.store.writing import RunOutcome


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
            help=(
                "Binding file: which variable of the FMU plays which role; by default that of the "
                "scenario."
            ),
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
    no_notices: Annotated[
        bool,
        typer.Option(
            "--no-notices",
            help="Give no notices and alarms; many seeds then take a small fraction of the time.",
        ),
    ] = False,
    view: ViewOption = False,
    with_scenario: Annotated[
        str | None,
        typer.Option(
            "--scenario",
            autocompletion=complete_scenario,
            help="The scenario that is flown with the SSP file given as SCENARIO.",
        ),
    ] = None,
    no_report: NoReportOption = False,
    json: JsonOption = False,
    seeds: Annotated[
        str | None,
        typer.Option(
            "--seeds",
            metavar="FIRST:END",
            help="Fly one mission for each of these seeds, END left out, into a store; see "
            "`uav-twin fleet`.",
        ),
    ] = None,
    workers: WorkersOption = None,
    cluster: ClusterOption = None,
    store: StoreOption = "",
    policy: PolicyOption = None,
    sensor_model: SensorModelOption = None,
    estimator: EstimatorOption = None,
) -> None:
    """Fly a scenario: model, reduce, pack, calibrate, fly, report.

    Example: `uav-twin run level_turns --seed 3 --out runs/first`
    """
    from twin_master.assets.resolution import Overrides
    from twin_master.fleet.plan import ensemble, seed_range
    from twin_master.mission.parts import TwinParts

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
        no_notices=no_notices,
    )
    parts = TwinParts(policy, sensor_model, estimator)
    if seeds is not None:
        has_other_options = resume is not None or seed is not None or view
        if scenario is None or has_other_options:
            raise _wrong_use_of_seeds()
        fleet = ensemble(scenario, seed_range(seeds), overrides).with_parts(parts)
        engine = choose_engine(workers, cluster)
        fleet = fleet.with_store(store)
        fly_and_print_fleet(fleet, out, engine, replace=replace, report=not no_report, json=json)
        return
    _refuse_options_of_seeds(workers, cluster, store)
    has_changes = out is not None or policy is not None or overrides != Overrides()
    if resume is None:
        folder, fly_mission = _new_mission(scenario, out, overrides, parts, replace=replace)
    else:
        folder = resume
        fly_mission = _resumed_mission(scenario, folder, parts, has_changes=replace or has_changes)
    _fly_and_print_mission(fly_mission, folder, report=not no_report, view=view, json=json)


def _refuse_options_of_seeds(workers: int | None, cluster: str | None, store: str) -> None:
    """Refuse the options --workers, --cluster and --store for a single mission."""
    is_given = {
        "--workers": workers is not None,
        "--cluster": cluster is not None,
        "--store": bool(store),
    }
    for option, given in is_given.items():
        if given:
            raise typer.BadParameter(
                "belongs to --seeds: one mission flies alone.", param_hint=option
            )


def _wrong_use_of_seeds() -> typer.BadParameter:
    """Return the error about options that cannot be combined with --seeds."""
    return typer.BadParameter(
        "--seeds needs a scenario, and cannot be combined with --resume (repeat the command "
        "instead), --seed or --view.",
        param_hint="--seeds",
    )


def _new_mission(
    scenario_name: str | None,
    out: Path | None,
    overrides: "Overrides",
    parts: "TwinParts",
    *,
    replace: bool,
) -> "tuple[Path, Callable[..., RunOutcome]]":
    """Return the run folder of a new mission, and the function that flies it."""
    from twin_master.scenario.reading import load_scenario
    from twin_master.workflow import fly

    if scenario_name is None:
        raise typer.BadParameter("a scenario or --resume is needed.", param_hint="SCENARIO")
    loaded_scenario = load_scenario(scenario_name)
    folder = out if out is not None else Path("runs") / loaded_scenario.scenario.mission.name
    return folder, partial(fly, loaded_scenario, folder, overrides, **vars(parts), replace=replace)


def _resumed_mission(
    scenario_name: str | None, folder: Path, parts: "TwinParts", *, has_changes: bool
) -> "Callable[..., RunOutcome]":
    """Return a function that continues an interrupted run.

    Parameters
    ----------
    scenario_name : str or None
        The scenario that the user named in addition; None if the user named only the folder.
    folder : Path
        The folder of the run.
    parts : TwinParts
        The sensor model and the estimator that the user gave.
    has_changes : bool
        Whether the user gave an option that would change the run, which is refused.
    """
    from twin_master.scenario.reading import load_scenario
    from twin_master.workflow import resume

    loaded_scenario = None if scenario_name is None else load_scenario(scenario_name)
    if has_changes:
        raise typer.BadParameter(
            "a run is continued with the inputs in its folder: leave out options that would change "
            "them.",
            param_hint="--resume",
        )
    return partial(
        resume,
        folder,
        loaded_scenario,
        sensor_model=parts.sensor_model,
        estimator=parts.estimator,
    )


def _fly_and_print_mission(
    fly_mission: "Callable[..., RunOutcome]",
    folder: Path,
    *,
    report: bool,
    view: bool,
    json: bool,
) -> None:
    """Fly a mission and print its outcome.

    Parameters
    ----------
    fly_mission : callable
        `workflow.fly` or `workflow.resume` with its arguments, except `progress`, `report` and
        `begun`.
    folder : Path
        The path of the run folder.
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
            from reporting.json_file import read_json
            from twin_master.store.writing import SUMMARY_NAME

            # The summary, with the paths of run and report.
            report_path = None if outcome.report is None else str(outcome.report)
            record: JsonObject = {"folder": str(outcome.folder), "report": report_path}
            record |= read_json(outcome.folder / SUMMARY_NAME, ReportingError)
            terminal.print_json(record)
        else:
            print_outcome(outcome)


def _scenario_and_ssp(
    scenario: str | None, with_scenario: str | None
) -> tuple[str | None, Path | None]:
    """Return the scenario, and the SSP file that replaces its asset.

    If the argument SCENARIO is an SSP file, the option --scenario names the scenario.
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


def print_outcome(outcome: "RunOutcome") -> None:
    """Print what the twin did, the figures of a run beside their references, and its files."""
    from twin_master.mission.decision_record import with_folder
    from twin_master.store.writing import printed_values

    terminal.say(f"The twin {outcome.control}.", bold=True)
    if outcome.origin.differ:
        terminal.say(
            f"Asset and twin's model differ: the asset was the {outcome.origin.asset}, and the "
            f"twin believes the {outcome.origin.model}."
        )
    for notice in outcome.notices:
        terminal.say(with_folder(notice, outcome.folder), fg="yellow")
    numbers_of_sources: dict[str, int] = {}  # of the references, from 1
    rows = []
    texts = printed_values(outcome.figures)
    for figure, (value, reference) in zip(outcome.figures, texts, strict=True):
        if reference and not isinstance(figure.reference, str):  # a text has its unit in it
            reference = f"{reference} {figure.unit}".strip()
        if figure.reference_source:
            source_number = numbers_of_sources.setdefault(
                figure.reference_source, len(numbers_of_sources) + 1
            )
            reference += f" ({source_number})"
        value = "none" if figure.value is None else f"{value} {figure.unit}".strip()
        rows.append([figure.title, value, reference])
    terminal.print_table(["result", "this run", "reference"], rows + _timing_rows(outcome))
    for source, source_number in numbers_of_sources.items():
        terminal.say(f"  ({source_number}) {source}")
    if outcome.report is not None:
        terminal.say(f"Report: {outcome.report}")
    else:
        terminal.say(f"Run: {outcome.folder}")


def _timing_rows(outcome: "RunOutcome") -> list[list[str]]:
    """Return the rows of the table of times: asset, twin, checkpoints, and their total."""
    rows = []
    for part in ("asset", "twin", "checkpoint"):
        seconds = outcome.timing.get(f"{part}_seconds")
        if seconds:
            median_milliseconds = 1e3 * seconds["median"]
            largest = 1e3 * seconds["largest"]
            time_of_step = f"{median_milliseconds:.3g} ms (largest {largest:.3g} ms)"
            rows.append([f"{part}, per {outcome.step_name}", time_of_step, ""])
    rows.append(["whole run", f"{outcome.timing['total_seconds']:.3g} s", ""])
    return rows


def printed_value(value: float | int | str | None, unit: str, text_for_none: str = "") -> str:
    """Return a value with its unit, or `text_for_none` for None."""
    return text_for_none if value is None else f"{number(value)} {unit}".strip()


def run_command_line(application: Callable[[], None], *further_errors: type[Exception]) -> None:
    """Run a command line; turn errors of this project into one sentence and exit code 1.

    Parameters
    ----------
    application : callable
        The command line.
    *further_errors : type of Exception
        The base classes of errors of packages that this one may not import.
    """
    terminal.make_streams_writable()
    try:
        with former_names_as_lines(lambda: terminal.loudness.quiet):
            application()
    except Exception as error:
        if terminal.loudness.verbose:
            traceback.print_exc()
        from calibration.errors import CalibrationError
        from fe.runtime.errors import FiniteElementError
        from fmu_asset.errors import FmuError

        our_errors: tuple[type[Exception], ...] = (
            TwinMasterError,
            ReportingError,
            InvalidChoiceError,
            FmuError,
            FiniteElementError,
            CalibrationError,
            *further_errors,
        )
        # The system's refusals, such as a full disk, are not defects of the program either.
        if not isinstance(error, (OSError, *our_errors)):
            raise
        sentence = str(error)
        if isinstance(error, OSError):
            sentence = _system_error_sentence(error)
        for line in (sentence, *getattr(error, "__notes__", ())):
            typer.secho(line, fg="red", err=True)
        raise SystemExit(1) from None


def _system_error_sentence(error: OSError) -> str:
    """Return the sentence for an error of the operating system, which may name no file."""
    reason = error.strerror or error
    if error.filename is not None:
        return f"{error.filename}: {reason}."
    if error.errno in NO_SPACE:
        return (
            "No space is left on the disk for the output of this command: free some space, or "
            "send the output elsewhere, and repeat."
        )
    return (
        f"The operating system refused to read or write a file or stream: {reason}; repeat with "
        "--verbose to see which."
    )


def main() -> None:
    """Run `python -m twin_master`."""
    application = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    application.command()(run)
    run_with_options = terminal.with_common_options(application)
    run_command_line(lambda: run_with_options(prog_name="python -m twin_master"))


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
    from twin_master.fleet.page.view import is_fleet, serve_fleet
    from twin_master.viewer.server import serve as serve_flight

    def print_address(address: str) -> None:
        typer.echo(f"{folder}: {address} (Ctrl-C ends it)")
        if browser:
            webbrowser.open(address)

    serve = serve_fleet if is_fleet(folder) else serve_flight
    serve(folder, port, print_address)
