"""The report of an identification: one self-contained page."""

import itertools
from collections.abc import Sequence

from reporting.pages.figures import to_svg
from reporting.pages.page import Block, Highlights, Notice, Page, PageFigure, Section, render_page
from reporting.pages.table import PageColumn, Table, number_column

from .comparison import PERCENT, Comparison
from .figures import gauge_figure, identifiability_figure, profile_figure
from .identified import Identification, RemeshedComparison
from .parameters import deviations, scaled

SOURCE = (
    "M. G. Kapteyn, J. V. R. Pretorius, K. E. Willcox: A probabilistic graphical model foundation "
    "for "
    "enabling predictive digital twins at scale. Nature Computational Science 1 (2021) 337-347. "
    "doi:10.1038/s43588-021-00069-0; data: the repositories UAV-Digital-Twin and "
    "UAV-Experimental-Calibration."
)

REACHED_TEXT = {True: "yes", False: "no", None: ""}
"""Text on whether an output keeps its limits; None if it has no limits."""
WEAK_DIRECTIONS = 6
"""Number of weak directions in the report."""


def report_page(result: Identification) -> str:
    """Return the report as HTML."""
    fit = result.fit
    not_converged = None
    if not fit.converged:
        not_converged = Notice(
            "The fit has not converged: its next step is larger than the stated tolerance."
        )
    rows_with_limits = [row for row in result.comparison if row.reached is not None]
    reached_count = sum(bool(row.reached) for row in rows_with_limits)
    last = fit.iterations[-1]
    values = Highlights(
        [
            (f"{last.objective:.1f}", "objective (half the sum of squares)"),
            (
                f"{result.analysis.effective_count:.1f} of {len(fit.parameters)}",
                "numbers the data determine",
            ),
            (f"{last.largest_step:.3f}", "next step, in prior standard deviations"),
        ]
    )
    gauges = gauge_figure(result.outputs, result.outputs_before, result.targets)
    page = Page(
        "Identification of the wing design",
        f"{len(fit.parameters)} numbers of '{fit.design.name}' fitted to outputs of the published "
        "model",
        sentence=f"{reached_count} of {len(rows_with_limits)} wanted limits are kept.",
        picture=PageFigure(
            "gauges",
            to_svg(gauges),
            "Residuals by gauge",
            "Model less published: (a) relative, (b) of d ln strain / d ln e, (c), (d) of strain "
            "over healthy strain.",
        ),
        outcome=[not_converged, values],
        sections=[
            Section(
                "Outputs",
                [
                    comparison_table(result.comparison, result.before),
                    remeshed_table(result.remeshed) if result.remeshed else None,
                ],
            ),
            Section("Free numbers", [_parameter_table(result)]),
            Section("What the data tell", _identifiability(result)),
            Section("Way of the fit", [_iteration_table(result)]),
        ],
        footer=(SOURCE, f"Design {fit.design.hash[:16]}."),
    )
    return render_page(page)


def _identifiability(result: Identification) -> list[Block]:
    """Return what the data determine, what the prior does, and the objective about the fit."""
    profiles = None
    if result.profiles:
        profiles = PageFigure(
            "profiles",
            to_svg(profile_figure(result.profiles)),
            "Profiles",
            "Objective along one number with all others fitted again, on the reduced model of the "
            "last step.",
        )
    return [
        PageFigure(
            "identifiability",
            to_svg(identifiability_figure(result.fit, result.analysis)),
            "Identifiability",
            "(a) Below one, the prior decides along a direction. (b) One: the data tell nothing of "
            "the number.",
        ),
        _direction_table(result),
        Table(
            (PageColumn("number"), number_column("imitated", "%")),
            [(name, f"{PERCENT * fraction:.1f}") for name, fraction in result.analysis.fixed],
            "Numbers that were held",
            "Which share of the effect of a number that was not free the free ones can imitate.",
        ),
        profiles,
    ]


def comparison_table(
    comparison: Sequence[Comparison], comparison_before: Sequence[Comparison]
) -> Table:
    """Return the comparison after the fit, and that of the start, as a table."""
    columns = (
        PageColumn("output"),
        PageColumn("unit"),
        PageColumn("wanted rms"),
        PageColumn("wanted largest"),
        number_column("start", "rms / largest"),
        number_column("identified", "rms / largest"),
        PageColumn("where"),
        PageColumn("kept"),
        PageColumn("fitted"),
    )
    rows = []
    for row, row_before in zip(comparison, comparison_before, strict=True):
        rows.append(
            (
                row.name,
                _unit_text(row.unit),
                _limit_text(row.wanted_rms),
                _limit_text(row.wanted_largest),
                _difference_text(row_before),
                _difference_text(row),
                row.where,
                REACHED_TEXT[row.reached],
                "yes" if row.fitted else "held out",
            )
        )
    return Table(
        columns,
        rows,
        "Every output beside the published one",
        "Differences, model less published. Fitted: the numbers of the design were fitted to it. "
        "Where levels are mixed, the lines below say which were held out.",
    )


def remeshed_table(remeshed: Sequence[RemeshedComparison]) -> Table:
    """Return the comparison on several meshes as a table."""
    columns = [PageColumn("output"), PageColumn("unit")]
    for mesh in remeshed:
        columns.append(number_column(f"x{mesh.refinement:g}", f"{mesh.unknowns:,}"))
    rows = []
    for rows_of_output in zip(*(mesh.comparison for mesh in remeshed), strict=True):
        output = rows_of_output[0]
        differences = [_difference_text(row) for row in rows_of_output]
        rows.append((output.name, _unit_text(output.unit), *differences))
    return Table(
        columns,
        rows,
        "The same wing on other meshes",
        "Nothing is fitted again. Each cell: rms / largest.",
    )


def _unit_text(unit: str) -> str:
    """Return a unit as it is printed; a fraction has none."""
    return "" if unit == "1" else unit


def _limit_text(limit: float | None) -> str:
    """Return a limit as it is printed; empty if there is none."""
    return "" if limit is None else f"{limit:g}"


def _difference_text(row: Comparison) -> str:
    """Return root mean square and largest difference; a single figure with its sign instead."""
    is_single = abs(abs(row.largest) - row.rms) < 1e-9 * abs(row.rms) + 1e-15
    if is_single:
        return f"{row.largest:+.3g}".replace("-", "−")
    return f"{row.rms:.3g} / {abs(row.largest):.3g}"


def _parameter_table(result: Identification) -> Table:
    """Return the free numbers before and after the fit as a table."""
    fit = result.fit
    analysis = result.analysis
    shifts = scaled(fit.parameters, fit.values)
    deviations_after = analysis.width * deviations(fit.parameters)
    columns = (
        PageColumn("number"),
        PageColumn("unit"),
        number_column("before"),
        number_column("after"),
        number_column("shift", "prior deviations"),
        number_column("width after / before"),
        PageColumn("why it is free"),
    )
    rows = []
    for number, parameter in enumerate(fit.parameters):
        value = fit.values[number]
        rows.append(
            (
                parameter.name,
                _unit_text(parameter.unit),
                f"{parameter.mean:.4g} ± {parameter.standard_deviation:.2g}",
                f"{value:.5g} ± {deviations_after[number]:.2g}",
                f"{shifts[number]:+.2f}".replace("-", "−"),
                f"{analysis.width[number]:.2f}",
                parameter.why,
            )
        )
    return Table(
        columns,
        rows,
        "Free numbers before and after",
        "Before: normal distribution. After: the fit, and its width by the linear analysis; widths "
        "follow from the weights and are to be compared with each other.",
    )


def _direction_table(result: Identification) -> Table:
    """Return the directions that the data determine least, the weakest first, as a table."""
    analysis = result.analysis
    weakest_first = reversed(range(len(analysis.singular_values)))
    columns = (
        number_column("singular value"),
        PageColumn("direction, in prior deviations"),
    )
    rows = []
    for number in itertools.islice(weakest_first, WEAK_DIRECTIONS):
        singular_value = analysis.singular_values[number]
        rows.append((f"{singular_value:.3g}", analysis.describe(number)))
    return Table(
        columns,
        rows,
        "Weak directions",
        "The six that the data tell least of.",
    )


def _iteration_table(result: Identification) -> Table:
    """Return the iterations of the fit as a table."""
    columns = (
        PageColumn("model"),
        number_column("objective"),
        number_column("of it misfit"),
        number_column("next step", "prior deviations"),
    )
    rows = []
    for number, iteration in enumerate(result.fit.iterations, start=1):
        rows.append(
            (
                str(number),
                f"{iteration.objective:.2f}",
                f"{iteration.misfit:.2f}",
                f"{iteration.largest_step:.4f}",
            )
        )
    return Table(
        columns,
        rows,
        "Iterations",
        "Each model is the full one, factorised and differentiated at that point.",
    )
