"""Parameters, gains and zeros that a fit moves far from what is stated of them.

A wrong model can fit by leaving what was calibrated: what it has taken up so leaves no residual.
"""

from collections.abc import Sequence

from discrepancy.campaign.units import UNITS
from discrepancy.fits.fitting import CandidateFit
from discrepancy.fits.problem import Problem
from discrepancy.verdict import MovedUnknown
from reporting.words import listing

MOVED_DEVIATIONS = 2.0
"""Stated standard deviations from which on a parameter, gain or zero is named."""
UNKNOWNS_TOLD = 5
"""Of these, how many a sentence names."""


def moved_unknowns(problem: Problem, fit: CandidateFit) -> tuple[MovedUnknown, ...]:
    """Return what a fit moves by more than `MOVED_DEVIATIONS` of its stated deviations, the farthest first.

    Parameters
    ----------
    problem : Problem
        Campaign and model.
    fit : CandidateFit
        Mostly that of the model as it is.
    """
    unknowns = [*_moved_parameters(problem, fit), *_moved_gains(problem, fit), *_moved_zeros(problem, fit)]
    far = [item for item in unknowns if abs(item.deviations) > MOVED_DEVIATIONS]
    return tuple(sorted(far, key=lambda item: -abs(item.deviations)))


def _moved_parameters(problem: Problem, fit: CandidateFit) -> list[MovedUnknown]:
    shared = problem.shared
    values = shared.parameters(fit.point.shared)
    found = []
    for number, parameter in enumerate(problem.model.parameters):
        centre, scale = float(shared.centre[number]), float(shared.scale[number])
        if scale > 0.0:
            value = float(values[number])
            deviations = (value - centre) / scale
            found.append(MovedUnknown(parameter.name, centre, scale, value, deviations, parameter.unit))
    return found


def _moved_gains(problem: Problem, fit: CandidateFit) -> list[MovedUnknown]:
    shared, found = problem.shared, []
    for row, channel in enumerate(shared.gain_channels):
        number = shared.count + row
        u, scale = float(fit.point.shared[number]), float(shared.scale[number])
        if shared.precision[number] > 0.0:
            name = f"gain of {channel}"
            found.append(MovedUnknown(name, 0.0, scale, scale * u, u, "1"))
    return found


def _moved_zeros(problem: Problem, fit: CandidateFit) -> list[MovedUnknown]:
    """Return the zeros of channels, and the constants of inputs, in the trials of a fit."""
    found = []
    for data, local in zip(problem.trials, fit.point.local, strict=True):
        trial, unknowns = data.trial, data.unknowns
        first_constant, last_constant = unknowns.ends[1:3]
        names = []
        for column in unknowns.zero_columns:
            channel = trial.channels[column]
            unit = UNITS[problem.campaign.channels[channel].quantity].si
            names.append((f"zero of {channel} in {trial.name!r}", unit))
        numbers = list(range(unknowns.zeros))
        for row in unknowns.offset_inputs:
            item = trial.inputs[row]
            names.append((f"constant of {item.name} in {trial.name!r}", UNITS[item.quantity].si))
        numbers += range(first_constant, last_constant)
        for (name, unit), number in zip(names, numbers, strict=True):
            u, scale = float(local[number]), float(unknowns.scale[number])
            if unknowns.precision[number] > 0.0:
                found.append(MovedUnknown(name, 0.0, scale, scale * u, u, unit))
    return found


def moved_sentence(moved: Sequence[MovedUnknown]) -> str:
    """Return what the model as it is moves, in one sentence; empty: nothing."""
    if not moved:
        return ""
    parts = [_moved_text(item) for item in moved[:UNKNOWNS_TOLD]]
    more = len(moved) - UNKNOWNS_TOLD
    if more > 0:
        parts.append(f"{more} more")
    return f"Fitted without an effect, the model moves {listing(parts)}."


def _moved_text(item: MovedUnknown) -> str:
    """Return an unknown with what is stated of it, its value, and the deviations between them."""
    off = f"{abs(item.deviations):.1f} deviations"
    unit = "" if item.unit == "1" else f" {item.unit}"
    if item.name.startswith("gain of "):
        stated = f"stated to {100.0 * item.deviation:.3g} %"
        return f"the {item.name} by {100.0 * item.value:+.3g} % ({stated}; {off})"
    if item.stated == 0.0:
        return f"the {item.name} to {item.value:.3g}{unit} (stated to {item.deviation:.3g}{unit}; {off})"
    stated = f"{item.stated:.4g} ± {item.deviation:.2g}"
    return f"{item.name!r} from {stated} to {item.value:.4g}{unit} ({off})"
