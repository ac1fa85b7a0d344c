"""The page: verdict first, then where the gap is, why this name, what it does to data not used, and the limits."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite, isnan

from matplotlib.figure import Figure

from discrepancy.document_file import Origin
from discrepancy.patch_file import PrimitiveInterval
from discrepancy.report.check_tables import can_decide_table, group_lines
from discrepancy.report.evidence_figures import (
    confusion_figure,
    evidence_figure,
    pit_figure,
    separability_figure,
)
from discrepancy.report.motion_figures import (
    backbone_figure,
    force_figure,
    history_figure,
    spectrum_figure,
    worst_record,
)
from discrepancy.report.residual_figures import UNIT_OF, heat_figure, load_figure, planform_figure
from discrepancy.report.text import (
    MEANING,
    added_label,
    catalogue_of,
    estimate_text,
    formula,
    headline,
    hypothesis_name,
    listing,
    number,
    p_value_text,
    probability_text,
    rounded,
    unit_text,
)
from discrepancy.self_calibration import SelfCalibration, Share, outcomes
from discrepancy.separability import CONFUSED, Separability
from discrepancy.verdict import NamedEffect, Proof, Scores, VerdictKind
from discrepancy.workflow import Investigation
from fe.design import WingDesign
from reporting.figures import to_svg
from reporting.page import Column, Page, Table

LEAST_SHARE = 0.05
"""Findings in words that explain less of the excess variance are left to the file."""
SHOWN_FINDINGS = 8


@dataclass(frozen=True)
class ReportInput:
    """All that the report shows.

    Attributes
    ----------
    investigation : Investigation
        What came out.
    origin : Origin
        What it came from.
    separability : Separability or None
        What the campaign can decide.
    intervals : sequence of sequence of PrimitiveInterval
        Of the patch, by effect; empty without a patch.
    design : WingDesign or None
        Of a wing, for the map.
    self_calibration : SelfCalibration or None
        Where it was asked for.
    fmu : str
        Name of the patched FMU, or why there is none; empty if none is due.
    """

    investigation: Investigation
    origin: Origin
    separability: Separability | None = None
    intervals: Sequence[Sequence[PrimitiveInterval]] = ()
    design: WingDesign | None = None
    self_calibration: SelfCalibration | None = None
    fmu: str = ""


@dataclass(frozen=True)
class ReportFigure:
    """A figure with its words; `name` is that of its file."""

    name: str
    figure: Figure
    title: str
    caption: str


def report_figures(content: ReportInput) -> dict[str, ReportFigure]:
    """Draw every figure that these data allow, by name.

    Parameters
    ----------
    content : ReportInput
        What is shown.
    """
    found: dict[str, ReportFigure] = {}

    def add(name: str, figure: Figure | None, title: str, caption: str) -> None:
        if figure is not None:
            found[name] = ReportFigure(name, figure, title, caption)

    before, after = content.investigation.before, _after(content.investigation)
    if before is not None:
        both = after is not None
        scale = " Both panels have one scale." if both else ""
        if content.design is not None:
            add(
                "residual_map", planform_figure(before, after, content.design),
                "Residuals on the wing",
                "Seen from above, root on the left. Circles are strain gauges, squares displacements; the "
                "colour is "
                "the root mean square of the residual over all trials, in units of what noise would "
                "leave: 1 is "
                f"noise.{scale} Broken outlines are the regions whose stiffness loss the model knows.",
            )  # fmt: skip
        add(
            "residual_table", heat_figure(before, after), "Residuals by channel and trial",
            "Root mean square of the residual in units of what noise would leave: 1 is noise. Trials with "
            "* are "
            f"held out: nothing was fitted to them.{scale}",
        )  # fmt: skip
        add(
            "load", load_figure(before, after), "Residuals over the load",
            "Static trials and flights, all channels of a quantity in one panel; open marks are held-out "
            "trials. A "
            "slope is a stiffness or a gain, an offset a zero, a bend a nonlinearity.",
        )  # fmt: skip
        worst = worst_record(before)
        if worst is not None:
            role = "held out" if before.trials[worst.trial].trial.held_out else "fitted"
            add(
                "history", history_figure(before, after, worst), "The record with the largest gap",
                f"Channel {worst.channel} ({role} trial). The grey band is two standard deviations of the "
                "noise "
                "record.",
            )  # fmt: skip
            add(
                "spectrum", spectrum_figure(before, after, worst), "Spectra of the residuals",
                "Power relative to white noise of the stated size; peaks at the modes are missing "
                "dynamics, single "
                "lines elsewhere come from outside.",
            )  # fmt: skip
        backbone = backbone_figure(before, after)
        if backbone is not None:
            add(
                "backbone", backbone[0], "Frequency and damping over the amplitude",
                f"All ring-downs, channel {backbone[1]}, windows of four periods. Viscous damping and a "
                "linear "
                "spring are flat; Coulomb friction gives a damping ratio that falls as 1/A, quadratic "
                "damping one "
                "that rises with A, a cubic spring a frequency that goes with A squared; under micro-slip "
                "the "
                "frequency falls and the damping rises with A.",
            )  # fmt: skip
        force = force_figure(before, after)
        if force is not None:
            add(
                "restoring_force", force[0], "Restoring force of the first mode",
                f"What is left of the force per modal mass after the best straight line in displacement and "
                f"velocity, in percent of the largest elastic force; {force[1]}. Measured and predicted "
                "signals are "
                "filtered and evaluated alike; means in bins with standard errors.",
            )  # fmt: skip
    _add_evidence(content, add)
    return found


def _add_evidence(content: ReportInput, add: Callable[[str, Figure | None, str, str], None]) -> None:
    verdict, proof = content.investigation.verdict, content.investigation.proof
    if verdict.hypotheses:
        add(
            "evidence", evidence_figure(verdict.hypotheses), "Evidence",
            "The best hypotheses and their probabilities (p) on a logarithmic scale; ln B is the "
            "logarithm of the "
            "evidence over that of nothing missing (for the best place of the effect, before prior "
            "probabilities).",
        )  # fmt: skip
    if proof is not None:
        pairs = (
            (proof.held_out_before, proof.held_out_after)
            if proof.held_out_after is not None
            else (proof.fitted_before, proof.fitted_after)
        )
        scores = {
            title: item
            for title, item in zip(("model as it was", "with the effect"), pairs, strict=True)
            if item is not None and item.pit
        }
        where = "Held-out trials." if proof.held_out_after is not None else "Fitted trials: none is held out."
        if scores:
            add(
                "pit", pit_figure(scores), "Calibration of the predictions",
                f"{where} A right model gives a flat histogram; full ends mean intervals that are too "
                "narrow.",
            )  # fmt: skip
    if content.separability is not None:
        add(
            "separability", separability_figure(content.separability), "What this campaign can tell apart",
            "Squared distance, in noise deviations and with all nuisances adapted, of the effect of the "
            "row at its "
            "prior median from the nearest that the effect of the column can do. Crosses: closer than "
            f"{CONFUSED:g} in either direction, a confusion group. Made before the data were looked at.",
        )  # fmt: skip
    if content.self_calibration is not None:
        add(
            "self_calibration", confusion_figure(content.self_calibration), "The workflow on simulated campaigns",
            "What was hidden and what the verdict was, on campaigns simulated with this model, these inputs, "
            "channels and noise; counts.",
        )  # fmt: skip


def _after(investigation: Investigation):  # type: ignore[no-untyped-def]
    """Return the residuals with the effect where one was added, else None."""
    if investigation.fit is None or not investigation.fit.candidate.terms:
        return None
    return investigation.after


def render_report(content: ReportInput, drawings: dict[str, bytes], figures: dict[str, ReportFigure]) -> str:
    """Return the page.

    Parameters
    ----------
    content : ReportInput
        What is shown.
    drawings : dict of str to bytes
        SVG of each of `figures`.
    figures : dict of str to ReportFigure
        What `report_figures` returned.
    """
    investigation, origin = content.investigation, content.origin
    verdict = investigation.verdict
    page = Page(
        origin.campaign,
        f"What the model “{origin.model}” lacks beside these data: located, named, added, proved",
        footer=(
            f"Repeat it: {origin.command}",
            f"Data {origin.data_hash[:16]}, model {origin.model_hash[:16]}, seed {origin.provenance.seed}.",
        ),
    )

    def show(*names: str) -> None:
        for name in names:
            if name in figures:
                item = figures[name]
                page.add_figure(drawings[name], item.caption, title=item.title)

    page.add_section("Verdict")
    _add_verdict(page, content)
    if verdict.kind is VerdictKind.DATA_ERROR:
        _add_data(page, investigation)
        _add_origin(page, origin)
        return page.render()
    if verdict.next_experiments:
        page.add_section("Next experiment")
        _add_next(page, investigation)
    page.add_section("Where the gap is")
    _add_location(page, investigation)
    show("residual_map", "residual_table")
    page.add_section("What it looks like")
    show("history", "backbone", "restoring_force", "spectrum", "load")
    page.add_section("Why this verdict")
    _add_gates(page, investigation)
    show("evidence")
    _add_inclusion(page, investigation)
    if investigation.proof is not None:
        page.add_section("Proof on held-out trials")
        _add_proof(page, investigation, investigation.proof)
        show("pit")
    if content.separability is not None or content.self_calibration is not None:
        page.add_section("What this campaign can decide")
        _add_separability(page, content)
        show("separability")
        _add_self_calibration(page, content)
        show("self_calibration")
    _add_data(page, investigation)
    _add_origin(page, origin)
    return page.render()


def draw(figures: dict[str, ReportFigure]) -> dict[str, bytes]:
    """Return the figures as SVG."""
    return {name: to_svg(item.figure) for name, item in figures.items()}


# ---------------------------------------------------------------- sections


def _add_verdict(page: Page, content: ReportInput) -> None:
    investigation = content.investigation
    verdict = investigation.verdict
    page.add_notice(headline(verdict))
    page.add_paragraph(MEANING[verdict.kind])
    _add_highlights(page, investigation)
    catalogue = catalogue_of(investigation)
    if verdict.kind is VerdictKind.UNEXPLAINED and verdict.resembles:
        names = [catalogue[name].name if name in catalogue else name for name in verdict.resembles]
        page.add_paragraph(
            f"The nearest in the catalogue is {listing(names)}; this is a resemblance, no name."
        )
    if not verdict.effects:
        return
    for effect in _distinct(verdict.effects):
        entry = catalogue.get(effect.identifier)
        if entry is not None:
            page.add_paragraph(
                f"{effect.name[0].upper()}{effect.name[1:]}: {formula(entry.equation)}. Its signature: "
                f"{_sentence(formula(entry.signature))} Source: {_sentence(entry.reference)}"
            )
    rows = []
    for effect in verdict.effects:
        for item in (*effect.parameters, *effect.shape):
            value, interval = estimate_text(item)
            rows.append(
                (
                    effect.name, effect.place or "\N{EN DASH}", formula(item.description or item.name.replace("_", " ")),
                    value, interval, unit_text(item.unit),
                )
            )  # fmt: skip
    page.add_table(
        Table(
            (
                Column("effect"), Column("place"), Column("parameter"), Column("value", numeric=True),
                Column("90 % interval", numeric=True), Column("unit"),
            ),
            rows,
        ),
        {
            VerdictKind.NAMED: "Posterior medians and 90 % intervals.",
            VerdictKind.FAMILY: "Posterior medians and 90 % intervals; the shape was fitted.",
        }.get(verdict.kind, "Posterior medians and 90 % intervals of each candidate as if it alone were there."),
        title="What is added" if verdict.kind is VerdictKind.NAMED else "What could be added",
    )  # fmt: skip
    _add_primitives(page, content)


def _sentence(text: str) -> str:
    return text.rstrip(".") + "."


def _distinct(effects: Sequence[NamedEffect]) -> list[NamedEffect]:
    return list({effect.identifier: effect for effect in effects}.values())


def _add_primitives(page: Page, content: ReportInput) -> None:
    rows = []
    for effect in content.intervals:
        for item in effect:
            if item.parameter in ("velocity_exponent", "displacement_exponent", "reference_velocity",
                                  "reference_displacement", "element_count"):  # fmt: skip
                continue
            if isnan(item.low) or item.low == item.high:
                interval, value = "fixed", f"{item.value:.4g}"
            else:
                form = rounded(item.value, 0.5 * (item.high - item.low))
                value, interval = form(item.value), f"{form(item.low)} to {form(item.high)}"
            rows.append((item.parameter.replace("_", " "), value, interval, unit_text(item.unit)))
    if not rows:
        return
    marked = "" if content.investigation.verdict.kind is VerdictKind.NAMED else (
        f" It is that of {added_label(content.investigation)}, which is not named."
    )  # fmt: skip
    fmu = f" {content.fmu}" if content.fmu else ""
    page.add_table(
        Table(
            (
                Column("number"),
                Column("value", numeric=True),
                Column("90 % interval", numeric=True),
                Column("unit"),
            ),
            rows,
        ),
        f"patch.json holds it in SI units, ready for the model and its FMU.{marked}{fmu}",
        title="The change of the model",
    )


def _add_highlights(page: Page, investigation: Investigation) -> None:
    verdict, proof = investigation.verdict, investigation.proof
    items: list[tuple[str, str]] = []
    if not isnan(verdict.probability):
        items.append((probability_text(verdict.probability), "probability of the verdict"))
    if isfinite(verdict.log_bayes_factor) and verdict.hypotheses and verdict.hypotheses[0].effects:
        items.append((f"{verdict.log_bayes_factor:,.1f} nat", "ln Bayes factor against nothing missing"))
    if proof is not None:
        first, second, where = proof.fitted_before, proof.fitted_after, "fitted"
        if proof.held_out_before is not None and proof.held_out_after is not None:
            first, second, where = proof.held_out_before, proof.held_out_after, "held-out"
        items.append(
            (
                f"{number(first.chi_square_per_dof)} → {number(second.chi_square_per_dof)}",
                f"χ²/dof on {where} trials, before and after",
            )
        )
        if isfinite(proof.gap_closed):
            items.append((f"{_percent(proof.gap_closed)} %", "of the gap closed on held-out trials"))
    elif verdict.gates and isfinite(verdict.gates[0].statistic):
        items.append((number(verdict.gates[0].statistic), f"{verdict.gates[0].name}; limit "
                      f"{number(verdict.gates[0].limit)}"))  # fmt: skip
    if items:
        page.add_highlights(items)


def _percent(share: float) -> str:
    text = 100.0 * share
    return "> 99.9" if 99.95 < text < 100.0 else f"{text:.1f}"


def _add_next(page: Page, investigation: Investigation) -> None:
    page.add_paragraph(
        "What would decide most between the hypotheses that are still open, for its cost. Information is "
        "the mutual "
        "information of hypothesis and data, by simulation; ln 2 = 0.69 nat decides between two equals."
    )
    page.add_table(
        Table(
            (
                Column("test"), Column("why"), Column("information", "nat", numeric=True),
                Column("cost", "trials", numeric=True),
            ),
            [
                (item.description, item.reason, f"{item.information:.2f}", f"{item.cost:g}")
                for item in investigation.verdict.next_experiments
            ],
        ),
        "Cost is relative to one more trial of a kind that was done already.",
        title="Proposed tests, best first",
    )  # fmt: skip


def _add_location(page: Page, investigation: Investigation) -> None:
    location = investigation.location
    if location is None:
        page.add_paragraph("The residuals were not searched for patterns.")
        return
    if not location.disagrees:
        page.add_paragraph(
            "No global test finds a disagreement between the model as it was and the fitted trials."
        )
    else:
        significant = sum(cell.significant for cell in location.cells)
        page.add_paragraph(
            f"The model as it was disagrees with the fitted trials; {significant} of "
            f"{len(location.cells)} cells of "
            "the map (channel, trial, and bin of time, amplitude, frequency or load) are discoveries at a "
            "false "
            "discovery rate of 5 %."
        )
    findings = [item for item in location.disagreements if item.share >= LEAST_SHARE][:SHOWN_FINDINGS]
    for item in findings:
        page.add_paragraph(f"• {item.sentence}")
    page.add_table(
        Table(
            (
                Column("test"),
                Column("statistic", numeric=True),
                Column("p", numeric=True),
                Column("disagrees"),
            ),
            [
                (
                    test.name,
                    number(test.statistic, 4),
                    p_value_text(test.p_value),
                    "yes" if test.rejected else "no",
                )
                for test in location.tests
            ],
        ),
        "Residuals of the model as it was on fitted trials, each against what noise would leave after the "
        "fit; "
        "Holm's rule at 1 % over the tests.",
        title="Global tests",
    )


def _add_gates(page: Page, investigation: Investigation) -> None:
    gates = investigation.verdict.gates
    if not gates:
        return
    page.add_table(
        Table(
            (
                Column("gate"), Column("passed"), Column("statistic", numeric=True), Column("limit", numeric=True),
                Column("reason"),
            ),
            [
                (
                    gate.name,
                    "not applied" if gate.passed is None else "yes" if gate.passed else "no",
                    number(gate.statistic), number(gate.limit), gate.reason,
                )
                for gate in gates
            ],
        ),
        "A name must fit the noise record (absolute fit), and freeing its shape must not gain more than "
        "two nats.",
        title="Gates",
    )  # fmt: skip


def _add_inclusion(page: Page, investigation: Investigation) -> None:
    inclusion = sorted(investigation.verdict.inclusion.items(), key=lambda row: -row[1])
    shown = [row for row in inclusion if row[1] >= 1e-3][:6]
    if len(shown) < 2:
        return
    page.add_paragraph(
        "Probability that an effect takes part: "
        + listing(f"{name.replace('_', ' ')} {probability_text(p)}" for name, p in shown)
        + "."
    )


def _add_proof(page: Page, investigation: Investigation, proof: Proof) -> None:
    if investigation.verdict.kind is not VerdictKind.NAMED:
        page.add_notice(
            f'The model "with the effect" has {added_label(investigation)} here, which is not named: the figures '
            "say how well it does, not that it is there."
        )
    page.add_paragraph(proof.remaining)
    held = [item.trial.name for item in investigation.before.trials if item.trial.held_out] if (
        investigation.before is not None
    ) else []  # fmt: skip
    columns = [Column("score")]
    pairs: list[tuple[Scores, Scores]] = []
    if proof.held_out_before is not None and proof.held_out_after is not None:
        columns += [Column("held out, before", numeric=True), Column("held out, after", numeric=True)]
        pairs.append((proof.held_out_before, proof.held_out_after))
    columns += [Column("fitted, before", numeric=True), Column("fitted, after", numeric=True)]
    pairs.append((proof.fitted_before, proof.fitted_after))
    rows: list[tuple[str, ...]] = []

    def add(title: str, show: Callable[[Scores], str]) -> None:
        rows.append((title, *(show(item) for pair in pairs for item in pair)))

    add("χ²/dof (1 is noise)", lambda s: number(s.chi_square_per_dof, 4))
    add("its deviation if the model is right", lambda s: number(s.chi_square_deviation, 2))
    add("mean log score, nat per sample (best −1.42)", lambda s: number(s.log_score, 4))
    add("coverage of 50 % intervals, %", lambda s: f"{100.0 * s.coverage_50:.1f}")
    add("coverage of 90 % intervals, %", lambda s: f"{100.0 * s.coverage_90:.1f}")
    add("whiteness, p", lambda s: p_value_text(s.whiteness))
    add("flat histogram of transforms, p", lambda s: p_value_text(s.pit_p_value))
    add("samples", lambda s: str(s.sample_count))
    channels = investigation.before.channels if investigation.before is not None else {}
    for name in dict.fromkeys(name for pair in pairs for name in pair[0].rms):
        factor, unit = UNIT_OF[channels[name].quantity] if name in channels else (1.0, "")
        add(
            f"rms of {name}, {unit}",
            lambda s, name=name, factor=factor: (
                number(factor * s.rms[name]) if name in s.rms else "\N{EN DASH}"
            ),  # type: ignore[misc]
        )
    gain = "Nothing is held out, so that nothing is proved." if proof.held_out_after is None else (
        f"Gain in log score on held-out trials {number(proof.log_score_gain, 4)} "
        f"± {number(proof.log_score_gain_error, 2)} nat per sample. "
    )  # fmt: skip
    closed = (
        f"Gap closed: {_percent(proof.gap_closed)} %." if isfinite(proof.gap_closed) else proof.gap_reason
    )
    trials = f" Held out: {', '.join(held)}; only their own releases and zeros were adapted." if held else ""
    page.add_table(
        Table(columns, rows), f"{gain}{closed}{trials}", title="Before and after, at the same scale"
    )


def _add_separability(page: Page, content: ReportInput) -> None:
    found = content.separability
    if found is None:
        return
    for line in group_lines(found):
        page.add_paragraph(line)
    untested = [(i.effect.name, i.reason) for i in found.detectability if i.reason]
    if untested:
        page.add_table(
            Table((Column("effect"), Column("why not")), untested),
            "These can be neither named nor excluded by this campaign and model.",
            title="Effects that cannot be tested here",
        )
    page.add_table(
        can_decide_table(found),
        "From the model, the inputs and the noise alone. Detectable from: the size at which d² reaches "
        "25, with "
        "all nuisances adapted.",
        title="Detectable sizes",
    )


def _share(share: Share) -> str:
    return (
        f"{share.count} of {share.total}: {100.0 * share.value:.0f} % "
        f"({100.0 * share.low:.0f} to {100.0 * share.high:.0f} %)"
    )


def _add_self_calibration(page: Page, content: ReportInput) -> None:
    found = content.self_calibration
    if found is None:
        return
    rows = [
        (title, outcome, _share(found.share(outcome, null=null)))
        for title, null in (("an effect was hidden", False), ("nothing was hidden", True))
        for outcome in outcomes(found, null=null)
    ]
    rows.append(("named rightly", "90 % intervals that hold the true value", _share(found.coverage())))
    absent = (
        f" Never detectable in draws of their priors, so not hidden: {', '.join(found.not_detectable)}."
        if found.not_detectable
        else ""
    )
    page.add_table(
        Table((Column("campaigns"), Column("outcome"), Column("share, 90 % Wilson interval")), rows),
        "Simulated by the model that looks for the effect, with half its time step: this says what the "
        "campaign and "
        f"the workflow can do, not that the model is right.{absent} self_calibration.json has every case.",
        title="Verdicts on simulated campaigns of this geometry",
    )


def _add_data(page: Page, investigation: Investigation) -> None:
    page.add_section("Data")
    for fault in investigation.faults:
        page.add_notice(fault.sentence)
    told = {fault.sentence for fault in investigation.faults}
    remarks = [text for text in investigation.verdict.remarks if text not in told]
    for text in remarks:
        page.add_paragraph(f"• {text}")
    if not told and not remarks:
        page.add_paragraph("No fault was found.")
    campaign = investigation.campaign
    page.add_table(
        Table(
            (
                Column("trial"), Column("kind"), Column("run"), Column("rows", numeric=True), Column("channels"),
                Column("role"), Column("left out", numeric=True),
            ),
            [
                (
                    trial.name, trial.kind.value, trial.run or "\N{EN DASH}", str(len(trial.time)),
                    _few(trial.channels), "held out" if trial.held_out else "fitted", str(int((~trial.used).sum())),
                )
                for trial in campaign.trials
            ],
        ),
        "Left out: single samples that were marked as outliers or empty.",
        title="Trials",
    )  # fmt: skip


def _few(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 8 else f"{', '.join(names[:6])} and {len(names) - 6} more"


def _add_origin(page: Page, origin: Origin) -> None:
    page.add_section("Where it comes from")
    provenance = origin.provenance
    rows = [
        ("campaign", f"{origin.campaign}, SHA-256 {origin.data_hash}"),
        ("model", f"{origin.model}, SHA-256 {origin.model_hash}"),
        ("command", origin.command),
        ("seed", str(provenance.seed)),
        *((f"input {name}", f"SHA-256 {value}") for name, value in provenance.input_hashes.items()),
        ("software", ", ".join(f"{name} {version}" for name, version in provenance.versions.items())),
        ("sources", ", ".join(f"{name} {value[:12]}" for name, value in provenance.source_hashes.items())),
    ]
    page.add_table(
        Table((Column("item"), Column("value")), rows),
        "verdict.json, patch.json and residuals.nc beside this page hold every figure.",
        title="Provenance",
    )


__all__ = ["ReportFigure", "ReportInput", "draw", "hypothesis_name", "render_report", "report_figures"]
