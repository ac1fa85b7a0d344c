"""What the published ring-downs and loading runs of the real wing say about the wing model.

`python -m benchmarks.study_real_wing DATA` investigates them with several windows of the
ring-downs, and the loading runs alone. DATA is the authors' calibration folder.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console
from rich.table import Table

from discrepancy.campaign.reading import read_campaign
from discrepancy.campaign.records import Campaign
from discrepancy.fits.fitting import CandidateFit
from discrepancy.judgement.hypotheses import named_effects
from discrepancy.sources.measured_rigs import write_rig_campaign
from discrepancy.sources.real_wing import SIGNAL
from discrepancy.system.wing_model import WingModel
from discrepancy.workflow import Investigation, investigate

BEGINS = (0.8, 1.0, 1.25)


def wing_campaign(data: Path, begin: float) -> Campaign:
    """Return the campaign of the published records, the ring-downs from a moment on."""
    with TemporaryDirectory() as folder:
        return read_campaign(write_rig_campaign("real_wing", data, Path(folder), begin=begin))


def report(found: Investigation, table: Table, label: str) -> None:
    proof = found.proof
    scores = (
        []
        if proof is None
        else [errors for errors in (proof.held_out_before, proof.held_out_after) if errors]
    )
    rms = " to ".join(f"{1e3 * score.rms[SIGNAL]:.3f}" for score in scores if SIGNAL in score.rms)
    chi = " to ".join(f"{score.chi_square_per_sample:.2f}" for score in scores)
    table.add_row(label, found.verdict.kind.value, found.verdict.sentence, rms, chi)


def alone(runs: Sequence[Investigation], begins: Sequence[float]) -> Table:
    """Return unexplained error and log evidence of single effects and their families, by window."""
    table = Table(
        "one effect alone", *(f"ln evidence from {begin:g} s" for begin in begins), "left, uV"
    )
    rows: dict[str, list[str]] = {}
    unexplained: dict[str, str] = {}
    for number, investigation in enumerate(runs):
        if investigation.search is None or investigation.problem is None:
            continue
        best: dict[str, CandidateFit] = {}
        for fit in investigation.search.compared_fits().values():  # of all places the most probable
            label = " ".join(fit.candidate.identifiers) or "none"
            if len(fit.candidate.terms) < 2 and (
                label not in best
                or investigation.search.score(best[label]) < investigation.search.score(fit)
            ):
                best[label] = fit
        for label, fit in best.items():
            shape = [u for part in named_effects(investigation.problem, fit) for u in part.shape]
            place = "".join(f" {term.place}" for term in fit.candidate.terms)
            cells = rows.setdefault(label, [""] * len(runs))
            cells[number] = f"{fit.log_evidence:.1f}{place}" + "".join(
                f" ({u.name} {u.value:.2f})" for u in shape
            )
            if number == 0:
                residuals = [
                    1e6 * data.deviation[0] * float(np.sqrt((residual[:, 0] ** 2).mean()))
                    for data, residual in zip(
                        investigation.problem.trials, fit.residuals, strict=True
                    )
                    if data.trial.is_dynamic
                ]
                unexplained[label] = ", ".join(f"{value:.0f}" for value in residuals)
    for label, values in rows.items():
        table.add_row(label, *values, unexplained.get(label, ""))
    return table


def by_the_others(campaign: Campaign) -> dict[str, float]:
    """Return the rms [V] that the mean of other ring-downs leaves of each held-out one, by name.

    No model: all releases are alike, so that the others predict a record as far as the wing repeats
    itself.
    """
    records = [trial for trial in campaign.trials if trial.is_dynamic]
    values = np.array([trial.values[:, 0] for trial in records])
    residuals = (values * len(values) - values.sum(axis=0)) / (
        len(values) - 1
    )  # less the mean of the others
    return {
        trial.name: float(np.sqrt((residual**2).mean()))
        for trial, residual in zip(records, residuals, strict=True)
        if trial.held_out
    }


def held_out_rms(campaign: Campaign, found: Investigation) -> str:
    """Return the residual of each held-out trial: after the mean of the others, and of the fit."""
    fitted = () if found.after is None else found.after.trials
    ours = {
        trial_fit.trial.name: float(
            np.sqrt((trial_fit.residual[:, trial_fit.trial.channels.index(SIGNAL)] ** 2).mean())
        )
        for trial_fit in fitted
        if trial_fit.trial.held_out and SIGNAL in trial_fit.trial.channels
    }
    return ", ".join(
        f"{name} {1e6 * rms:.1f} uV by the others, "
        f"{1e6 * ours.get(name, float('nan')):.1f} uV by the model"
        for name, rms in by_the_others(campaign).items()
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument(
        "--begin", type=float, nargs="+", default=BEGINS, help="windows of the ring-downs, s"
    )
    arguments = parser.parse_args()
    model = WingModel.of_design()
    table = Table("records", "verdict", "", "held out: rms, mV", "χ²/dof")
    console = Console(width=160)
    runs = []
    for begin in arguments.begin:
        campaign = wing_campaign(arguments.data, begin)
        runs.append(investigate(campaign, model))
        console.print(f"From {begin:g} s, held-out trials, rms: {held_out_rms(campaign, runs[-1])}")
        report(runs[-1], table, f"all, ring-downs from {begin:g} s")
    console.print(table)
    console.print(alone(runs, arguments.begin))
    first = runs[0]
    table = Table("records", "verdict", "", "held out: rms, mV", "χ²/dof")
    whole = wing_campaign(arguments.data, BEGINS[0])
    still = replace(
        whole,
        channels={name: channel for name, channel in whole.channels.items() if name != SIGNAL},
        trials=tuple(trial for trial in whole.trials if not trial.is_dynamic),
    )
    static = investigate(still, model)
    report(static, table, "loading runs alone")
    console.print(table)
    console.print("Loading runs alone:", static.verdict.probability)
    for row in static.verdict.hypotheses[:6]:
        console.print(
            [effect.identifier for effect in row.effects],
            f"{row.probability:.3f}",
            f"{row.chi_square:.1f}",
        )
    if first.location is not None:
        for disagreement in first.location.disagreements:
            console.print(disagreement)
    for experiment in first.verdict.next_experiments:
        console.print(experiment.description, f"{float(experiment.information):.3f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
