"""Identify the numbers of the shipped wing's design from the published model.

Call `python -m evidence.identification --data DIR` in a checkout of the project. `DIR` holds clones
of the authors' repositories UAV-Digital-Twin and UAV-Experimental-Calibration. `--out RESULT`
writes a design file, a record and a report, `--from-prior` begins at the prior means, `--design
FILE` begins at another design, `--steps N` limits the number of full models, and `--remesh FACTOR`
also evaluates the result on another mesh. `docs/explanation/identification.md` explains what is
fitted to what, how, and with which result. The exit code is 1 if the fit has not converged.
"""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from evidence.identification.identified import Identification
from evidence.identification.report import REACHED_TEXT
from evidence.identification.workflow import run_identification, write_identification
from fe.wing.design import load_design
from reporting import terminal
from reporting.errors import FileNotWrittenError
from twin_master.command import run_command_line


def identify(
    data: Annotated[
        Path,
        typer.Option(
            help="Folder with the authors' UAV-Digital-Twin and UAV-Experimental-Calibration."
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder for the design file, the record and the report.")
    ] = None,
    design: Annotated[
        Path | None, typer.Option(help="Start; the shipped wing design by default.")
    ] = None,
    from_prior: Annotated[
        bool, typer.Option("--from-prior", help="Begin with every free number at its prior mean.")
    ] = False,
    steps: Annotated[
        int, typer.Option(min=1, max=1000, help="Largest number of full models.")
    ] = 15,
    remesh: Annotated[
        list[float] | None,
        typer.Option(
            help="Evaluate the result again on a mesh this much finer; may be given several times."
        ),
    ] = None,
) -> None:
    """Fit the free numbers of the wing design to outputs of the published model; takes minutes."""
    if out is not None and out.exists() and not out.is_dir():
        raise FileNotWrittenError(f"{out} exists and is not a folder: choose another --out.")
    result = run_identification(
        data,
        load_design(design),
        from_prior=from_prior,
        largest_count=steps,
        refinements=remesh or (),
        progress=terminal.progress(),
    )
    console = terminal.console()
    _show(result, console)
    if out is not None:
        for path in write_identification(result, out):
            console.print(f"Wrote {path}", soft_wrap=True)
    if not result.fit.converged:
        stopped = len(result.fit.iterations) < steps
        advice = "no shorter step lowers the objective" if stopped else "repeat with more --steps"
        typer.echo(f"The fit has not converged; {advice}.", err=True)
        raise typer.Exit(1)


def _show(result: Identification, console: Console) -> None:
    """Print the comparison and the end of the fit."""
    table = Table("output", "unit", "wanted", "start", "identified", "kept", "fitted")
    for row, row_before in zip(result.comparison, result.before, strict=True):
        limits = (row.wanted_rms, row.wanted_largest)
        table.add_row(
            row.name,
            "" if row.unit == "1" else row.unit,
            " / ".join(f"{limit:g}" for limit in limits if limit is not None),
            f"{row_before.rms:.3g} / {row_before.largest:+.3g}",
            f"{row.rms:.3g} / {row.largest:+.3g}",
            REACHED_TEXT[row.reached],
            "" if row.fitted else "held out",
        )
    console.print(table)
    fit = result.fit
    last = fit.iterations[-1]
    remark = " (as far as allowed)" if last.limited else ""
    console.print(
        f"Objective {last.objective:.3f} after {len(fit.iterations)} models; the next step would "
        "change no "
        f"number by more than {last.largest_step:.4f} prior deviations{remark}, and the start lies "
        f"{result.largest_change:.4f} away."
    )


def main() -> None:
    """Run `python -m evidence.identification`."""
    application = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    application.command()(identify)
    run_command_line(
        lambda: terminal.with_common_options(application)(
            prog_name="python -m evidence.identification"
        )
    )


if __name__ == "__main__":
    main()
