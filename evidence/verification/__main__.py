"""Check the elements and a ring-down: `python -m evidence.verification`.

These checks need not be repeated for each wing, so `uav-twin wing verify` does not make them. Call
the command in a checkout of the project. It compares the elements with known answers, test decks of
CalculiX with its published results, and a ring-down of the wing with CalculiX. Those of CalculiX
are left out if decks or program are not installed. `docs/explanation/verification.md` has the
results. The exit code is 1 if a limit is broken.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, NamedTuple

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

RIGID_MODES = 6


class BeamDeflections(NamedTuple):
    """Tip deflections of a beam over the exact ones, in plane and out of plane."""

    in_plane: float
    out_of_plane: float


MACNEAL_HARDER = {
    "regular": BeamDeflections(in_plane=0.970, out_of_plane=0.961),
    "trapezoid": BeamDeflections(in_plane=0.886, out_of_plane=0.920),
    "parallelogram": BeamDeflections(in_plane=0.967, out_of_plane=0.941),
}
"""Published deflections of HEX20: R. H. MacNeal and R. L. Harder (1985), table 3."""


def check(
    design: Annotated[
        Path | None, typer.Option(help="Wing design; the shipped one by default.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="A quarter of a period of ring-down.")
    ] = False,
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
    patch_test = answers.patch_test()
    yield Check("patch test", "displacement", patch_test.displacement, 1e-12)
    yield Check("patch test", "strain", patch_test.strain, 1e-12)

    eigenvalues = answers.rigid_body_values()
    zero_count = int((eigenvalues < 1e-12).sum())
    sixth = float(eigenvalues[RIGID_MODES - 1])
    yield Check(
        "unsupported body", "zero eigenvalues, difference to 6", abs(zero_count - RIGID_MODES), 0.0
    )
    yield Check("unsupported body", "sixth eigenvalue over the largest", sixth, 1e-12)
    yield Check("cantilever", "against Timoshenko's beam", abs(answers.cantilever_check()), 1e-3)

    for shape, published in MACNEAL_HARDER.items():
        in_plane = answers.macneal_harder_beam(shape, across_depth=True)
        out_of_plane = answers.macneal_harder_beam(shape, across_depth=False)
        yield _beam_check(f"{shape}, in plane", in_plane, published.in_plane)
        yield _beam_check(f"{shape}, out of plane", out_of_plane, published.out_of_plane)


def _beam_check(case: str, deflection: float, published: float) -> Check:
    """Return the difference of a beam's tip deflection to the published one."""
    return Check(
        "MacNeal-Harder",
        f"{case}, against HEX20",
        abs(deflection - published),
        6e-4,
        f"({deflection:.4f}, {published:.3f})",
    )


def example_checks() -> Iterator[Check]:
    """Yield the differences to published results of CalculiX, if its test decks are installed."""
    for name in NAMES if DECKS.is_dir() else ():
        with tempfile.TemporaryDirectory(prefix="uav-twin-") as folder:
            difference = published_difference(name, Path(folder))
        yield Check("CalculiX, published", name, difference, 1e-6)


def ring_down_checks(operators: AffineOperators, jobs: Path, periods: float) -> Iterator[Check]:
    """Yield the difference of a ring-down to direct integration by CalculiX.

    Parameters
    ----------
    operators : AffineOperators
        The wing.
    jobs : Path
        Folder in which CalculiX works.
    periods : float
        Length of the ring-down in periods of the first mode.
    """
    ring_downs = ring_down_agreement(operators, jobs, DigitalState(), periods)
    note = f"({len(ring_downs.modal)} increments, {operators.unknowns} unknowns)"
    difference = float(abs(ring_downs.calculix - ring_downs.modal).max())
    same_rule_difference = float(abs(ring_downs.calculix - ring_downs.modal_trapezoidal).max())
    yield Check("CalculiX", f"ring-down over {periods:g} periods", difference, 0.01, note)
    yield Check("CalculiX", "the same, both by the trapezoidal rule", same_rule_difference, 1e-3)


def main() -> None:
    """Run `python -m evidence.verification`."""
    application = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    application.command()(check)
    run_command_line(
        lambda: terminal.with_common_options(application)(
            prog_name="python -m evidence.verification"
        )
    )


if __name__ == "__main__":
    main()
