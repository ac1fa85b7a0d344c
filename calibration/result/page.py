"""The page of a calibration."""

from collections.abc import Mapping
from textwrap import fill

from matplotlib.figure import Figure

from calibration.result.figures import corner_figure, readings_figure
from calibration.result.record import Calibration
from calibration.result.text import (
    CHANNEL_HEADINGS,
    HEADINGS,
    PROCEDURES,
    READING_HEADINGS,
    channel_rows,
    correlation_lines,
    parameter_rows,
    reading_rows,
    with_deviation,
)
from reporting.page import Column, Page, Table

FIGURE_NAMES = ("posterior", "prior_and_posterior", "readings")
"""All that `report_figures` may draw, the last where single numbers were measured."""

_TITLE_WIDTH = 14  # letters of a line beside an axis


def drawn_parameters(result: Calibration) -> tuple[list[int], list[str]]:
    """Return which parameters are drawn pair by pair, those that have no reading of their own, and titles."""
    measured = {reading.name for reading in result.readings}
    drawn = {at: prior for at, prior in enumerate(result.priors) if prior.name not in measured}
    titles = [
        fill(prior.name.replace("_", " ") + ("" if prior.unit == "1" else f" ({prior.unit})"), _TITLE_WIDTH)
        for prior in drawn.values()
    ]
    return list(drawn), titles


def report_figures(result: Calibration) -> dict[str, Figure]:
    """Draw every figure of the page, by the name of its file."""
    places, titles = drawn_parameters(result)
    posterior, prior = result.samples[:, places], result.prior_samples[:, places]
    drawn = [
        corner_figure(titles, [("posterior", posterior)]),
        corner_figure(titles, [("posterior", posterior), ("prior", prior)]),
    ]
    if result.readings:
        drawn.append(readings_figure(result))
    return dict(zip(FIGURE_NAMES, drawn, strict=False))


def begun_page(result: Calibration, drawings: Mapping[str, bytes]) -> Page:
    """Return a page with all that a calibration says; `drawings` are its figures as SVG."""
    hashes = result.provenance["input_hashes"]
    page = Page(
        f"Calibration of {result.asset}",
        f"Parameters of {result.model} from {result.source}",
        footer=(
            f"Seed {result.seed}. Inputs: "
            + ", ".join(f"{name} {value[:12]}" for name, value in hashes.items())
            + ".",
        ),
    )
    page.add_section("Result")
    _add_result(page, result, drawings)
    page.add_section("What is left of the readings")
    if result.readings:
        page.add_table(
            Table(_columns(READING_HEADINGS, 3), reading_rows(result)),
            "Mean ± standard deviation: measured, and of the model before and after the calibration. In "
            "deviations: the model less the reading, over the standard deviations of both.",
            title="Measured and modelled",
        )
        page.add_figure(
            drawings["readings"],
            "The model before and after the calibration, and what was measured with its 95 % interval. The "
            "vertical scale of each panel is free.",
            title="Readings",
        )
    page.add_table(
        Table(_columns(CHANNEL_HEADINGS, 2), channel_rows(result)),
        "Rms residual in standard deviations of the noise, with the parameters at their prior means and at "
        "the most probable values; gains, zeros and initial states are fitted in both. Held-out trials took "
        "no part in the calibration.",
        title="Residuals",
    )
    return page


def _columns(headings: tuple[str, ...], words: int) -> tuple[Column, ...]:
    return tuple(Column(name, numeric=at >= words) for at, name in enumerate(headings))


def _add_result(page: Page, result: Calibration, drawings: Mapping[str, bytes]) -> None:
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
    gained = result.information
    page.add_table(
        Table(_columns(HEADINGS, 2), parameter_rows(result)),
        f"Mean ± standard deviation. The posterior is {PROCEDURES[result.procedure]}; calibration.nc has "
        f"{len(result.samples)} samples of it. Prior left: standard deviation of the posterior over that of "
        "the prior." + ("" if gained is None else f" Information gained: {gained:.2f} nat."),
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


def ended_page(page: Page, result: Calibration) -> str:
    """Return a page as text, with where the calibration comes from at its end."""
    rows = [
        ("asset", result.asset),
        ("model", f"{result.model}, SHA-256 {result.model_hash[:16]}"),
        ("measured", result.source),
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
    return page.render()
