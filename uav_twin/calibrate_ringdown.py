"""`uav-twin calibrate ringdown`: two modes from ring-down records."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from reporting import terminal


def calibrate_ringdown(
    data: Annotated[Path, typer.Option(help="Ring-down records: the authors' folder, or one file.")],
    out: Annotated[Path | None, typer.Option(help="Folder for table and figures.")] = None,
    fitted: Annotated[
        bool,
        typer.Option("--fitted", help="Fit the frequencies too; by default those of the spectral peaks."),
    ] = False,
    extremes: Annotated[
        bool,
        typer.Option("--extremes", help="Fit the extremes of records read off a plot, not the middle."),
    ] = False,
    start: Annotated[
        float | None, typer.Option(min=0.0, help="Where records are cropped [s]; the first peak by default.")
    ] = None,
) -> None:
    """Natural frequencies and damping ratios of two modes from ring-down records."""
    from calibration.dynamics.extremes import refine_by_extremes
    from calibration.dynamics.records import read_records
    from calibration.dynamics.ringdown import FIRST_PEAK, Frequencies
    from calibration.dynamics.trials import (
        PUBLISHED_DAMPING_RATIOS,
        PUBLISHED_FREQUENCIES,
        fit_trials,
    )

    procedure = Frequencies.FITTED if fitted else Frequencies.PEAKS
    trials = fit_trials(read_records(data), procedure, start=FIRST_PEAK if start is None else start)
    if extremes:
        trials = refine_by_extremes(trials)
    headings = ("figure", "unit", "found", "between trials", "standard error", "paper")
    rows = [
        (f"mode {mode + 1}, {name}", unit, (*found(mode), published[mode]))
        for mode in (0, 1)
        for name, unit, found, published in (
            ("natural frequency", "Hz", trials.frequency, PUBLISHED_FREQUENCIES),
            ("damping ratio", "1", trials.damping_ratio, PUBLISHED_DAMPING_RATIOS),
        )
    ]
    terminal.print_table(headings, _cells(rows, ".5g"))
    if out is not None:
        from calibration.dynamics.figures import ring_down_figure
        from reporting.figures import to_png, to_svg
        from reporting.files import atomic_write_bytes, atomic_write_text

        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows((headings, *_cells(rows, ".10g")))
        atomic_write_text(out / "ringdown.csv", text.getvalue())
        figure = ring_down_figure(trials)
        atomic_write_bytes(out / "figures" / "ringdown.svg", to_svg(figure))
        atomic_write_bytes(out / "figures" / "ringdown.png", to_png(figure))


def _cells(rows: Sequence[tuple[str, str, tuple[float, ...]]], digits: str) -> list[tuple[str, ...]]:
    return [(figure, unit, *(format(value, digits) for value in values)) for figure, unit, values in rows]
