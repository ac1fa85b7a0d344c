"""The page of a calibration of parameters."""

from collections.abc import Mapping

from matplotlib.figure import Figure

from calibration.parameters.result import ParameterCalibration
from calibration.parameters.text import (
    CHANNEL_HEADINGS,
    HEADINGS,
    PROCEDURES,
    channel_rows,
    correlation_lines,
    parameter_rows,
    with_deviation,
)
from calibration.samples.figures import corner_figure
from reporting.page import Column, Page, Table

FIGURE_NAMES = ("posterior", "prior_and_posterior")


def report_figures(result: ParameterCalibration) -> dict[str, Figure]:
    """Draw every figure of the page, by the name of its file."""
    titles = [
        prior.figure.title + ("" if prior.unit == "1" else f" ({prior.unit})") for prior in result.priors
    ]
    drawn = (
        corner_figure(titles, result.samples, None, ("posterior", "")),
        corner_figure(titles, result.samples, result.prior_samples, ("posterior", "prior")),
    )
    return dict(zip(FIGURE_NAMES, drawn, strict=True))


def render_page(result: ParameterCalibration, drawings: Mapping[str, bytes]) -> str:
    """Return the page; `drawings` are the figures of `report_figures` as SVG."""
    hashes = result.provenance["input_hashes"]
    page = Page(
        f"Calibration of {result.asset}",
        f"Parameters of {result.model} from the campaign {result.source}",
        footer=(
            f"Seed {result.seed}. Inputs: "
            + ", ".join(f"{name} {value[:12]}" for name, value in hashes.items())
            + ".",
        ),
    )
    page.add_section("Result")
    _add_result(page, result, drawings)
    page.add_section("What is left of the readings")
    _add_residuals(page, result)
    return page.render()


def _add_result(page: Page, result: ParameterCalibration, drawings: Mapping[str, bytes]) -> None:
    page.add_highlights(
        [
            (
                f"{with_deviation(result.mean(prior.name), result.standard_deviation(prior.name))} "
                f"{'' if prior.unit == '1' else prior.unit}".strip(),
                prior.figure.title,
            )
            for prior in result.priors[:6]
        ]
    )
    for sentence in result.findings:
        page.add_notice(sentence)
    if not result.findings:
        page.add_paragraph("Noise and priors allow what is left, and every parameter is told.")
    text = (Column(HEADINGS[0]), Column(HEADINGS[1]), *(Column(name, numeric=True) for name in HEADINGS[2:]))
    page.add_table(
        Table(text, parameter_rows(result)),
        f"Mean ± standard deviation. The posterior is {PROCEDURES[result.procedure]}; calibration.nc has "
        f"{len(result.samples)} samples of it. Prior left: standard deviation of the posterior over that of "
        f"the prior. Information gained: {result.information:.2f} nat.",
        title="Parameters",
    )
    for line in correlation_lines(result):
        page.add_paragraph(f"{line}.")
    page.add_figure(
        drawings["posterior"],
        "Samples of the posterior; upper right: correlations. Numbers over 0.3 are blue.",
        title="Posterior",
    )
    page.add_figure(
        drawings["prior_and_posterior"],
        "The same with samples of the prior; the histograms have scales of their own.",
        title="Prior and posterior",
    )


def _add_residuals(page: Page, result: ParameterCalibration) -> None:
    columns = (
        *(Column(name) for name in CHANNEL_HEADINGS[:2]),
        *(Column(name, numeric=True) for name in CHANNEL_HEADINGS[2:]),
    )
    page.add_table(
        Table(columns, channel_rows(result)),
        "Rms residual in standard deviations of the noise, with the parameters at their prior means and at "
        "the most probable values; gains, zeros and initial states are fitted in both. Held-out trials took "
        "no part in the calibration.",
        title="Residuals",
    )
    rows = [
        ("asset", result.asset),
        ("model", f"{result.model}, SHA-256 {result.model_hash[:16]}"),
        ("campaign", result.source),
        ("seed", str(result.seed)),
        ("priors", ", ".join(f"{prior.name}: {prior.stated_by}" for prior in result.priors)),
        (
            "software",
            ", ".join(f"{name} {version}" for name, version in result.provenance["versions"].items()),
        ),
    ]
    page.add_table(
        Table((Column("item"), Column("value")), rows),
        "calibration.nc has everything.",
        title="Where it comes from",
    )
