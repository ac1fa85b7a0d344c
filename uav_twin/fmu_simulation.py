"""`uav-twin fmu simulate`, `ssp simulate` and `library sample`: runs of FMUs and their systems."""

import tempfile
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from fmu_asset.errors import FmuInputError, FmuWorkerError
from reporting import terminal
from reporting.files import atomic_write_bytes, refuse_existing
from twin_master.command_options import complete_scenario
from uav_twin.options import (
    FmuArgument,
    HistoryOption,
    InProcessOption,
    InterpolationOption,
    PlotOption,
    ReplaceOption,
    SspArgument,
    StepSizeOption,
    StepTimeoutOption,
)

if TYPE_CHECKING:
    from fe.runtime.arrays import FloatArray
    from fmu_asset.client.binding import Binding
    from fmu_asset.client.observations import ObservationHistory
    from fmu_asset.client.session import FmiAsset
    from twin_master.library.sampling import SamplingOutcome

_MOST_PANELS = 8
"""Largest number of panels of a plot."""
_MOST_LINES = 10
"""Largest number of lines in a panel."""


def simulate(
    file: FmuArgument,
    *,
    binding: Annotated[
        Path | None,
        typer.Option(
            "--binding",
            help=(
                "Binding file of the FMU; without one, all outputs are given in the units of the "
                "FMU."
            ),
        ),
    ] = None,
    inputs: Annotated[
        Path | None,
        typer.Option(
            "--inputs",
            help="CSV: `time` (s, where each step begins) and the inputs by the binding's names.",
        ),
    ] = None,
    out: HistoryOption = None,
    stop_time: Annotated[
        float | None,
        typer.Option(
            "--stop-time",
            help="End in seconds; the FMU's own by default, or 1 s after the start.",
        ),
    ] = None,
    step_size: StepSizeOption = None,
    values: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="A parameter (of any kind) or input of the FMU.",
        ),
    ] = None,
    plot: PlotOption = None,
    interpolation: InterpolationOption = None,
    in_process: InProcessOption = False,
    step_timeout: StepTimeoutOption = None,
    replace: ReplaceOption = False,
) -> None:
    """Simulate the default experiment of an FMU, or input histories by --binding and --inputs.

    Example: `uav-twin fmu simulate pump.fmu --stop-time 10 --set speed=120 --out pump.csv`
    """
    from fmu_asset.archive.fmu_file import read_fmu
    from fmu_asset.client.binding import load_binding
    from fmu_asset.client.binding_remarks import undeclared_units_sentence, unset_inputs_sentence
    from fmu_asset.client.experiment import (
        default_experiment,
        ending_with_histories,
        run_experiment,
        run_histories,
    )
    from fmu_asset.client.history_files import read_histories
    from fmu_asset.client.session import FmiAsset

    _refuse_unwritable_files(out, plot, replace=replace)
    has_experiment_options = stop_time is not None or step_size is not None or bool(values)
    _refuse_options_that_contradict(
        binding, inputs, interpolation, has_experiment_options=has_experiment_options
    )
    open_with_binding = partial(FmiAsset, file, isolated=not in_process, step_timeout=step_timeout)
    # Without a binding: the default experiment of the FMU
    if binding is None:
        experiment = default_experiment(
            read_fmu(file),
            stop_time=stop_time,
            step_size=step_size,
            values=_values_by_name(values or ()),
        )
        open_asset = partial(open_with_binding, experiment.binding)
        with closing(open_asset()) as asset:
            run = partial(run_experiment, experiment=experiment)
            history = _history_or_located_crash(asset, open_asset, run)
            _write_and_print_history(asset, history, file, out, plot)
        return
    # With a binding: the inputs over time from a file
    assert inputs is not None  # checked above: both options are given or neither
    fmu_binding = _with_interpolation(load_binding(binding), interpolation)
    steps, histories = read_histories(inputs, fmu_binding)
    fmu_binding = ending_with_histories(fmu_binding, steps)
    open_asset = partial(open_with_binding, fmu_binding)
    with closing(open_asset()) as asset:
        _warn(unset_inputs_sentence(asset.description, asset.binding, histories))
        _warn(undeclared_units_sentence(asset.description, asset.binding))
        run = partial(run_histories, steps=steps, histories=histories)
        history = _history_or_located_crash(asset, open_asset, run)
        _write_and_print_history(asset, history, file, out, plot)


def _warn(sentence: str) -> None:
    """Print a warning, unless its sentence is empty."""
    if sentence:
        terminal.say(f"warning: {sentence}")


def _history_or_located_crash(
    asset: "FmiAsset",
    open_asset: Callable[[], "FmiAsset"],
    run: Callable[["FmiAsset"], "ObservationHistory"],
) -> "ObservationHistory":
    """Return the history of a run; after a crash, raise an error that names the exact step."""
    from fmu_asset.checks.crash import located_crash

    try:
        return run(asset)
    except FmuWorkerError as crash:
        error = crash
    raise located_crash(open_asset, run, error)


def _refuse_options_that_contradict(
    binding: Path | None,
    inputs: Path | None,
    interpolation: str | None,
    *,
    has_experiment_options: bool,
) -> None:
    """Raise an error if options of `fmu simulate` do not go together."""
    if (binding is None) != (inputs is None):
        raise FmuInputError(
            "--binding and --inputs go together: one names the columns of the other."
        )
    if binding is not None and has_experiment_options:
        raise FmuInputError(
            "--stop-time, --step-size and --set are for a simulation without --binding, because a "
            "binding states these itself."
        )
    if interpolation is not None and inputs is None:
        raise FmuInputError(
            "--interpolation is for the course between the rows of --inputs: give --inputs, too."
        )


def simulate_system(
    file: SspArgument,
    *,
    out: HistoryOption = None,
    stop_time: Annotated[
        float | None,
        typer.Option("--stop-time", help="End in seconds; by default that of the file, or 1 s."),
    ] = None,
    step_size: Annotated[
        float | None,
        typer.Option("--step-size", min=0.0, help="Communication step size in seconds."),
    ] = None,
    values: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="A connector of the system, or component.variable.",
        ),
    ] = None,
    plot: PlotOption = None,
    algorithm: Annotated[
        str,
        typer.Option(
            "--algorithm",
            help="How values are passed on within a step: gauss_seidel or jacobi.",
        ),
    ] = "gauss_seidel",
    iterations: Annotated[
        int,
        typer.Option(
            "--iterations",
            min=1,
            help="Largest number of iterations of a step if components form a loop.",
        ),
    ] = 1,
    delay: Annotated[
        list[str] | None,
        typer.Option(
            "--delay",
            metavar="END",
            help="Delay the connection to this end by a step: it breaks a loop there.",
        ),
    ] = None,
    interpolation: InterpolationOption = None,
    in_process: InProcessOption = False,
    replace: ReplaceOption = False,
) -> None:
    """Simulate the system of an SSP file, and record all outputs of it and its components.

    Example: `uav-twin ssp simulate level_turns.ssp --stop-time 10 --out history.csv`
    """
    from fmu_asset.client.experiment import default_experiment, run_experiment
    from fmu_asset.coupling.asset import CoupledAsset
    from fmu_asset.coupling.system import system_description
    from fmu_asset.ssp.check import join_ssp, left_out_sentence
    from fmu_asset.ssp.reader import read_ssp

    _refuse_unwritable_files(out, plot, replace=replace)
    start_values = _values_by_name(values or ())
    for name, value in start_values.items():
        count = len(value.split(","))
        if count > 1:
            raise FmuInputError(
                f"--set {name} has {count} values; ends of a system take one number."
            )
    with tempfile.TemporaryDirectory() as folder:
        wiring = join_ssp(read_ssp(file, folder), delay or ())
        _warn(left_out_sentence(wiring, file))
        experiment = default_experiment(
            system_description(wiring),
            stop_time=stop_time,
            step_size=step_size,
            values=start_values,
        )
        open_asset = partial(
            CoupledAsset,
            wiring,
            _with_interpolation(experiment.binding, interpolation),
            algorithm=algorithm,  # type: ignore[arg-type]  # it checks this itself
            iterations=iterations,
            isolated=not in_process,
            parameters=experiment.parameters,
        )
        with closing(open_asset()) as asset:
            run = partial(run_experiment, experiment=experiment)
            history = _history_or_located_crash(asset, open_asset, run)
            _write_and_print_history(asset, history, file, out, plot)


def _refuse_unwritable_files(out: Path | None, plot: Path | None, *, replace: bool) -> None:
    """Raise an error for result files of an unknown format, or that may not be replaced.

    This is checked before the simulation, so that its result is not lost.
    """
    targets = (("--out", out, (".csv", ".nc")), ("--plot", plot, (".png", ".svg")))
    for option, path, suffixes in targets:
        if path is not None and path.suffix not in suffixes:
            raise FmuInputError(
                f"{path} must end in {' or '.join(suffixes)}: choose another {option}."
            )
        refuse_existing(path, replace=replace, option=option)


def _values_by_name(texts: Sequence[str]) -> dict[str, str]:
    """Return the values of `--set NAME=VALUE` by name.

    They stay texts, because only the type of the variable decides how its value is read.
    """
    values: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise FmuInputError(
                f"--set {text} cannot be read; write NAME=VALUE: a number, true or false, the name "
                "of an enumeration's item, a text, or several values with commas between."
            )
        values[name] = value
    return values


def _with_interpolation(binding: "Binding", kind: str | None) -> "Binding":
    """Return the binding with the given interpolation of inputs, if any."""
    if kind is None:
        return binding
    if kind not in ("zero-order", "linear"):
        raise FmuInputError(
            f"--interpolation must be zero-order or linear, but {kind!r} was given."
        )
    return binding.with_header(interpolation=kind)


def _write_and_print_history(
    asset: "FmiAsset",
    history: "ObservationHistory",
    file: Path,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Write a simulated history to `out`, draw it to `plot`, or print it as a table."""
    from fmu_asset.client.history_files import write_history
    from reporting.files import hash_file

    if out is not None:
        write_history(out, asset, (file.name, hash_file(file)), history)
    columns = _history_columns(asset, history)
    if plot is not None:
        _draw_history(plot, history, columns)
    end_time = history.time[-1] if len(history.time) else asset.time
    # Each row is a step, but the first row may be the state at the start
    steps = int((history.time > asset.binding.binding.start_time).sum())
    written_files = [str(path) for path in (out, plot) if path is not None]
    files = ", ".join(written_files) or file
    terminal.say(
        f"{files}: {steps} steps to t = {end_time:g} s, every {asset.binding.interval:g} s."
    )
    if history.ended:
        terminal.say(history.ended)
    if columns and not written_files:
        headings = ("output", "first", "least", "largest", "last", "unit")
        terminal.print_table(headings, [column.cells() for column in columns])


class HistoryColumn(NamedTuple):
    """An output over time: its name, its unit, and its value at each time of the history."""

    name: str
    unit: str
    values: "FloatArray"

    def cells(self) -> tuple[str, ...]:
        """Return the cells of a table: name, first, smallest, largest and last value, unit."""
        values = self.values
        figures = (values[0], values.min(), values.max(), values[-1])
        return (self.name, *(f"{figure:.6g}" for figure in figures), self.unit)


def _history_columns(asset: "FmiAsset", history: "ObservationHistory") -> list[HistoryColumn]:
    """Return a column for each observation of an asset, then for each recorded variable."""
    binding = asset.binding
    units = [unit for vector in binding.observation.values() for unit in vector.units]
    columns = [
        HistoryColumn(name, unit, values)
        for name, unit, values in zip(
            binding.observation_variables, units, history.values.T, strict=True
        )
    ]
    for name, values in history.extra.items():
        columns.append(HistoryColumn(name, asset.recorded_units[name], values))
    return columns


def _draw_history(
    path: Path, history: "ObservationHistory", columns: Sequence[HistoryColumn]
) -> None:
    """Draw the outputs over time, with one panel for each unit, and write the picture.

    At most `_MOST_PANELS` panels with `_MOST_LINES` lines each are drawn; a legend counts the
    omitted lines.
    """
    from reporting.pages.figures import FULL_WIDTH, new_figure, publication_style, to_png, to_svg

    columns_of_unit: dict[str, list[HistoryColumn]] = {}
    for column in columns:
        columns_of_unit.setdefault(column.unit, []).append(column)
    panels = list(columns_of_unit.items())[:_MOST_PANELS]
    with publication_style():
        # Height [inch]: 1.5 for each panel, and 0.5 for the label of the time axis
        figure = new_figure(0.5 + 1.5 * len(panels), FULL_WIDTH)
        axes = figure.subplots(len(panels), squeeze=False, sharex=True).ravel()
        for panel_axes, (unit, lines) in zip(axes, panels, strict=True):
            for line in lines[:_MOST_LINES]:
                panel_axes.plot(history.time, line.values, label=line.name)
            if len(lines) == 1:
                panel_axes.set_ylabel(f"{lines[0].name} [{unit}]")
                continue
            panel_axes.set_ylabel(f"[{unit}]")
            left_out = len(lines) - _MOST_LINES
            title = f" and {left_out} more" if left_out > 0 else None
            panel_axes.legend(title=title, loc="center left", bbox_to_anchor=(1.0, 0.5))
        axes[-1].set_xlabel("time [s]")
        figure.tight_layout()
        to_bytes = to_svg if path.suffix == ".svg" else to_png
        atomic_write_bytes(path, to_bytes(figure))


def sample(
    scenario: Annotated[
        str | None,
        typer.Argument(
            show_default=False,
            autocompletion=complete_scenario,
            help="A scenario, whose FMU is sampled at its states, controls and draws.",
        ),
    ] = None,
    *,
    out: Annotated[
        Path, typer.Option("--out", show_default=False, help="The NetCDF file to write.")
    ],
    fmu: Annotated[
        Path | None, typer.Option("--fmu", show_default=False, help="The FMU to sample.")
    ] = None,
    binding: Annotated[
        Path | None, typer.Option("--binding", show_default=False, help="Its binding.")
    ] = None,
    grid: Annotated[
        list[str] | None,
        typer.Option(
            "--grid",
            show_default=False,
            help="NAME=VALUES with a name of the binding, such as wear=0,0.2,0.4 or "
            "wear=0:0.4:3; repeated.",
        ),
    ] = None,
    role: Annotated[
        str | None,
        typer.Option(
            "--role",
            show_default=False,
            help="Observation of the binding, where it has several.",
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", min=0, help="Seed of the draws of a scenario."),
    ] = None,
    settle: Annotated[
        int,
        typer.Option(
            "--settle",
            min=0,
            help="Steps from a fresh start at every point, for an FMU with memory.",
        ),
    ] = 0,
    workers: Annotated[
        int | None,
        typer.Option("--workers", min=1, show_default="one for each processor", help="Processes."),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Go on with the blocks of an interrupted sampling."),
    ] = False,
    replace: ReplaceOption = False,
) -> None:
    """Sample an FMU at every draw, state and control, and write an observation library.

    Example: `uav-twin library sample pump_wear --out pump_wear.nc`
    """
    from twin_master.assets.resolution import Overrides
    from twin_master.library.grid import grid_of_fmu, grid_of_scenario
    from twin_master.library.sampling import blocks_folder, sample_library
    from twin_master.scenario.reading import load_scenario

    if resume and replace:
        raise typer.BadParameter("give either --resume or --replace.", param_hint="--resume")
    if scenario is not None and role is not None:
        raise typer.BadParameter("the scenario says what is observed.", param_hint="--role")

    def sentence_when_interrupted() -> str:
        if blocks_folder(out).is_dir():
            return "finished blocks are kept: go on with the same command and --resume"
        return "finished blocks are kept: nothing was sampled yet"

    with (
        terminal.interruptible(sentence_when_interrupted),
        tempfile.TemporaryDirectory(prefix="uav_twin_library_") as folder,
    ):
        if scenario is not None:
            library_grid = grid_of_scenario(
                load_scenario(scenario),
                Path(folder),
                grid or (),
                overrides=Overrides(seed=seed, fmu=fmu, binding=binding),
                settling_steps=settle,
            )
        elif fmu is None or binding is None:
            raise typer.BadParameter(
                "give a scenario, or --fmu and --binding.", param_hint="SCENARIO"
            )
        else:
            library_grid = grid_of_fmu(fmu, binding, grid or (), role=role, settling_steps=settle)
        sampling_outcome = sample_library(
            library_grid, out, workers=workers, resume=resume, replace_existing=replace
        )
    _print_library(sampling_outcome)


def _print_library(outcome: "SamplingOutcome") -> None:
    """Print the file and shape of an observation library, and the effort of its sampling.

    After an interruption, the number of blocks that were not sampled again is added.
    """
    library = outcome.library
    shape = " x ".join(map(str, library.values.shape))
    kept_blocks = ""
    if outcome.kept_blocks:
        kept_blocks = f", {outcome.kept_blocks} of {outcome.block_count} blocks kept"
    terminal.say(
        f"{outcome.path}: {shape} (draws, states, controls, sensors), {outcome.workers} processes, "
        f"{outcome.seconds:.1f} s{kept_blocks}, FMU {library.fmu_hash[:12]}"
    )
