"""Calibrated parameters: what the calibration believed, and what each model makes of the data."""

from discrepancy.judgement.conclusion import calibrated_parameters
from discrepancy.report.text import added_label, rounded, unit_text
from discrepancy.workflow import Investigation
from reporting.page import Page, Table, columns, numbers

NINETY = 1.6449
"""Normal quantile at 95 %: half of a 90 % interval in standard deviations."""


def parameter_rows(investigation: Investigation) -> list[tuple[str, ...]]:
    """Return name, unit, and values with 90 % half-widths: calibration, model as it was, with the effect.

    Without an effect the last column is left out; without parameters there are no rows.
    """
    problem, search, fit = investigation.problem, investigation.search, investigation.fit
    if problem is None or search is None or fit is None:
        return []
    layout = problem.shared
    fits = [search.none] + ([fit] if fit.candidate.terms else [])
    rows = []
    stated = zip(layout.parameter_mean.tolist(), layout.parameter_scale.tolist(), strict=True)
    for prior, *found in zip(stated, *(calibrated_parameters(problem, one) for one in fits), strict=True):
        cells = [_beside(*prior), *(_beside(item.mean, item.deviation) for item in found)]
        rows.append((found[0].name.replace("_", " "), unit_text(found[0].unit), *cells))
    return rows


def _beside(value: float, deviation: float) -> str:
    show = rounded(value, NINETY * deviation)
    return f"{show(value)} ± {show(NINETY * deviation)}" if deviation > 0.0 else f"{value:.6g}, exact"


def add_parameters(page: Page, investigation: Investigation) -> None:
    """Add the table, where the model has calibrated parameters."""
    rows = parameter_rows(investigation)
    if not rows:
        return
    values = map(numbers, ("calibration", "model as it was", "with the effect"))
    heads = columns("parameter", "unit", *values)
    added = added_label(investigation)
    page.add_table(
        Table(heads[: len(rows[0])], rows),
        "Values with the half-width of their 90 % intervals: as the calibration states them, and fitted to "
        f"these data {f'without and with {added}' if added else 'without any effect'}. Where the model as it "
        "was moves a parameter by several deviations, the parameter has taken up what the model lacks.",
        title="Calibrated parameters before and after",
    )
