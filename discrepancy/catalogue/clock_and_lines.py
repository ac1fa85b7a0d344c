"""Effects of the clock and of lines in the spectrum: rate and zero, mains hum, a missing mode."""

from collections.abc import Mapping
from math import pi

from discrepancy.campaign.noise import MAINS, aliased
from discrepancy.campaign.records import TrialKind
from discrepancy.catalogue.building import (
    DYNAMIC,
    channels,
    largest_reading,
    needs,
    somewhere,
    trial_of,
    trials,
)
from discrepancy.catalogue.entry import Effect, EffectParameter, Prior, Setting
from fe.runtime.patch import EVERY_CHANNEL, Clock, DecayingLine, Line, LoggerClock, ModelPatch

RINGDOWN = frozenset({TrialKind.RINGDOWN})
INPUT = frozenset({TrialKind.FORCED, TrialKind.DRIVEN})
_ONE_LOGGER = "One logger records motion and inputs (`loggers`), so that the motion has no clock of its own."
ALL = "all "
"""Begins the place that stands for all channels of a quantity."""


# ---------------------------------------------------------------- clock


def _clock(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    zero = values["phase_zero"] / setting.scales.angular_frequency
    return ModelPatch((Clock(values["rate_error"], zero),))


def _second_clock(setting: Setting) -> str | None:
    """Return why the motion has no clock of its own, None if it may have one."""
    return _ONE_LOGGER if len(setting.campaign.loggers) == 1 and trials(setting, *INPUT) else None


def logger_names(setting: Setting) -> tuple[str, ...]:
    """Return the loggers of a campaign; `EVERY_CHANNEL` where one records everything."""
    loggers = setting.campaign.loggers
    return tuple(loggers) if len(loggers) > 1 else (EVERY_CHANNEL,)


def _logger_places(setting: Setting) -> tuple[str, ...]:
    return ("",) if logger_names(setting) == (EVERY_CHANNEL,) else logger_names(setting)


def _logger_clock(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    return ModelPatch((LoggerClock(place or EVERY_CHANNEL, values["rate_error"]),))


# ---------------------------------------------------------------- mains hum


def mains_lines(setting: Setting) -> tuple[str, ...]:
    """Return the mains lines that can be seen, such as "50 Hz" or "50 or 400 Hz".

    A line whose alias makes less than one period in every record is an offset there and left out. Lines whose
    aliases differ by less than half a period in every record look alike and are one.
    """
    sampled = [(trial.interval, float(trial.time[-1] - trial.time[0])) for trial in trials(setting, *DYNAMIC)]
    groups: list[list[float]] = []
    for frequency in MAINS:
        if all(aliased(frequency, interval) * length < 1.0 for interval, length in sampled):
            continue
        for group in groups:
            if all(
                abs(aliased(frequency, interval) - aliased(group[0], interval)) * length < 0.5
                for interval, length in sampled
            ):
                group.append(frequency)
                break
        else:
            groups.append([frequency])
    return tuple(" or ".join(f"{frequency:g}" for frequency in group) + " Hz" for group in groups)


def _targets(kinds: frozenset[TrialKind], setting: Setting) -> tuple[str, ...]:
    """Return channel names of dynamic trials, after "all strain" and the like for several of a quantity."""
    found = channels(setting, kinds=kinds)
    quantities = [channel.quantity.value for channel in found]
    several = dict.fromkeys(quantity for quantity in quantities if quantities.count(quantity) > 1)
    return (*(ALL + quantity for quantity in several), *(channel.name for channel in found))


def _hum_places(setting: Setting) -> tuple[str, ...]:
    return tuple(
        f"{line}, {target}" for line in mains_lines(setting) for target in _targets(DYNAMIC, setting)
    )


def _hum(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    line, _, target = place.partition(", ")
    frequency = float(line.split()[0]) * (1.0 + values["frequency_error"])
    found = channels(setting, kinds=DYNAMIC)
    if target.startswith(ALL) and target not in {channel.name for channel in found}:
        name, quantity = EVERY_CHANNEL, target.removeprefix(ALL)
        members = tuple(channel.name for channel in found if channel.quantity.value == quantity)
    else:
        name, quantity, members = target, "", (target,)
    scale = largest_reading(setting, members, DYNAMIC)
    cosine, sine = values["cosine_ratio"] * scale, values["sine_ratio"] * scale
    return ModelPatch((Line(name, frequency, cosine, sine, quantity),))


# ---------------------------------------------------------------- unmodelled mode


def _mode_places(setting: Setting) -> tuple[str, ...]:
    return tuple(channel.name for channel in channels(setting, kinds=RINGDOWN))


def _unmodelled_mode(setting: Setting, values: Mapping[str, float], place: str) -> ModelPatch:
    releases = [
        abs(trial.release.displacement)
        for trial in trials(setting, TrialKind.RINGDOWN)
        if trial.release is not None and place in trial.channels
    ]
    scale = largest_reading(setting, (place,), RINGDOWN) / (max(releases, default=0.0) or 1.0)
    frequency = values["frequency_ratio"] * setting.scales.angular_frequency / (2.0 * pi)
    return ModelPatch(
        (
            DecayingLine(
                place,
                frequency,
                min(values["damping_ratio"], 0.9),
                values["cosine_ratio"] * scale,
                values["sine_ratio"] * scale,
            ),
        )
    )


CLOCK_ERROR = Effect(
    identifier="clock_error",
    name="clock rate and time zero",
    family="clock",
    equation="t -> (1 + e) t + t_0, t_0 = phi / w_1",
    signature="All frequencies are off by the same share, damping ratios are not, and static trials fit.",
    reference="Mills 1991, IEEE Trans. Commun. 39 (10), 1482-1493",
    acts_on=DYNAMIC,
    parameters=(
        EffectParameter(
            "rate_error",
            "e",
            "1",
            "relative error of the sampling clock",
            Prior("normal", -5e-3, 5e-3),
            magnitude=True,
        ),
        EffectParameter(
            "phase_zero",
            "phi",
            "rad",
            "error of the time zero as a phase of the first mode, w_1 t_0",
            Prior("normal", -0.1, 0.1),
            magnitude=True,
        ),
    ),
    build=_clock,
    unavailable=needs(trial_of(DYNAMIC), _second_clock),
    confusable=("point_mass", "root_compliance", "stiffness_drift"),
)

LOGGER_CLOCK = Effect(
    identifier="logger_clock",
    name="clock rate of the logger",
    family="clock",
    equation="t -> (1 + e) t for readings and recorded inputs alike",
    signature="As if stiffness and load were both (1 + e)^2 times as large and damping (1 + e) times.",
    reference="Mills 1991, IEEE Trans. Commun. 39 (10), 1482-1493",
    acts_on=DYNAMIC,
    parameters=(
        EffectParameter(
            "rate_error",
            "e",
            "1",
            "relative error of the logger's clock",
            Prior("normal", -5e-3, 5e-3),
            magnitude=True,
        ),
    ),
    build=_logger_clock,
    places=_logger_places,
    unavailable=needs(trial_of(INPUT)),
    confusable=("clock_error", "load_cell"),
)

MAINS_HUM = Effect(
    identifier="mains_hum",
    name="mains hum",
    family="line in the spectrum",
    equation="eps -> eps + a cos 2 pi f t + b sin 2 pi f t, f = 50, 60 or 400 Hz, aliased by the sampling",
    signature="A line of constant height at the mains frequency or its alias, in the noise record too.",
    reference="Ott 2009, Electromagnetic Compatibility Engineering",
    acts_on=DYNAMIC,
    parameters=(
        EffectParameter(
            "cosine_ratio",
            "a / eps_max",
            "1",
            "cosine over the largest dynamic reading",
            Prior("normal", -0.05, 0.05),
            magnitude=True,
        ),
        EffectParameter(
            "sine_ratio",
            "b / eps_max",
            "1",
            "sine over the largest dynamic reading",
            Prior("normal", -0.05, 0.05),
            magnitude=True,
        ),
        EffectParameter(
            "frequency_error",
            "e_f",
            "1",
            "relative deviation of the mains from its nominal frequency",
            Prior("normal", -1e-3, 1e-3),
        ),
    ),
    build=_hum,
    places=_hum_places,
    unavailable=needs(
        trial_of(DYNAMIC),
        somewhere(mains_lines, "At these sampling rates every mains line is aliased to zero frequency."),
    ),
    confusable=("unmodelled_mode",),
)

UNMODELLED_MODE = Effect(
    identifier="unmodelled_mode",
    name="unmodelled mode",
    family="line in the spectrum",
    equation="eps -> eps + e^(-zeta w t) (a cos w_d t + b sin w_d t), w = nu w_1",
    signature="A further decaying line; near a mode it beats: frequency and damping seem to vary.",
    reference="Ewins 2000, Modal Testing: Theory, Practice and Application, 2nd ed.",
    acts_on=RINGDOWN,
    parameters=(
        EffectParameter(
            "frequency_ratio",
            "nu",
            "1",
            "frequency over that of the first mode",
            Prior("log_normal", 0.3, 12.0),
        ),
        EffectParameter(
            "damping_ratio",
            "zeta",
            "1",
            "its damping ratio (built up to 0.9)",
            Prior("log_normal", 0.003, 0.10),
        ),
        EffectParameter(
            "cosine_ratio",
            "a / eps_max",
            "1",
            "cosine over the largest reading after the largest release",
            Prior("normal", -0.30, 0.30),
            magnitude=True,
        ),
        EffectParameter(
            "sine_ratio",
            "b / eps_max",
            "1",
            "sine over the largest reading after the largest release",
            Prior("normal", -0.30, 0.30),
            magnitude=True,
        ),
    ),
    build=_unmodelled_mode,
    places=_mode_places,
    unavailable=needs(trial_of(RINGDOWN)),
    confusable=("mains_hum", "stiffness_drift", "joint_micro_slip"),
    spectral="frequency_ratio",
)

EFFECTS = (CLOCK_ERROR, LOGGER_CLOCK, MAINS_HUM, UNMODELLED_MODE)
