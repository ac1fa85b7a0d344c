"""`uav-twin fmu simulate`, and what simulations of an FMU or a system take, say, draw and leave."""

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from fmu_asset.errors import FmuInputError
from reporting import terminal
from reporting.files import atomic_write_bytes, refuse_existing
from uav_twin.options import told
from uav_twin.sentences import said

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from fmu_asset.door.binding import Binding
    from fmu_asset.door.layout import ObservationHistory
    from fmu_asset.door.session import FmiAsset


_MOST_PANELS, _MOST_LINES = 8, 10


def refuse_files(out: Path | None, plot: Path | None, *, replace: bool) -> None:
    """Refuse files that cannot be written, before anything is simulated."""
    for path, suffixes, option in ((out, (".csv", ".nc"), "--out"), (plot, (".png", ".svg"), "--plot")):
        if path is not None and path.suffix not in suffixes:
            raise FmuInputError(f"{path} must end in {' or '.join(suffixes)}: choose another {option}.")
        refuse_existing(path, replace=replace, option=option)


def values_of(texts: list[str]) -> dict[str, float | list[float]]:
    """Return values by name: numbers, true and false, or for an array several with commas between."""
    found: dict[str, float | list[float]] = {}
    for text in texts:
        name, sign, value = text.rpartition("=")
        words = [{"true": "1", "false": "0"}.get(word.strip(), word) for word in value.split(",")]
        try:
            numbers = [float(word) for word in words]
        except ValueError:
            numbers = []
        if not (name and sign and numbers):
            raise FmuInputError(said("fmu.set", text=text))
        found[name] = numbers[0] if len(numbers) == 1 else numbers
    return found


def interpolated(binding: "Binding", kind: str | None) -> "Binding":
    """Return a binding with inputs that go on between communication points as `--interpolation` says."""
    if kind is None:
        return binding
    if kind not in ("zero-order", "linear"):
        raise FmuInputError(f"--interpolation must be zero-order or linear, and {kind!r} came.")
    return binding.with_header(interpolation=kind)


def finish(
    asset: "FmiAsset",
    history: "ObservationHistory",
    source: tuple[Path, str],
    out: Path | None,
    plot: Path | None,
) -> None:
    """Write and draw what was simulated from `source`, a file and its SHA-256, and say so."""
    from fmu_asset.door.experiment import write_history

    file, digest = source
    if out is not None:
        write_history(out, asset, (file.name, digest), history)
    if plot is not None:
        _draw(plot, asset, history)
    _say(asset, history, file, [path for path in (out, plot) if path is not None])


def _say(asset: "FmiAsset", history: "ObservationHistory", file: Path, written: list[Path]) -> None:
    """Say what was simulated; where nothing was written, what stands at the end."""
    end = history.time[-1] if len(history.time) else asset.time
    where = ", ".join(map(str, written))
    # The start may be a row of its own.
    steps = int((history.time > asset.binding.binding.start_time).sum())
    terminal.say(f"{where or file}: {steps} steps to t = {end:g} s, every {asset.binding.interval:g} s.")
    if history.ended:
        terminal.say(history.ended)
    if not where:
        rows = [
            (name, *(f"{value:.6g}" for value in (v[0], v.min(), v.max(), v[-1])), unit)
            for name, unit, v in _columns(asset, history)
        ]
        headings = ("output", "first", "least", "largest", "last", "unit")
        terminal.print_table(headings, rows)


def _columns(
    asset: "FmiAsset", history: "ObservationHistory"
) -> "list[tuple[str, str, npt.NDArray[np.float64]]]":
    """Return name, unit and values of every output."""
    binding, units = asset.binding, asset.recorded_units
    observed = [unit for vector in binding.observation.values() for unit in vector.units]
    names = zip(binding.observation_variables, observed, history.values.T, strict=True)
    return [*names, *((name, units[name], values) for name, values in history.extra.items())]


def _draw(path: Path, asset: "FmiAsset", history: "ObservationHistory") -> None:
    """Draw the outputs over time, those of one unit in one panel, and write the picture."""
    from reporting.figures import FULL_WIDTH, new_figure, publication_style, to_png, to_svg

    panels: dict[str, list[tuple[str, npt.NDArray[np.float64]]]] = {}
    for name, unit, values in _columns(asset, history):
        panels.setdefault(unit, []).append((name, values))
    shown = dict(list(panels.items())[:_MOST_PANELS])
    with publication_style():
        figure = new_figure(0.5 + 1.5 * len(shown), FULL_WIDTH)
        axes = figure.subplots(len(shown), squeeze=False, sharex=True)[:, 0]
        for panel, (unit, lines) in zip(axes, shown.items(), strict=True):
            for name, values in lines[:_MOST_LINES]:
                panel.plot(history.time, values, label=name)
            more = f" and {len(lines) - _MOST_LINES} more" if len(lines) > _MOST_LINES else ""
            panel.set_ylabel(lines[0][0] + f" [{unit}]" if len(lines) == 1 else f"[{unit}]")
            if len(lines) > 1:
                panel.legend(title=more or None, loc="center left", bbox_to_anchor=(1.0, 0.5))
        axes[-1].set_xlabel("time [s]")
        figure.tight_layout()
        atomic_write_bytes(path, to_svg(figure) if path.suffix == ".svg" else to_png(figure))


@told("fmu simulate")
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
    from fmu_asset.archive.fmu_file import read_fmu
    from fmu_asset.door.binding import load_binding
    from fmu_asset.door.experiment import default_experiment, fly, fly_histories, read_histories
    from fmu_asset.door.session import FmiAsset

    refuse_files(out, plot, replace=replace)
    _refuse_mixture(
        binding, inputs, interpolation, others=stop_time is not None or step_size is not None or bool(values)
    )
    if binding is not None and inputs is not None:
        bound = interpolated(load_binding(binding), interpolation)
        asset = FmiAsset(file, bound, isolated=not in_process, step_timeout=step_timeout)
        given = read_histories(inputs, asset.binding)
    else:
        planned = default_experiment(
            read_fmu(file), stop_time=stop_time, step_size=step_size, values=values_of(values or [])
        )
        asset = FmiAsset(file, planned.binding, isolated=not in_process, step_timeout=step_timeout)
    with closing(asset):
        if inputs is not None:
            history = fly_histories(asset, given, terminal.progress())
        else:
            history = fly(asset, planned, terminal.progress())
        finish(asset, history, (file, asset.description.sha256), out, plot)


def _refuse_mixture(
    binding: Path | None, inputs: Path | None, interpolation: str | None, *, others: bool
) -> None:
    """Refuse half of a simulation under histories, and one that is half without."""
    if (binding is None) != (inputs is None):
        raise FmuInputError("--binding and --inputs go together: one names the columns of the other.")
    if binding is not None and others:
        raise FmuInputError(said("fmu.without_binding"))
    if interpolation is not None and inputs is None:
        raise FmuInputError("--interpolation says how inputs go on between the rows of --inputs: give these.")
