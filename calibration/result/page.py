"""The page of a calibration."""

from collections.abc import Mapping
from textwrap import fill

from matplotlib.figure import Figure

from calibration.result.figures import corner_figure, readings_figure
from calibration.result.record import Calibration
from calibration.result.text import (
    PROCEDURES,
    WORDS,
    channel_rows,
    correlation_lines,
    parameter_rows,
    reading_rows,
)
from reporting.page import Page
from reporting.words import plus_minus

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
    title, subtitle, footer = (WORDS.say(name, result=result) for name in ("title", "subtitle", "footer"))
    page = Page(title, subtitle, (footer,))
    page.add_section("Result")
    page.add_highlights(
        [
            (
                f"{plus_minus(result.mean(prior.name), result.standard_deviation(prior.name))} "
                f"{'' if prior.unit == '1' else prior.unit}".strip(),
                prior.figure.title,
            )
            for prior in result.priors[:6]
        ]
    )
    for sentence in result.findings:
        page.add_notice(sentence)
    if not result.findings:
        page.add_paragraph(WORDS.say("agreed"))
    procedure = PROCEDURES[result.procedure]
    WORDS.add_table(page, "parameters", parameter_rows(result), result=result, procedure=procedure)
    for line in correlation_lines(result):
        page.add_paragraph(f"{line}.")
    for name in ("posterior", "prior_and_posterior"):
        page.add_figure(drawings[name], **WORDS.words("figures", name))
    page.add_section("What is left of the readings")
    WORDS.add_table(page, "readings", reading_rows(result))
    if "readings" in drawings:
        page.add_figure(drawings["readings"], **WORDS.words("figures", "readings"))
    WORDS.add_table(page, "channels", channel_rows(result))
    return page


def ended_page(page: Page, result: Calibration) -> str:
    """Return a page as text, with where the calibration comes from at its end."""
    versions = result.provenance["versions"].items()
    rows = [
        ("asset", result.asset),
        ("model", f"{result.model}, SHA-256 {result.model_hash[:16]}"),
        ("measured", result.source),
        ("seed", str(result.seed)),
        ("priors", ", ".join(f"{prior.name}: {prior.stated_by}" for prior in result.priors)),
        ("software", ", ".join(f"{name} {version}" for name, version in versions)),
    ]
    WORDS.add_table(page, "origin", rows)
    return page.render()
