"""`uav-twin fmu simulate`, `ssp simulate` and `library sample`: runs of FMUs and their systems."""

import tempfile
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import typer

from fmu_asset.errors import FmuInputError
from reporting import terminal
from reporting.files import atomic_write_bytes, refuse_existing
from uav_twin import parts
from uav_twin.options import show

if TYPE_CHECKING:
    from fe.runtime.arrays import FloatArray


_MOST_PANELS = 8
"""Largest number of panels of a plot."""


_MOST_LINES = 10
"""Largest number of lines in a panel."""


def simulate(
    file: Path,
    *,
    binding: Path | None = None,
    inputs: Path | None = None,
    out: Path | None = None,
    stop_time: float | None = None,
    step_size: float | None = None,
    values: list[str] | None = None,
    plot: Path | None = None,
    interpolation: str | None = None,
    in_process: bool = False,
    step_timeout: float | None = None,
    replace: bool = False,
) -> None:
    """Simulate an FMU: its default experiment, or with --binding and --inputs under histories."""
    _refuse_files(out, plot, replace=replace)
    if (binding is None) != (inputs is None):
        raise FmuInputError(
            "--binding and --inputs go together: one names the columns of the other."
        )
    if binding is not None and (stop_time is not None or step_size is not None or values):
        raise FmuInputError(
            "--stop-time, --step-size and --set are for a simulation without --binding, which says "
            "these itself."
        )
    if interpolation is not None and inputs is None:
        raise FmuInputError(
            "--interpolation says how inputs go on between the rows of --inputs: give these."
        )
    isolated = not in_process
    if binding is None:
        experiment = parts.default_experiment(
            parts.read_fmu(file),
            stop_time=stop_time,
            step_size=step_size,
            values=_values_by_name(values or ()),
        )
        with closing(
            parts.FmiAsset(file, experiment.binding, isolated=isolated, step_timeout=step_timeout)
        ) as asset:
            _finish(asset, parts.run_experiment(asset, experiment), file, out, plot)
        return
    assert inputs is not None  # they go with a binding
    fmu_binding = _interpolated(parts.load_binding(binding), interpolation)
    steps, histories = parts.read_histories(inputs, fmu_binding)
    fmu_binding = parts.ending_with_histories(fmu_binding, steps)
    with closing(
        parts.FmiAsset(file, fmu_binding, isolated=isolated, step_timeout=step_timeout)
    ) as asset:
        _finish(asset, parts.run_histories(asset, steps, histories), file, out, plot)


def simulate_system(
    file: Path,
    *,
    out: Path | None = None,
    stop_time: float | None = None,
    step_size: float | None = None,
    values: list[str] | None = None,
    plot: Path | None = None,
    algorithm: str = "gauss_seidel",
    iterations: int = 1,
    delay: list[str] | None = None,
    interpolation: str | None = None,
    in_process: bool = False,
    replace: bool = False,
) -> None:
    """Simulate the system of an SSP file from its start; all outputs of the system and its components."""  # noqa: E501
    _refuse_files(out, plot, replace=replace)
    start_values = _values_by_name(values or ())
    for name, value in start_values.items():
        count = len(value.split(","))
        if count > 1:
            raise FmuInputError(
                f"--set {name} has {count} values; ends of a system take one number."
            )
    with tempfile.TemporaryDirectory() as folder:
        wiring = parts.join_ssp(parts.read_ssp(file, folder), delay or ())
        warning = parts.left_out_sentence(wiring, file)
        if warning:
            terminal.say(f"warning: {warning}")
        experiment = parts.default_experiment(
            parts.system_description(wiring),
            stop_time=stop_time,
            step_size=step_size,
            values=start_values,
        )
        with parts.CoupledAsset(
            wiring,
            _interpolated(experiment.binding, interpolation),
            algorithm=algorithm,  # type: ignore[arg-type]  # said by itself
            iterations=iterations,
            isolated=not in_process,
            parameters=experiment.parameters,
        ) as asset:
            _finish(asset, parts.run_experiment(asset, experiment), file, out, plot)


def _refuse_files(out: Path | None, plot: Path | None, *, replace: bool) -> None:
    """Refuse files that cannot be written, before anything is simulated."""
    targets = (("--out", out, (".csv", ".nc")), ("--plot", plot, (".png", ".svg")))
    for option, path, suffixes in targets:
        if path is not None and path.suffix not in suffixes:
            raise FmuInputError(
                f"{path} must end in {' or '.join(suffixes)}: choose another {option}."
            )
        refuse_existing(path, replace=replace, option=option)


def _values_by_name(texts: Sequence[str]) -> dict[str, str]:
    """Return the values of `--set NAME=VALUE` by name, as texts that the variables interpret."""
    values: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise FmuInputError(
                f"--set {text} is not understood; write NAME=VALUE: a number, true or false, the "
                "name of an enumeration's item, a text, or several values with commas between."
            )
        values[name] = value
    return values


def _interpolated(binding: "parts.Binding", kind: str | None) -> "parts.Binding":
    """Return a binding whose inputs are interpolated as `--interpolation` says, if it is given."""
    if kind is None:
        return binding
    if kind not in ("zero-order", "linear"):
        raise FmuInputError(f"--interpolation must be zero-order or linear, and {kind!r} came.")
    return binding.with_header(interpolation=kind)


def _finish(
    asset: "parts.FmiAsset",
    history: "parts.ObservationHistory",
    file: Path,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Write and draw a simulated history, and print where it is; if nowhere, print its end.

    Parameters
    ----------
    asset : FmiAsset
        The FMU, at the end of the simulation.
    history : ObservationHistory
        Its outputs over time.
    file : Path
        The file of the FMU.
    out, plot : Path or None
        Files for the history and for its picture.
    """
    if out is not None:
        parts.write_history(out, asset, (file.name, parts.hash_file(file)), history)
    columns = _history_columns(asset, history)
    if plot is not None:
        _draw(plot, history, columns)
    show(
        "simulated",
        asset=asset,
        history=history,
        written=[path for path in (out, plot) if path is not None],
        file=file,
        end=history.time[-1] if len(history.time) else asset.time,
        # the start may be a row of its own
        steps=int((history.time > asset.binding.binding.start_time).sum()),
        columns=columns,
    )


class HistoryColumn(NamedTuple):
    """An output over time: its name, its unit, and its values (N,)."""

    name: str
    unit: str
    values: "FloatArray"


def _history_columns(
    asset: "parts.FmiAsset", history: "parts.ObservationHistory"
) -> list[HistoryColumn]:
    """Return the observed outputs of an asset over time, then what is recorded beside them."""
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


def _draw(
    path: Path, history: "parts.ObservationHistory", columns: Sequence[HistoryColumn]
) -> None:
    """Draw the outputs over time, those of one unit in one panel, and write the picture."""
    columns_of_unit: dict[str, list[HistoryColumn]] = {}
    for column in columns:
        columns_of_unit.setdefault(column.unit, []).append(column)
    panels = list(columns_of_unit.items())[:_MOST_PANELS]
    with parts.publication_style():
        figure = parts.new_figure(0.5 + 1.5 * len(panels), parts.FULL_WIDTH)
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
        to_bytes = parts.to_svg if path.suffix == ".svg" else parts.to_png
        atomic_write_bytes(path, to_bytes(figure))


def sample(
    scenario: str | None = None,
    *,
    out: Path,
    fmu: Path | None = None,
    binding: Path | None = None,
    grid: list[str] | None = None,
    role: str | None = None,
    seed: int | None = None,
    settle: int = 0,
    workers: int | None = None,
    resume: bool = False,
    replace: bool = False,
) -> None:
    """Ask an FMU for its observation at every draw, state and control; write an observation library."""  # noqa: E501
    if resume and replace:
        raise typer.BadParameter("give either --resume or --replace.", param_hint="--resume")
    if scenario is not None and role is not None:
        raise typer.BadParameter("the scenario says what is observed.", param_hint="--role")

    def sentence_when_interrupted() -> str:
        if parts.blocks_folder(out).is_dir():
            return "finished blocks are kept: go on with the same command and --resume"
        return "finished blocks are kept: nothing was sampled yet"

    with (
        terminal.interruptible(sentence_when_interrupted),
        tempfile.TemporaryDirectory(prefix="uav_twin_library_") as folder,
    ):
        if scenario is not None:
            library_grid = parts.grid_of_scenario(
                parts.load_scenario(scenario),
                Path(folder),
                grid or (),
                overrides=parts.Overrides(seed=seed, fmu=fmu, binding=binding),
                settling_steps=settle,
            )
        elif fmu is None or binding is None:
            raise typer.BadParameter(
                "give a scenario, or --fmu and --binding.", param_hint="SCENARIO"
            )
        else:
            library_grid = parts.grid_of_fmu(
                fmu, binding, grid or (), role=role, settling_steps=settle
            )
        sampled = parts.sample_library(
            library_grid, out, workers=workers, resume=resume, replace_existing=replace
        )
    show("library", found=sampled, library=sampled.library)
