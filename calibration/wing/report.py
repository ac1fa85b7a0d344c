"""The report of a whole calibration: one self-contained page."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from calibration.dynamics.figures import masses_figure, ring_down_figure
from calibration.samples.figures import corner_figure
from calibration.static.figures import calibration_figure, residual_figure
from calibration.static.report import SOURCE
from fe.reduction.fields import WingFields
from reporting.page import Column, Page, Table

from .disagreements import disagreements, misses
from .figures import AXIS_TITLES, modes_figure, quantities_figure
from .result import STATE
from .steps import CalibrationStep
from .table_1 import SHOWN, TableRow, printed, signed, signed_number, table_1
from .tailoring import tailored_geometry
from .three_steps import WingCalibration

TITLES = {"joint": "the joint posterior", "paper": "the paper's procedure"}
FIGURE_NAMES = ("quantities", "load_test", "residuals", "masses", "posterior", "modes", "ring_down")
"""All that `report_figures` may draw, the last where there are records."""

_STEP_TITLES = {1: "Planform", 2: "Load test", 3: "Ring-down"}


def report_figures(calibration: WingCalibration, fields: WingFields) -> dict[str, Figure]:
    """Draw every figure of the report, by the name of its file."""
    paper = np.column_stack([calibration.paper.young_modulus_factor, calibration.paper.samples])
    scale = np.array([SHOWN[entry.name].scale for entry in STATE])
    state = calibration.result.mean_state()
    modes = calibration.model.modes(state.values, state.stiffness_loss)
    flapwise = dict(zip(modes.followed, ("first flapwise", "second flapwise"), strict=True))
    titles = [
        f"mode {index + 1}, {frequency:.2f} Hz" + (f", {flapwise[index]}" if index in flapwise else "")
        for index, frequency in enumerate(modes.frequency[:6])
    ]
    drawn = [
        quantities_figure(calibration.result),
        calibration_figure(calibration.static),
        residual_figure(calibration.static),
        masses_figure(calibration.paper, calibration.lab.authors),
        corner_figure(
            [AXIS_TITLES[entry.name] for entry in STATE],
            calibration.joint.samples * scale,
            paper * scale,
            ("joint posterior", "the paper's procedure"),
            math=True,
        ),
        modes_figure(fields, modes, titles),
    ]
    if calibration.lab.trials is not None:
        drawn.append(ring_down_figure(calibration.lab.trials))
    return dict(zip(FIGURE_NAMES, drawn, strict=False))


def render_page(calibration: WingCalibration, drawings: Mapping[str, bytes]) -> str:
    """Return the page; `drawings` are the figures of `report_figures` as SVG."""
    result = calibration.result
    page = Page(
        f"Calibration of {result.asset}",
        "Planform, stiffness, masses and damping of one wing from three experiments",
        footer=(
            SOURCE,
            f"Seed {result.seed}. Tailored design {result.design_hash[:12]}. Inputs: "
            + ", ".join(f"{name} {value[:12]}" for name, value in result.provenance["input_hashes"].items())
            + ".",
        ),
    )
    page.add_section("Result")
    _add_result(page, calibration, drawings)
    page.add_section("What disagrees with the data")
    _add_disagreements(page, calibration)
    page.add_section("Step 1: planform")
    _add_planform(page, calibration)
    page.add_section("Step 2: load test")
    _add_load_test(page, calibration, drawings)
    page.add_section("Step 3: ring-down, masses and damping")
    _add_ring_down(page, calibration, drawings)
    page.add_section("The calibrated wing")
    page.add_figure(
        drawings["modes"],
        "Mode shapes of the upper skin at the posterior mean, healthy; the colour is the length of the "
        "displacement, from none (dark) to the largest (light); grey is the wing at rest. The leading "
        "edge is at the back. modes.vtu has them for ParaView, wing.vtu the wing in a 3g turn.",
        title="Mode shapes",
    )
    _add_origin(page, calibration)
    return page.render()


def _add_result(page: Page, calibration: WingCalibration, drawings: Mapping[str, bytes]) -> None:
    result = calibration.result
    page.add_highlights(
        [
            (
                f"{printed(entry.name, result.mean(entry.name))} {SHOWN[entry.name].unit}".strip(),
                f"{SHOWN[entry.name].title}, ± {printed(entry.name, result.standard_deviation(entry.name))}",
            )
            for entry in STATE
        ]
    )
    for origin in calibration.lab.origins:
        text = f"Step {origin.step}, {_STEP_TITLES[origin.step].lower()}: {origin.text}."
        if any(other.read for other in calibration.lab.origins) and not origin.read:
            page.add_notice(text)
        else:
            page.add_paragraph(text)
    page.add_table(
        Table(
            (
                Column("figure"),
                Column("prior", numeric=True),
                Column("this wing", numeric=True),
                Column("paper's procedure", numeric=True),
                Column("in the paper", numeric=True),
                Column("difference", numeric=True),
            ),
            [_table_row(row) for row in table_1(calibration)],
        ),
        f"Mean ± standard deviation. This wing: {TITLES[result.procedure]}, {len(result.samples)} samples, "
        "as in calibration.nc. Paper's procedure: e by its particle filter on its stiffness line, then "
        "masses by eqs. (19), (20) and damping by eq. (25) on the tailored model for each sample of e; its "
        "standard deviations hold the uncertainty of e alone. In the paper: planform and e are printed in "
        "its Table 1; masses are the means of the authors' published samples of step 3, alpha and beta "
        "follow from their frequencies by eq. (25). Difference: this wing less the paper's, which is of its "
        "own wing. table_1.csv has all figures in SI.",
        title="This calibration beside Table 1 of the paper",
    )
    page.add_figure(
        drawings["quantities"],
        "Tip stiffness, frequencies and damping ratios of the two flapwise bending modes before and after "
        "the calibration, and what was measured with its 95 % interval. The vertical scale of each panel "
        "is free.",
        title="Quantities of interest",
    )


def _table_row(row: TableRow) -> tuple[str, ...]:
    shown = SHOWN[row.name]
    return (
        (f"{shown.title}, {shown.unit}" if shown.unit else shown.title).replace(" ", "\u00a0"),
        printed(row.name, *row.prior),
        printed(row.name, *row.found),
        printed(row.name, *row.paper_way),
        printed(row.name, row.paper.mean, row.paper.standard_deviation),
        signed(row.name, row.difference),
    )


def _add_disagreements(page: Page, calibration: WingCalibration) -> None:
    sentences = disagreements(calibration)
    for sentence in sentences:
        page.add_notice(sentence)
    if not sentences:
        page.add_paragraph("Nothing differs by more than two standard deviations.")
    page.add_table(
        Table(
            (
                Column("quantity"),
                Column("unit"),
                Column("measured", numeric=True),
                Column("calibrated model", numeric=True),
                Column("difference", "%", numeric=True),
                Column("in standard deviations", numeric=True),
            ),
            [
                (
                    SHOWN[miss.name].title,
                    SHOWN[miss.name].unit,
                    printed(miss.name, *miss.measured),
                    printed(miss.name, *miss.model),
                    signed_number(100.0 * miss.relative, 2),
                    signed_number(miss.score, 1),
                )
                for miss in misses(calibration)
            ],
        ),
        "Mean ± standard deviation. The standard deviations of frequencies and damping ratios hold what the "
        "records leave open beyond their scatter: amplitude, cropping and method.",
        title="Measured and modelled",
    )


def _add_planform(page: Page, calibration: WingCalibration) -> None:
    lengths = calibration.result.geometry.lengths
    kept = tailored_geometry(calibration.result.geometry)
    page.add_table(
        Table(
            (
                Column("length"),
                Column("designed", "mm", numeric=True),
                Column("measured", "mm", numeric=True),
                Column("posterior", "mm", numeric=True),
                Column("modelled", "mm", numeric=True),
                Column("from design, in standard deviations", numeric=True),
            ),
            [
                (
                    SHOWN[length.name].title.replace(" ", "\u00a0"),
                    printed(length.name, length.prior.mean, length.prior.standard_deviation),
                    printed(length.name, length.measured),
                    printed(length.name, length.posterior.mean, length.posterior.standard_deviation),
                    f"{getattr(kept, length.name) * 1e3:.1f}",
                    signed_number(length.score, 2),
                )
                for length in lengths
            ],
        ),
        "The design is tailored to the posterior means, rounded to 0.1 mm, and meshed anew; what it "
        "places by fractions moves with the planform, what it places by distances stays.",
        title="Planform",
    )
    _add_reward(page, calibration.result.step(1))


def _add_load_test(page: Page, calibration: WingCalibration, drawings: Mapping[str, bytes]) -> None:
    static, published = calibration.static, calibration.static_published
    page.add_figure(
        drawings["load_test"],
        "(a) Measured pairs with 95 % intervals; 95 % bands of f = k(e) x before (grey) and after (blue) "
        "the calibration. (b) Prior, the kernel likelihood of each pair, and the posterior by quadrature "
        "and by the particle filter. (c) The tip stiffness, before and after. After Fig. 5 of the paper.",
        title="Load test, posterior of e and of the tip stiffness",
    )
    rows = []
    for title, found in (("tailored model", static), ("line of the paper, eq. (14)", published)):
        for way, mean, deviation in (
            ("exact", found.exact.mean, found.exact.standard_deviation),
            ("particle filter", found.particle.mean, found.particle.standard_deviation),
        ):
            stiffness = found.tip_stiffness_exact if way == "exact" else found.tip_stiffness_particle
            rows.append(
                (
                    title,
                    way,
                    printed("young_modulus_factor", mean, deviation),
                    printed("tip_stiffness", stiffness.mean, stiffness.standard_deviation),
                )
            )
    page.add_table(
        Table(
            (
                Column("stiffness k(e)"),
                Column("posterior"),
                Column("e", numeric=True),
                Column("k", "N/mm", numeric=True),
            ),
            rows,
        ),
        "e is the factor on the Young's modulus of the model that gives k(e): two models need two factors to "
        "have the measured stiffness.",
        title="e on the tailored model and on the published line",
    )
    page.add_figure(
        drawings["residuals"],
        "(a) Displacement less load over calibrated stiffness, with 95 % intervals of the readings; the "
        "broken lines are the means of the runs. (b) Mean and 95 % interval of e under other assumptions.",
        title="Residuals of the load test",
    )
    _add_reward(page, calibration.result.step(2))


def _add_ring_down(page: Page, calibration: WingCalibration, drawings: Mapping[str, bytes]) -> None:
    if "ring_down" in drawings:
        page.add_figure(
            drawings["ring_down"],
            "(a) The first trial with the fitted sum of two damped cosines and its envelopes. (b) Spectra "
            "of all trials. (c), (d) Frequency and damping of the first mode in windows of 0.8 s over its "
            "amplitude; a linear wing would show one value.",
            title="Ring-down records, fits and spectra",
        )
    else:
        page.add_paragraph(
            "No ring-down record was read: step 3 aims at the published frequencies and damping ratios."
        )
    page.add_figure(
        drawings["masses"],
        "One point for each sample of e: the masses that meet the measured frequencies best under the "
        "weighed total, eqs. (19) and (20), and the Rayleigh coefficients of eq. (25)"
        + ("; grey squares are the authors' published samples." if calibration.lab.authors else "."),
        title="Masses and damping by the paper's procedure",
    )
    page.add_figure(
        drawings["posterior"],
        "Samples of the joint posterior (blue) and of the paper's procedure (green, its histograms on a "
        "scale of their own); upper right: correlations of the joint posterior. Numbers over 0.3 are blue.",
        title="Joint posterior",
    )
    for step in calibration.result.steps[2:]:
        _add_reward(page, step)


def _add_reward(page: Page, step: CalibrationStep) -> None:
    reward = step.reward
    text = f"Reward of the experiment ({step.procedure}): "
    if reward.prior_error is not None and reward.posterior_error is not None:
        text += (
            "the mean error of the quantities of interest, in half-widths of the measurements' 95 % "
            f"intervals, was {-reward.prior_error:.2f} before and is {-reward.posterior_error:.2f} after; "
        )
    text += f"{100.0 * reward.uncertainty_reduction:.0f} % of the prior standard deviation was taken away"
    if reward.information_gain is not None:
        text += f", {reward.information_gain:.2f} nat of information gained"
    page.add_paragraph(text + ".")


def _add_origin(page: Page, calibration: WingCalibration) -> None:
    result = calibration.result
    design = result.design
    rows = [
        ("asset", result.asset),
        ("samples kept", f"{len(result.samples)}, {TITLES[result.procedure]}"),
        ("seed", str(result.seed)),
        ("tailored design", f"{design.name}, SHA-256 {result.design_hash[:16]}"),
        ("lengths", result.geometry.source),
        ("load test", result.pairs.source),
        ("frequencies and damping", result.modal.source),
        (
            "software",
            ", ".join(f"{name} {version}" for name, version in result.provenance["versions"].items()),
        ),
    ]
    page.add_table(
        Table((Column("item"), Column("value")), rows),
        "calibration.nc has everything, the tailored design included.",
        title="Where it comes from",
    )
