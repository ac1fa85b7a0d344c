"""A measurement that is planned on a structure: which suspicions it can tell apart.

Before anything is measured, the gauges, displacements and accelerations of a structure file are the
channels of a campaign with stated noise, and its forces the trials: static load lines, and releases
of these loads. `judgement.separability` says what such a campaign can decide.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from discrepancy.campaign.protocol import Release
from discrepancy.campaign.records import Campaign, Channel, NoiseRecord, Quantity, Trial, TrialKind
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.errors import ModelError
from discrepancy.fits.candidate import EffectTerm
from discrepancy.judgement.separability import Detectability, Separability, compute_separability
from discrepancy.system.structures import StructureModel
from discrepancy.system.system_state import SystemState
from fe.runtime.patch import ModelPatch

SUSPECTS = (
    "support_compliance",
    "added_mass",
    "region_stiffness_loss",
    "load_offset",
    "load_direction",
    "gauge_misalignment",
    "gauge_offset",
    "gauge_gain",
)
"""What a structural engineer suspects first."""
LEVELS = 8
"""Number of levels of a load line, from zero to the largest force."""
SAMPLES, SAMPLES_PER_PERIOD = 1200, 20
"""Samples of the ring-down after a release, and samples in a period of the first mode."""
RELEASED_SHARE = 0.5
"""Force of a release over the largest one."""
RELEASE_DEVIATION = 0.02
"""Standard deviation of the displacement of a release, as a fraction of it."""
ZERO_OVER_NOISE = 2.0
"""Standard deviation of a channel's zero over that of its noise."""


class Precision(NamedTuple):
    """How precise the planned channels are.

    Attributes
    ----------
    noise : mapping of Quantity to float
        Standard deviation of the noise of a reading, by quantity [SI].
    gain : float
        Standard deviation of the relative error of a gain [1].
    """

    noise: dict[Quantity, float]
    gain: float


class Plan(NamedTuple):
    """Trials that are planned, and what they can decide.

    Attributes
    ----------
    setting : Setting
        The campaign of these trials, and the structure.
    separability : Separability
        Which suspicions they show, and which of them look alike.
    """

    setting: Setting
    separability: Separability

    def least_change(self, row: Detectability) -> ModelPatch | None:
        """Return the patch of a suspected effect at the least value that the trials detect.

        The other parameters of the effect have their start values. The result is None if the trials
        detect no value of it.
        """
        if row.reason or not np.isfinite(row.detectable):
            return None
        term = EffectTerm(row.effect, row.place)
        values = term.physical_values(term.start_values()) | {row.parameter: row.detectable}
        return row.effect.patch(self.setting, values, row.place)


def plans_of(
    model: StructureModel, precision: Precision, catalogue: Sequence[Effect]
) -> tuple[Plan, Plan]:
    """Return what static loads can decide, and what static loads together with releases can.

    Parameters
    ----------
    model : StructureModel
        The structure with the changes that it may have.
    precision : Precision
        How precise the channels are.
    catalogue : sequence of Effect
        The catalogue; only the effects among `SUSPECTS` are compared.

    Raises
    ------
    ModelError
        If the structure has no force, or nothing that is read at rest.
    """
    if not model.forces:
        raise ModelError(
            f"The structure {model.name} has no control in N: a planned load line needs one; give "
            'a [[control]] with unit = "N" and a [[load]] tied to it.'
        )
    if set(model.quantities.values()) <= {Quantity.ACCELERATION}:
        raise ModelError(
            f"The structure {model.name} has neither a gauge nor a displacement, which a planned "
            "load line would be read by: give a [[gauge]] or a [[displacement]]."
        )
    suspects = [effect for effect in catalogue if effect.identifier in SUSPECTS]
    lines = _load_lines(model)
    static = _plan(model, precision, lines, suspects)
    with_releases = _plan(model, precision, [*lines, *_releases(model)], suspects)
    return static, with_releases


def _plan(
    model: StructureModel,
    precision: Precision,
    trials: Sequence[Trial],
    suspects: Sequence[Effect],
) -> Plan:
    """Return what planned trials can decide of some suspicions."""
    campaign = _campaign_of(model, precision, trials)
    setting = Setting(campaign, model, model.scales(campaign))
    return Plan(setting, compute_separability(campaign, model, setting, suspects))


def _campaign_of(model: StructureModel, precision: Precision, trials: Sequence[Trial]) -> Campaign:
    """Return the campaign of planned trials, with the channels that they record.

    A channel has stated noise, a zero known to `ZERO_OVER_NOISE` times that, and the gain error of
    the precision.
    """
    recorded = {name for trial in trials for name in trial.channels}
    channels = {}
    for name, quantity in model.quantities.items():
        if name in recorded:
            noise = precision.noise[quantity]
            channels[name] = Channel(
                name,
                quantity,
                output=name,
                noise=NoiseRecord(noise),
                gain_deviation=precision.gain,
                offset_deviation=ZERO_OVER_NOISE * noise,
            )
    return Campaign(
        name=f"planned on {model.name}",
        channels=channels,
        trials=tuple(trials),
        reference_temperature=None,
        parameters={},
        data_hash="",
    )


def _load_lines(model: StructureModel) -> list[Trial]:
    """Return a static trial of each force, from zero to the largest force in `LEVELS` steps.

    The readings of the trials are zero, and accelerations are not among the channels.
    """
    channels = tuple(
        name for name, quantity in model.quantities.items() if quantity is not Quantity.ACCELERATION
    )
    force = np.linspace(0.0, model.largest_force, LEVELS)
    rows = np.arange(float(LEVELS))
    lines = []
    for name in model.forces:
        lines.append(
            Trial.plain(
                f"load {name}", TrialKind.STATIC, channels, rows, force=force, load_place=name
            )
        )
    return lines


def _releases(model: StructureModel) -> list[Trial]:
    """Return a ring-down after the release of each force, held at `RELEASED_SHARE` of the largest.

    The structure is released from the static displacement along the force at the prior mean of the
    parameters.
    """
    state = SystemState(tuple(model.prior_mean().tolist()))
    system = model.build_system(state)
    first_frequency = float(system.angular_frequency.min()) / (2.0 * np.pi)  # Hz
    time = np.arange(SAMPLES) / (SAMPLES_PER_PERIOD * first_frequency)
    releases = []
    for name in model.forces:
        load = model.force_row(name, state)  # (modes,) under a unit force
        flexibility = float(load @ np.linalg.solve(system.stiffness, load))  # m/N
        displacement = RELEASED_SHARE * model.largest_force * flexibility
        releases.append(
            Trial.plain(
                f"release of {name}",
                TrialKind.RINGDOWN,
                tuple(model.quantities),
                time,
                load_place=name,
                release=Release(displacement, RELEASE_DEVIATION),
            )
        )
    return releases
