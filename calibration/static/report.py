"""The report of calibration step 2: one self-contained page."""

from pathlib import Path

from reporting.figures import to_png, to_svg
from reporting.files import atomic_write_bytes, atomic_write_text
from reporting.page import Column, Page, Table

from .experiments import HALF_WIDTH_95
from .figures import calibration_figure, residual_figure
from .record import StaticCalibration
from .summary import PAPER_MEAN, PAPER_STANDARD_DEVIATION, summary_rows

SOURCE = (
    "M. G. Kapteyn, J. V. R. Pretorius, K. E. Willcox: A probabilistic graphical model foundation for "
    "enabling predictive digital twins at scale. Nature Computational Science 1 (2021) 337-347. "
    "doi:10.1038/s43588-021-00069-0"
)


def write_report(result: StaticCalibration, folder: Path) -> Path:
    """Write `report.html` and `figures/` (SVG and PNG) into a folder; return the path of the page.

    Raises
    ------
    reporting.errors.FileNotWrittenError
        If a file cannot be written.
    """
    drawings = {}
    for name, figure in (
        ("calibration", calibration_figure(result)),
        ("residuals", residual_figure(result)),
    ):
        drawings[name] = to_svg(figure)
        atomic_write_bytes(folder / "figures" / f"{name}.svg", drawings[name])
        atomic_write_bytes(folder / "figures" / f"{name}.png", to_png(figure))
    page = folder / "report.html"
    atomic_write_text(page, _page(result, drawings).render())
    return page


def _page(result: StaticCalibration, drawings: dict[str, bytes]) -> Page:
    data = result.data
    page = Page(
        "Static calibration of the wing",
        f"Posterior of the Young's modulus factor e from {data.count} measured loads and displacements",
        footer=(SOURCE, f"Seed {result.seed}. Measurements: {data.source}, SHA-256 {data.sha256[:16]}."),
    )
    page.add_section("Result")
    _add_result(page, result, drawings["calibration"])
    page.add_section("Fit and assumptions")
    _add_fit(page, result, drawings["residuals"])
    _add_pairs(page, result)
    page.add_section("Method")
    _add_method(page, result)
    return page


def _add_result(page: Page, result: StaticCalibration, drawing: bytes) -> None:
    particle, exact = result.particle, result.exact
    page.add_highlights(
        (
            (f"{particle.mean:.4f} ± {particle.standard_deviation:.4f}", "e, the paper's particle filter"),
            (f"{exact.mean:.4f} ± {exact.standard_deviation:.4f}", "e, exact posterior"),
            (f"{PAPER_MEAN:.4f} ± {PAPER_STANDARD_DEVIATION:.4f}", "e, in the paper"),
            (f"{result.tip_stiffness_exact.mean * 1e-3:.4f} N/mm", "tip stiffness, exact posterior"),
        )
    )
    page.add_figure(
        drawing,
        "(a) Measured pairs with 95 % intervals; 95 % bands of f = k(e) x before (grey) and after (blue) the "
        "calibration. (b) Prior, the kernel likelihood of each pair (full: run 1, dashed: run 2), and the "
        "posterior by quadrature and by the particle filter. (c) The tip stiffness, before and after. After "
        "Fig. 5 of the paper.",
        title="Load test, posterior of e and of the tip stiffness",
    )
    page.add_table(
        Table(
            (Column("figure"), Column("here", numeric=True), Column("paper", numeric=True), Column("unit")),
            [
                (
                    row.name,
                    _number(row.ours),
                    "" if row.paper is None else _number(row.paper),
                    row.unit if row.unit != "1" else "",
                )
                for row in summary_rows(result)
            ],
        ),
        "The paper's tip stiffness is its eq. (14) at its posterior of e.",
        title="Figures beside the paper's (Table 1)",
    )


def _add_fit(page: Page, result: StaticCalibration, drawing: bytes) -> None:
    quality = result.quality
    for remark in quality.remarks:
        page.add_notice(remark)
    page.add_figure(
        drawing,
        "(a) Displacement less load over calibrated stiffness, with 95 % intervals of the readings; the "
        "broken lines are the means of the runs. (b) Mean and 95 % interval of e: in the paper, by the "
        "particle filter, and exactly; exactly with a prior flat in the true load instead of the true "
        "displacement; with the density of the ratio, which the paper's filter takes for the likelihood; "
        "and with a zero offset that all readings of a run share, by which they tell less.",
        title="Residuals, and the posterior under other assumptions",
    )
    page.add_paragraph(
        f"χ² is {quality.chi_square:.2f} with {quality.degrees_of_freedom} degrees of freedom"
        + (
            f" (probability of a larger one {quality.tail_probability:.2f}). "
            if quality.degrees_of_freedom
            else ". "
        )
        + f"The experiment took {100.0 * result.reward.uncertainty_reduction:.0f} % of the prior's "
        f"standard deviation away and brought {result.reward.information_gain:.2f} nat of information. The "
        "mean absolute error of the displacement, in half-widths of its 95 % interval, was "
        f"{-result.reward.prior_error:.2f} at the prior mean and is {-result.reward.posterior_error:.2f} at "
        "the posterior mean, which weighs squared errors."
    )


def _add_pairs(page: Page, result: StaticCalibration) -> None:
    data, quality = result.data, result.quality
    rows = [
        (
            str(run + 1),
            f"{load:.4f}",
            f"{displacement * 1e3:.3f}",
            f"{load / quality.stiffness * 1e3:.3f}",
            f"{residual * 1e3:+.3f}".replace("-", "−"),
            f"{standard:+.2f}".replace("-", "−"),
        )
        for run, load, displacement, residual, standard in zip(
            data.run.tolist(),
            data.load.tolist(),
            data.displacement.tolist(),
            quality.displacement_residual.tolist(),
            quality.standardised_residual.tolist(),
            strict=True,
        )
    ]
    columns = (
        Column("run"),
        Column("load", "N", numeric=True),
        Column("measured", "mm", numeric=True),
        Column("calibrated", "mm", numeric=True),
        Column("difference", "mm", numeric=True),
        Column("in standard deviations", numeric=True),
    )
    page.add_table(
        Table(columns, rows), "Calibrated: load over stiffness at the exact mean.", title="The pairs"
    )


def _add_method(page: Page, result: StaticCalibration) -> None:
    data, particle = result.data, result.particle
    page.add_paragraph(
        f"Stiffness curve: {result.curve.name}. Prior: e ~ N({result.prior.mean:g}, "
        f"{result.prior.standard_deviation:.4g}²). Readings: independent Gaussian errors with 95 % "
        f"half-widths of {HALF_WIDTH_95 * data.displacement_standard_deviation * 1e3:.3g} mm and "
        f"{HALF_WIDTH_95 * data.load_standard_deviation:.3g} N."
    )
    page.add_paragraph(
        f"Particle filter as in the paper: {particle.particle_count:,} samples of each pair, turned into e "
        "through k = f / x, give a Gaussian kernel density that weighs as many particles drawn from the "
        f"prior; {particle.effective_sample_size[-1]:,.0f} effective particles remain."
    )
    page.add_paragraph(
        "Exact posterior: load and displacement are both read with errors; with a prior flat in the true "
        "displacement, the likelihood of a pair is N(f - k(e) x; 0, R_f + k(e)² R_x), its normalising factor "
        "included; quadrature on a grid."
    )


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.4f}"
