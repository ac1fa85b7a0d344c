"""The report of an identification: one self-contained page."""

from collections.abc import Sequence

from reporting.figures import to_svg
from reporting.page import Page, PageColumn, Table

from .comparison import Comparison
from .figures import gauge_figure, identifiability_figure, profile_figure
from .identified import Identification
from .parameters import deviations, scaled

SOURCE = (
    "M. G. Kapteyn, J. V. R. Pretorius, K. E. Willcox: A probabilistic graphical model foundation for "
    "enabling predictive digital twins at scale. Nature Computational Science 1 (2021) 337-347. "
    "doi:10.1038/s43588-021-00069-0; data: the repositories UAV-Digital-Twin and "
    "UAV-Experimental-Calibration."
)


def report_page(result: Identification) -> str:
    """Return the report as HTML."""
    fit = result.fit
    page = Page(
        "Identification of the wing design",
        f"{len(fit.parameters)} numbers of '{fit.design.name}' fitted to outputs of the published model",
        footer=(SOURCE, f"Design {fit.design.hash[:16]}."),
    )
    page.add_section("Result")
    _add_result(page, result)
    page.add_section("Free numbers")
    page.add_table(
        _parameter_table(result),
        "Before: normal distribution. After: the fit, and its width by the linear analysis; widths follow "
        "from the weights and are to be compared with each other.",
        title="Free numbers before and after",
    )
    page.add_section("What the data tell")
    _add_identifiability(page, result)
    page.add_section("Way of the fit")
    page.add_table(
        _iteration_table(result),
        "Each model is the full one, factorised and differentiated at that point.",
        title="Iterations",
    )
    return page.render()


def _add_result(page: Page, result: Identification) -> None:
    """Add the outputs beside the published ones, in figures, by gauge and on other meshes."""
    fit = result.fit
    if not fit.converged:
        page.add_notice("The fit has not converged: its next step is larger than the stated tolerance.")
    reached = [row for row in result.comparison if row.reached is not None]
    page.add_highlights(
        (
            (f"{sum(bool(row.reached) for row in reached)} of {len(reached)}", "wanted limits kept"),
            (f"{fit.iterations[-1].objective:.1f}", "objective (half the sum of squares)"),
            (
                f"{result.analysis.effective_count:.1f} of {len(fit.parameters)}",
                "numbers the data determine",
            ),
            (f"{fit.iterations[-1].largest_step:.3f}", "next step, in prior standard deviations"),
        )
    )
    page.add_table(
        comparison_table(result.comparison, result.before),
        "Differences, model less published. Fitted: the numbers of the design were fitted to it. Where "
        "levels are mixed, the lines below say which were held out.",
        title="Every output beside the published one",
    )
    page.add_figure(
        to_svg(gauge_figure(result.outputs, result.outputs_before, result.targets)),
        "Model less published: (a) relative, (b) of d ln strain / d ln e, (c), (d) of strain over "
        "healthy strain.",
        title="Residuals by gauge",
    )
    if result.remeshed:
        page.add_table(
            remeshed_table(result.remeshed),
            "Nothing is fitted again. Each cell: rms / largest.",
            title="The same wing on other meshes",
        )


def _add_identifiability(page: Page, result: Identification) -> None:
    """Add what the data determine, what the prior does, and the objective about the fit."""
    page.add_figure(
        to_svg(identifiability_figure(result.fit, result.analysis)),
        "(a) Below one, the prior decides along a direction. (b) One: the data tell nothing of the number.",
        title="Identifiability",
    )
    page.add_table(_direction_table(result), "The six that the data tell least of.", title="Weak directions")
    if result.analysis.fixed:
        page.add_table(
            Table(
                (PageColumn("number"), PageColumn("imitated", "%", numeric=True)),
                [(name, f"{100.0 * share:.1f}") for name, share in result.analysis.fixed],
            ),
            "Which share of the effect of a number that was not free the free ones can imitate.",
            title="Numbers that were held",
        )
    if result.profiles:
        page.add_figure(
            to_svg(profile_figure(result.profiles)),
            "Objective along one number with all others fitted again, on the reduced model of the last step.",
            title="Profiles",
        )


def comparison_table(rows: Sequence[Comparison], before: Sequence[Comparison]) -> Table:
    """Return the comparison before and after as a table."""
    columns = (
        PageColumn("output"),
        PageColumn("unit"),
        PageColumn("wanted rms"),
        PageColumn("wanted largest"),
        PageColumn("start", "rms / largest", numeric=True),
        PageColumn("identified", "rms / largest", numeric=True),
        PageColumn("where"),
        PageColumn("kept"),
        PageColumn("fitted"),
    )
    return Table(
        columns,
        [
            (
                row.name,
                row.unit if row.unit != "1" else "",
                "" if row.wanted_rms is None else f"{row.wanted_rms:g}",
                "" if row.wanted_largest is None else f"{row.wanted_largest:g}",
                _pair(old),
                _pair(row),
                row.where,
                {True: "yes", False: "no", None: ""}[row.reached],
                "yes" if row.fitted else "held out",
            )
            for row, old in zip(rows, before, strict=True)
        ],
    )


def remeshed_table(remeshed: Sequence[tuple[float, int, Sequence[Comparison]]]) -> Table:
    """Return the comparison on several meshes, (refinement, unknowns, rows) each, as a table."""
    first = remeshed[0][2]
    columns = [PageColumn("output"), PageColumn("unit")]
    columns += [
        PageColumn(f"x{refinement:g}", f"{unknowns:,}", numeric=True) for refinement, unknowns, _ in remeshed
    ]
    rows = [
        (row.name, row.unit if row.unit != "1" else "", *(_pair(rows[number]) for _, _, rows in remeshed))
        for number, row in enumerate(first)
    ]
    return Table(columns, rows)


def _pair(row: Comparison) -> str:
    if abs(abs(row.largest) - row.rms) < 1e-9 * abs(row.rms) + 1e-15:
        return f"{row.largest:+.3g}".replace("-", "−")
    return f"{row.rms:.3g} / {abs(row.largest):.3g}"


def _parameter_table(result: Identification) -> Table:
    fit, analysis = result.fit, result.analysis
    shift = scaled(fit.parameters, fit.values)
    width = analysis.width * deviations(fit.parameters)
    columns = (
        PageColumn("number"),
        PageColumn("unit"),
        PageColumn("before", numeric=True),
        PageColumn("after", numeric=True),
        PageColumn("shift", "prior deviations", numeric=True),
        PageColumn("width after / before", numeric=True),
        PageColumn("why it is free"),
    )
    rows = [
        (
            parameter.name,
            parameter.unit if parameter.unit != "1" else "",
            f"{parameter.mean:.4g} ± {parameter.standard_deviation:.2g}",
            f"{value:.5g} ± {own:.2g}",
            f"{moved:+.2f}".replace("-", "−"),
            f"{ratio:.2f}",
            parameter.why,
        )
        for parameter, value, own, moved, ratio in zip(
            fit.parameters, fit.values, width, shift, analysis.width, strict=True
        )
    ]
    return Table(columns, rows)


def _direction_table(result: Identification) -> Table:
    analysis = result.analysis
    weak = range(len(analysis.singular_values) - 1, max(-1, len(analysis.singular_values) - 7), -1)
    return Table(
        (PageColumn("singular value", numeric=True), PageColumn("direction, in prior deviations")),
        [(f"{analysis.singular_values[n]:.3g}", analysis.describe(n)) for n in weak],
    )


def _iteration_table(result: Identification) -> Table:
    columns = (
        PageColumn("model"),
        PageColumn("objective", numeric=True),
        PageColumn("of it misfit", numeric=True),
        PageColumn("next step", "prior deviations", numeric=True),
    )
    rows = [
        (str(number), f"{row.objective:.2f}", f"{row.misfit:.2f}", f"{row.largest_step:.4f}")
        for number, row in enumerate(result.fit.iterations, start=1)
    ]
    return Table(columns, rows)
