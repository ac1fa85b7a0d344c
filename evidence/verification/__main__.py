"""What `uav-twin wing verify` need not repeat for each wing: `python -m evidence.verification`.

Called in a checkout of the project: the elements against known answers, test decks of CalculiX against its
published results, and a ring-down of the wing against CalculiX, where these are installed.
`docs/explanation/verification.md` says what came out. Ends with 1 if a limit is broken.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from evidence.verification import known_answers as answers
from evidence.verification.calculix_examples import DECKS, NAMES, published_difference
from evidence.verification.ring_down import ring_down_agreement
from fe.runtime.state import DigitalState
from fe.verification.calculix_run import calculix_program
from fe.verification.wing_checks import Check
from fe.wing.design import load_design
from fe.wing.operators import AffineOperators, assemble
from reporting import terminal
from twin_master.command import run_command_line
from uav_twin.check_table import exit_if_broken, print_checks

# R. H. MacNeal and R. L. Harder (1985), table 3, HEX20: in plane and out of plane.
MACNEAL_HARDER = {"regular": (0.970, 0.961), "trapezoid": (0.886, 0.920), "parallelogram": (0.967, 0.941)}


def check(
    design: Annotated[Path | None, typer.Option(help="Wing design; the shipped one by default.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A quarter of a period of ring-down.")] = False,
) -> None:
    """Check the elements against known answers, and a ring-down against CalculiX."""
    checks = [*element_checks(), *example_checks()]
    if calculix_program() is not None:
        coarse = assemble(load_design(design).changed(mesh={"refinement": 0.25}))
        with tempfile.TemporaryDirectory(prefix="uav-twin-") as folder:
            checks += ring_down_checks(coarse, Path(folder), 0.25 if quick else 5.0)
    print_checks(checks)
    exit_if_broken(checks)


def element_checks() -> Iterator[Check]:
    """Yield the checks of the element and the assembly on bodies of their own."""
    for name, error in zip(("displacement", "strain"), answers.patch_test(), strict=True):
        yield Check("patch test", name, error, 1e-12)
    rigid = answers.rigid_body_values()
    apart = abs(int((rigid < 1e-12).sum()) - 6)
    yield Check("unsupported body", "zero eigenvalues, difference to 6", apart, 0.0)
    yield Check("unsupported body", "sixth eigenvalue over the largest", float(rigid[5]), 1e-12)
    yield Check("cantilever", "against Timoshenko's beam", abs(answers.cantilever_check()), 1e-3)
    for shape, published in MACNEAL_HARDER.items():
        for across, value in zip((True, False), published, strict=True):
            found = answers.macneal_harder_beam(shape, across_depth=across)
            name = f"{shape}, {'in' if across else 'out of'} plane, against HEX20"
            yield Check("MacNeal-Harder", name, abs(found - value), 6e-4, f"({found:.4f}, {value:.3f})")


def example_checks() -> Iterator[Check]:
    """Yield the differences to published results of CalculiX, where its test decks are installed."""
    for name in NAMES if DECKS.is_dir() else ():
        with tempfile.TemporaryDirectory(prefix="uav-twin-") as folder:
            found = published_difference(name, Path(folder))
        yield Check("CalculiX, published", name, found, 1e-6)


def ring_down_checks(operators: AffineOperators, jobs: Path, periods: float) -> Iterator[Check]:
    """Yield the difference of a ring-down to direct integration by CalculiX."""
    ours, theirs, same = ring_down_agreement(operators, jobs, DigitalState(), periods)
    note = f"({len(ours)} increments, {operators.unknowns} unknowns)"
    apart, apart_same = (float(abs(theirs - found).max()) for found in (ours, same))
    yield Check("CalculiX", f"ring-down over {periods:g} periods", apart, 0.01, note)
    yield Check("CalculiX", "the same, both by the trapezoidal rule", apart_same, 1e-3)


def main() -> None:
    """Run `python -m evidence.verification`."""
    application = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    application.command()(check)
    run_command_line(
        lambda: terminal.with_common_options(application)(prog_name="python -m evidence.verification")
    )


if __name__ == "__main__":
    main()
