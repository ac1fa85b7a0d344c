"""The laboratory and flight campaign of the wing: what is done, with which channels."""

import numpy as np

from benchmarks.blind.plan import CampaignPlan, ChannelPlan, TrialPlan
from benchmarks.blind.wing_basis import MIDDLE
from fe.wing.design import WingDesign

MICROSTRAIN, MILLIMETRE = 1e-6, 1e-3
STRAIN_NOISE = 5.0  # microstrain
DISPLACEMENT_NOISE = 0.1  # mm
RATE = 250.0  # Hz
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
PLACES: dict[str, str | tuple[float, float]] = {"tip": "tip_load", "middle": MIDDLE, "corner": (1.778, 0.9)}
HOUR = 3600.0


def wing_campaign(design: WingDesign) -> CampaignPlan:
    """Return the plan of the campaign."""
    channels = {
        f"g{k:02d}": ChannelPlan(
            f"g{k:02d}",
            "strain",
            "microstrain",
            f"strain[{k + 1}]",
            MICROSTRAIN,
            STRAIN_NOISE,
            0.005,
            2.0,
            y,
            x,
        )
        for k, (y, x) in enumerate(design.gauges.positions)
    }
    span = design.planform.semi_span
    load = span - design.tip_load.distance_from_tip
    for name, output, place in (
        ("load_point", "load_point_displacement", (load, design.tip_load.chord)),
        ("tip", "tip_displacement", (span, design.tip_load.chord)),
        ("middle", f"displacement[{MIDDLE[0]}, {MIDDLE[1]}]", MIDDLE),
    ):
        channels[name] = ChannelPlan(
            name, "displacement", "mm", output, MILLIMETRE, DISPLACEMENT_NOISE, 0.005, 0.05, *place
        )
    everything, gauges = tuple(channels), tuple(name for name in channels if name.startswith("g"))
    levels = np.round(np.linspace(10.0 / 6.0, 10.0, 6), 3)
    forces = np.concatenate([levels, -levels])

    trials: list[TrialPlan] = []

    def add(
        name: str, kind: str, run: str, measured: tuple[str, ...], rows: np.ndarray, **more: object
    ) -> None:
        start = 0.0 if not trials else trials[-1].campaign_times[-1] + 600.0
        if more.pop("next_day", False):
            start += 12.0 * HOUR
        trials.append(TrialPlan(name, kind, run, measured, rows, start=float(start), **more))  # type: ignore[arg-type]

    for run, place in (("A", "tip"), ("B", "middle"), ("C", "corner")):
        for repeat in (1, 2):
            held = run == "A" and repeat == 2
            add(f"{place} {repeat}", "static", run, everything, forces, place=place, held_out=held)
    ring = np.arange(875) / RATE
    long = np.arange(1500) / RATE
    for amplitude, repeat, rows in (
        (15.0, 1, ring), (-15.0, 1, ring), (40.0, 1, ring), (40.0, 2, ring), (-40.0, 1, ring),
        (25.0, 1, ring), (40.0, 3, long),
    ):  # fmt: skip
        sign = "up" if amplitude > 0.0 else "down"
        add(
            f"release {abs(amplitude):.0f} mm {sign} {repeat}", "ringdown", "R", DYNAMIC, rows, place="tip",
            release=amplitude * MILLIMETRE, held_out=amplitude == 25.0,
        )  # fmt: skip
    for run, place in (("A", "tip"), ("B", "middle"), ("C", "corner")):
        add(f"{place} warm", "static", run, everything, forces, place=place, temperature=15.0)
    add("release 40 mm warm", "ringdown", "R", DYNAMIC, ring, place="tip", release=0.04, temperature=15.0)
    for repeat in (1, 2):
        add(f"flight {repeat}", "flight", "F", gauges, np.array([1.0, 2.0, 3.0]), next_day=repeat == 1)
    return CampaignPlan("Wing in the laboratory and in flight", channels, tuple(trials), 20.0, PRIORS, PLACES)
