"""The campaign on the wing of the blind test: channels, and trials in laboratory and flight."""

from dataclasses import replace

import numpy as np

from benchmarks.blind.plan import CampaignPlan, ChannelPlan, TrialPlan, schedule
from benchmarks.blind.wing_basis import MIDDLE
from fe.wing.design import WingDesign

MICROSTRAIN, MILLIMETRE = 1e-6, 1e-3
STRAIN_NOISE = 5.0  # microstrain
DISPLACEMENT_NOISE = 0.1  # mm
RATE = 250.0  # Hz
SHORT = 3.5
LONG = 6.0
"""Recorded times of releases [s]."""
WARMER = 15.0
"""Temperature of the warm trials above the reference [K]."""
DYNAMIC = ("g02", "g10", "tip")
"""Channels of ring-downs: a gauge near the root, one outboard, the tip."""
PRIORS = {
    "young_modulus_factor": (1.0073, 0.0103),
    "servo_mass": (0.169, 0.004),
    "pitot_mass": (0.134, 0.0075),
    "damping_alpha": (1.0735, 0.03 * 1.0735),
    "damping_beta": (7.31e-4, 0.03 * 7.31e-4),
}
"""Posterior of the twin's calibration."""
PLACES: dict[str, str | tuple[float, float]] = {
    "tip": "tip_load",
    "middle": MIDDLE,
    "corner": (1.778, 0.9),
}
NIGHT = 12.0 * 3600.0
"""Time between the laboratory and the first flight [s]."""
LOAD_PLACES = {"A": "tip", "B": "middle", "C": "corner"}
"""Where each run of static trials loads the wing."""


def _channels(design: WingDesign) -> dict[str, ChannelPlan]:
    """Return the channels by name: the gauges of a design, and three displacements."""
    channels = {}
    for number, (station, chord) in enumerate(design.gauges.positions):
        name = f"g{number:02d}"
        channels[name] = ChannelPlan(
            name=name,
            quantity="strain",
            unit="microstrain",
            output=f"strain[{number + 1}]",
            scale=MICROSTRAIN,
            noise=STRAIN_NOISE,
            gain=0.005,
            offset=2.0,
            station=station,
            chord=chord,
        )
    span = design.planform.semi_span
    tip_load = design.tip_load
    displacements = {
        "load_point": (
            "load_point_displacement",
            span - tip_load.distance_from_tip,
            tip_load.chord,
        ),
        "tip": ("tip_displacement", span, tip_load.chord),
        "middle": (f"displacement[{MIDDLE[0]}, {MIDDLE[1]}]", *MIDDLE),
    }
    for name, (output, station, chord) in displacements.items():
        channels[name] = ChannelPlan(
            name=name,
            quantity="displacement",
            unit="mm",
            output=output,
            scale=MILLIMETRE,
            noise=DISPLACEMENT_NOISE,
            gain=0.005,
            offset=0.05,
            station=station,
            chord=chord,
        )
    return channels


def _load_tests(channels: tuple[str, ...]) -> list[TrialPlan]:
    """Return two load tests up and down at each place; the second at the tip is held out."""
    levels = np.round(np.linspace(10.0 / 6.0, 10.0, 6), 3)
    forces = np.concatenate([levels, -levels])
    trials = []
    for run, place in LOAD_PLACES.items():
        first = TrialPlan(f"{place} 1", "static", run, channels, forces, place=place)
        second = replace(first, name=f"{place} 2", held_out=run == "A")
        trials += [first, second]
    return trials


def _release(amplitude: float, repeat: int, duration: float) -> TrialPlan:
    """Return a release of the tip.

    Parameters
    ----------
    amplitude : float
        Displacement before the release, upwards [mm].
    repeat : int
        Number of the repetition.
    duration : float
        Time that is recorded [s].
    """
    direction = "up" if amplitude > 0.0 else "down"
    return TrialPlan(
        name=f"release {abs(amplitude):.0f} mm {direction} {repeat}",
        kind="ringdown",
        run="R",
        channels=DYNAMIC,
        rows=np.arange(round(duration * RATE)) / RATE,
        place="tip",
        release=amplitude * MILLIMETRE,
        held_out=amplitude == 25.0,
    )


def wing_campaign(design: WingDesign) -> CampaignPlan:
    """Return the plan of the campaign on a wing.

    Load tests and releases are followed by the same at 15 K above the reference temperature, and by
    two flights on the next day.
    """
    channels = _channels(design)
    gauges = tuple(name for name in channels if name.startswith("g"))
    load_tests = _load_tests(tuple(channels))
    releases = [
        _release(15.0, 1, SHORT),
        _release(-15.0, 1, SHORT),
        _release(40.0, 1, SHORT),
        _release(40.0, 2, SHORT),
        _release(-40.0, 1, SHORT),
        _release(25.0, 1, SHORT),
        _release(40.0, 3, LONG),
    ]
    warm_load_tests = [
        replace(trial, name=f"{trial.place} warm", temperature=WARMER, held_out=False)
        for trial in load_tests[::2]
    ]
    warm_release = replace(releases[2], name="release 40 mm warm", release=0.04, temperature=WARMER)
    flights = [
        TrialPlan(f"flight {repeat}", "flight", "F", gauges, np.array([1.0, 2.0, 3.0]))
        for repeat in (1, 2)
    ]
    trials = [*load_tests, *releases, *warm_load_tests, warm_release, *flights]
    return CampaignPlan(
        name="Wing in the laboratory and in flight",
        channels=channels,
        trials=schedule(trials, longer_pauses={"flight 1": NIGHT}),
        reference_temperature=20.0,
        priors=PRIORS,
        places=PLACES,
    )
