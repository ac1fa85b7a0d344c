"""The picture of each effect: what it does to the trials of the cantilever that show it best."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from benchmarks.cantilever import Cantilever, CantileverWithRegions, campaign
from benchmarks.tank import tank_setting
from discrepancy.campaign.records import Quantity, Trial
from discrepancy.catalogue.entry import Effect, Setting
from discrepancy.system.response import Conditions
from discrepancy.system.sensing import observe
from fe.runtime.patch import ModelPatch
from reporting.pages.figures import PREDICTION, REFERENCE, new_figure, publication_style, to_png

FloatArray = NDArray[np.float64]
RESOLUTION = 88.0
FLOWS = ("outflow", "overflow")
"""Effects that act on a store, not on a structure."""
EFFECTS_OF_PARTS = ("region_stiffness_loss", "interface_compliance")
"""Effects on a structure with damage regions and a joint."""

# Factor and unit of each quantity in a picture.
UNITS = {
    Quantity.DISPLACEMENT: (1e3, "mm"),
    Quantity.STRAIN: (1e6, "microstrain"),
    Quantity.LEVEL: (1.0, "m"),
}


@dataclass(frozen=True)
class View:
    """The cantilever with and without an effect."""

    setting: Setting
    patch: ModelPatch

    def trial(self, name: str) -> Trial:
        """Return a trial by its name."""
        return next(trial for trial in self.setting.campaign.trials if trial.name == name)

    def read(self, trial: Trial, channel: str, patch: ModelPatch | None = None) -> FloatArray:
        """Return what a channel shows with the effect [unit of the picture]."""
        column = trial.channels.index(channel)
        factor, _ = self.unit(channel)
        response = observe(
            self.setting.model,
            self.setting.campaign,
            trial,
            self.patch if patch is None else patch,
            Conditions(np.ones(1)),
        )
        return factor * response.values[:, column]

    def unit(self, channel: str) -> tuple[float, str]:
        """Return factor and unit of a channel in a picture."""
        return UNITS[self.setting.campaign.channels[channel].quantity]

    def both(self, trial: Trial, channel: str) -> tuple[tuple[FloatArray, str, str], ...]:
        """Return the readings without and with the effect, with colour and label."""
        return (
            (self.read(trial, channel, ModelPatch()), REFERENCE, "model"),
            (self.read(trial, channel), PREDICTION, "with the effect"),
        )


Panel = Callable[[View, Axes], None]


def ringdown(
    channel: str = "tip", begin: float = 0.0, end: float = 2.0, trial: str = "release"
) -> Panel:
    """Return the panel of a record over time."""

    def draw(view: View, axes: Axes) -> None:
        record = view.trial(trial)
        shown = (record.time >= begin) & (record.time <= end)
        for values, colour, label in view.both(record, channel):
            axes.plot(record.time[shown], values[shown], color=colour, lw=1.0, label=label)
        axes.set(xlabel="time [s]", ylabel=f"{channel} [{view.unit(channel)[1]}]")

    return draw


def cycles(
    time: FloatArray, values: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return middle time, amplitude, frequency and damping ratio of each cycle of a ring-down."""
    crossings = np.flatnonzero((values[:-1] < 0.0) & (values[1:] >= 0.0))
    crossing = time[crossings] - values[crossings] * (time[crossings + 1] - time[crossings]) / (
        values[crossings + 1] - values[crossings]
    )
    half = [0.5 * np.ptp(values[(time >= a) & (time <= b)]) for a, b in pairwise(crossing)]
    amplitude = np.array(half)
    frequency = 1.0 / np.diff(crossing)
    cycles_aside = 2  # cycles on either side, for the damping ratio
    ratio = np.full(len(amplitude), np.nan)
    ratio[cycles_aside:-cycles_aside] = np.log(
        amplitude[: -2 * cycles_aside] / amplitude[2 * cycles_aside :]
    ) / (4.0 * cycles_aside * np.pi)
    return 0.5 * (crossing[1:] + crossing[:-1]), amplitude, frequency, ratio


def backbone(of: str, over: str = "amplitude", trials: tuple[str, ...] = ("release",)) -> Panel:
    """Return the panel of frequency or damping of each cycle over its amplitude or time."""

    def draw(view: View, axes: Axes) -> None:
        for number, name in enumerate(trials):
            record = view.trial(name)
            kept = record.time > 0.5  # the second mode has died away
            for values, colour, label in view.both(record, "tip"):
                time, amplitude, frequency, ratio = cycles(record.time[kept], values[kept])
                large = amplitude > 0.02 * amplitude[0]
                across = amplitude if over == "amplitude" else time
                shown = frequency if of == "frequency" else 100.0 * ratio
                axes.plot(
                    across[large],
                    shown[large],
                    ".-" if number == 0 else "x",
                    color=colour,
                    ms=3,
                    lw=0.8,
                    label=label if number == 0 else None,
                )
        axes.set_xlabel("amplitude [mm]" if over == "amplitude" else "time [s]")
        axes.set_ylabel("frequency [Hz]" if of == "frequency" else "damping [%]")
        low, high = axes.get_ylim()
        least = 0.1 if of == "frequency" else 0.4
        if high - low < least:
            axes.set_ylim(0.5 * (low + high - least), 0.5 * (low + high + least))

    return draw


def load_line(
    channel: str = "tip", trials: tuple[str, ...] = ("up", "down"), *, change: bool = False
) -> Panel:
    """Return the panel of a reading, or of its change by the effect, over the force."""

    def draw(view: View, axes: Axes) -> None:
        for number, name in enumerate(trials):
            record = view.trial(name)
            (plain, grey, before), (moved, colour, after) = view.both(record, channel)
            if change:
                axes.plot(record.force, moved - plain, "o-", color=colour, ms=3, lw=0.9)
            else:
                axes.plot(
                    record.force, plain, "-", color=grey, lw=2.0, label=None if number else before
                )
                axes.plot(
                    record.force,
                    moved,
                    "o-",
                    color=colour,
                    ms=3,
                    lw=0.9,
                    label=None if number else after,
                )
        if change:
            axes.axhline(0.0, color=REFERENCE, lw=0.8)
        sign = "change of " if change else ""
        axes.set(xlabel="force [N]", ylabel=f"{sign}{channel} [{view.unit(channel)[1]}]")

    return draw


def ratios(*trials: str) -> Panel:
    """Return a panel of each channel's readings over those without the effect, summed by trial."""

    def draw(view: View, axes: Axes) -> None:
        for number, name in enumerate(trials):
            record = view.trial(name)
            names = record.channels
            values = [
                np.sum(view.read(record, c)) / np.sum(view.read(record, c, ModelPatch()))
                for c in names
            ]
            label = f"trial {name!r}" if len(trials) > 1 else "with the effect"
            fill = PREDICTION if number == 0 else "none"
            axes.plot(
                range(len(names)),
                values,
                "os"[number],
                color=PREDICTION,
                ms=5,
                mfc=fill,
                label=label,
            )
        axes.axhline(1.0, color=REFERENCE, lw=0.8, label="model")
        axes.set_xticks(range(len(names)), names)
        axes.set(ylabel="reading over model's", xlim=(-0.5, len(names) - 0.5))
        low, high = axes.get_ylim()
        if high - low < 0.02:
            axes.set_ylim(low - 0.01, high + 0.01)

    return draw


def flight(channels: tuple[str, ...], *, share: bool = False) -> Panel:
    """Return a panel of the change in flight, or of a ratio of two channels, over load factor."""

    def draw(view: View, axes: Axes) -> None:
        record = view.trial("flight")
        if share:
            pairs = [view.both(record, channel) for channel in channels]
            for (top, colour, label), (bottom, _, _) in zip(*pairs, strict=True):
                axes.plot(record.load_factor, top / bottom, "o-", color=colour, ms=3, label=label)
            axes.set_ylabel(f"{channels[0]} over {channels[1]}")
        else:
            for channel, marker in zip(channels, "os^", strict=False):
                (plain, _, _), (moved, colour, _) = view.both(record, channel)
                axes.plot(
                    record.load_factor,
                    moved - plain,
                    marker + "-",
                    color=colour,
                    ms=3,
                    label=channel,
                )
            axes.axhline(0.0, color=REFERENCE, lw=0.8)
            axes.set_ylabel(f"change [{view.unit(channels[0])[1]}]")
        axes.set_xlabel("load factor")

    return draw


def spectrum(channel: str, limit: float, trial: str = "release") -> Panel:
    """Return the panel of the amplitude spectrum of a record."""

    def draw(view: View, axes: Axes) -> None:
        record = view.trial(trial)
        window = np.hanning(len(record.time))
        frequency = np.fft.rfftfreq(len(record.time), record.interval)
        for values, colour, label in view.both(record, channel):
            height = np.abs(np.fft.rfft(values * window)) * 2.0 / window.sum()
            shown = frequency <= limit
            axes.semilogy(frequency[shown], height[shown], color=colour, lw=1.0, label=label)
        axes.set(xlabel="frequency [Hz]", ylabel=f"{channel} [{view.unit(channel)[1]}]")

    return draw


def change_over(what: str, channels: tuple[str, ...]) -> Panel:
    """Return the panel of the change of static readings over temperature or time."""

    def draw(view: View, axes: Axes) -> None:
        for channel, marker in zip(channels, "os^", strict=False):
            across, change = [], []
            for name in ("up", "down", "warm"):
                record = view.trial(name)
                across.append(record.temperature if what == "temperature" else record.time / 60.0)
                change.append(view.read(record, channel) - view.read(record, channel, ModelPatch()))
            axes.plot(
                np.concatenate(across),
                np.concatenate(change),
                marker,
                color=PREDICTION,
                ms=4,
                mfc="none",
                label=channel,
            )
        axes.axhline(0.0, color=REFERENCE, lw=0.8)
        axes.set_xlabel("temperature less reference [K]" if what == "temperature" else "time [min]")
        axes.set_ylabel(f"change [{view.unit(channels[0])[1]}]")

    return draw


@dataclass(frozen=True)
class Picture:
    """Content of a picture: parameters of the effect, its place, and two panels."""

    values: Mapping[str, float]
    panels: tuple[Panel, Panel]
    place: str | None = None


FREQUENCY, DAMPING = backbone("frequency"), backbone("damping")

FILLED = ringdown("level", 0.0, 300.0, "filled and drained")

PICTURES: dict[str, Picture] = {
    "point_mass": Picture(
        {"mass_ratio": 0.1, "station_ratio": 1.0}, (ringdown(end=1.2), load_line())
    ),
    "load_offset": Picture({"offset_ratio": 0.05}, (load_line("tip"), load_line("g0"))),
    "load_direction": Picture({"angle": 0.1}, (load_line("tip"), load_line("g0"))),
    "added_mass": Picture({"mass_ratio": 0.1}, (ringdown(end=1.2), load_line())),
    "support_compliance": Picture({"compliance_share": 0.15}, (load_line("tip"), load_line("g0"))),
    "interface_compliance": Picture(
        {"compliance_share": 0.15}, (load_line("tip"), load_line("g0"))
    ),
    "local_stiffness_loss": Picture(
        {"loss": 0.3, "start_ratio": 0.4, "length_ratio": 0.15}, (ratios("up"), load_line("g1"))
    ),
    "region_stiffness_loss": Picture({"loss": 0.3}, (ratios("up"), load_line("g0")), "inner"),
    "temperature_dependent_modulus": Picture(
        {"coefficient": 4e-3}, (load_line("tip", ("warm",)), ratios("up", "warm"))
    ),
    "coulomb_friction": Picture({"friction_ratio": 0.004}, (ringdown(end=8.0), DAMPING)),
    "structural_damping": Picture({"loss_factor": 0.03}, (ringdown(end=4.0), DAMPING)),
    "quadratic_damping": Picture({"equivalent_damping_ratio": 0.03}, (ringdown(end=4.0), DAMPING)),
    "cubic_stiffness": Picture({"stiffening": 0.3}, (FREQUENCY, load_line())),
    "breathing_crack": Picture(
        {"stiffness_loss": 0.4}, (load_line(change=True), spectrum("tip", 20.0)), "root, lower skin"
    ),
    "free_play": Picture(
        {"gap_ratio": 0.05, "stiffness_share": 0.6}, (FREQUENCY, load_line(change=True))
    ),
    "seating_offset": Picture(
        {"offset_ratio": 0.03}, (load_line(change=True), load_line("g0", change=True)), "B"
    ),
    "stiffness_drift": Picture(
        {"stiffness_change": 0.06},
        (
            backbone("frequency", "time", ("release", "half")),
            backbone("frequency", trials=("release", "half")),
        ),
    ),
    "joint_micro_slip": Picture({"stiffness_share": 0.7, "slip_ratio": 0.3}, (FREQUENCY, DAMPING)),
    "bouc_wen_hysteresis": Picture(
        {"stiffness_share": 0.6, "yield_ratio": 0.3},
        (FREQUENCY, load_line(trials=("up",), change=True)),
    ),
    "thermal_strain": Picture(
        {"coefficient": 5e-6},
        (change_over("temperature", ("g0", "tip")), load_line("g0", ("up", "warm"))),
        "g0",
    ),
    "gauge_zero_drift": Picture(
        {"drift_ratio": 0.1},
        (change_over("time", ("g0", "g1")), load_line("g0", change=True)),
        "g0",
    ),
    "gauge_gain": Picture({"gain_error": 0.1}, (ratios("up", "flight"), load_line("g1")), "g1"),
    "sensor_saturation": Picture(
        {"lost_share": 0.2}, (load_line("g0", change=True), spectrum("g0", 20.0)), "g0"
    ),
    "gauge_misalignment": Picture({"angle": 0.26}, (ratios("up", "flight"), load_line("g1")), "g1"),
    "gauge_offset": Picture({"offset_ratio": 0.05}, (ratios("up"), load_line("g0"))),
    "high_pass": Picture(
        {"corner_ratio": 0.2}, (ringdown("g0", end=1.5), spectrum("g0", 10.0)), "g0"
    ),
    "low_pass": Picture(
        {"time_constant_ratio": 0.5},
        (ringdown("g0", 0.0, 0.6, "pushed"), ringdown("g0", 2.0, 2.6, "pushed")),
    ),
    "sensor_lag": Picture(
        {"lag_intervals": 10.0},
        (ringdown("g0", 0.0, 0.6, "pushed"), ringdown("g0", 2.0, 2.6, "pushed")),
    ),
    "load_place": Picture(
        {"along_span_ratio": -0.05, "along_chord_ratio": 0.0}, (ratios("up"), load_line("g2"))
    ),
    "load_cell": Picture(
        {"gain_error": 0.05, "tare_ratio": 0.03},
        (load_line(change=True), load_line("g0", change=True)),
    ),
    "washout": Picture({"washout": 0.1}, (flight(("g2", "g0"), share=True), flight(("g0", "g2")))),
    "inertia_relief": Picture({"relief": 0.2}, (flight(("g0", "g2")), ratios("up", "flight"))),
    "outflow": Picture(
        {"flow_ratio": 0.3}, (FILLED, ringdown("level", 240.0, 300.0, "filled and drained"))
    ),
    "overflow": Picture(
        {"level_ratio": 0.7, "flow_ratio": 0.3},
        (FILLED, ringdown("level", 40.0, 100.0, "filled and drained")),
    ),
    "clock_error": Picture(
        {"rate_error": 5e-3, "phase_zero": 0.0},
        (ringdown(begin=6.0, end=8.0), backbone("frequency", "time")),
    ),
    "logger_clock": Picture(
        {"rate_error": 5e-3},
        (ringdown(begin=7.0, end=8.0), ringdown(begin=3.2, end=4.0, trial="pushed")),
    ),
    "mains_hum": Picture(
        {"cosine_ratio": 0.02, "sine_ratio": 0.0, "frequency_error": 0.0},
        (ringdown("g0", 6.0, 8.0), spectrum("g0", 70.0)),
        "50 Hz, g0",
    ),
    "unmodelled_mode": Picture(
        {"frequency_ratio": 1.05, "damping_ratio": 0.006, "cosine_ratio": 0.15, "sine_ratio": 0.0},
        (ringdown(end=4.5), backbone("frequency", "time")),
    ),
}
"""What shows an effect best, where that is not what `picture_of` takes by itself."""


def picture_of(effect: Effect) -> Picture:
    """Return the content of an effect's picture; by default a ring-down and a load line."""
    values = {parameter.name: parameter.prior.high for parameter in effect.parameters}
    return PICTURES.get(effect.identifier, Picture(values, (ringdown(), load_line())))


def picture_setting(effect: Effect | None = None) -> Setting:
    """Return the setting of a picture: a cantilever, or for flows a tank."""
    if effect is not None and effect.identifier in FLOWS:
        return tank_setting()
    has_parts = effect is not None and effect.identifier in EFFECTS_OF_PARTS
    cantilever_campaign = campaign()
    model = CantileverWithRegions() if has_parts else Cantilever()
    return Setting(cantilever_campaign, model, model.scales(cantilever_campaign))


def picture_patch(effect: Effect, setting: Setting) -> tuple[ModelPatch, str]:
    """Return the patch of an effect's picture and its place."""
    picture = picture_of(effect)
    place = effect.places(setting)[0] if picture.place is None else picture.place
    return effect.patch(setting, picture.values, place), place


def draw(effect: Effect, setting: Setting) -> bytes:
    """Return the picture of an effect as PNG."""
    patch, _ = picture_patch(effect, setting)
    view = View(setting, patch)
    with publication_style():
        figure = new_figure(2.1, 6.4)
        axes = figure.subplots(1, 2)
        for axis, panel in zip(axes, picture_of(effect).panels, strict=True):
            panel(view, axis)
        shown: list[str] = []
        for axis in axes:
            labels = axis.get_legend_handles_labels()[1]
            if labels and labels != shown:
                wave = axis.get_xlabel() == "time [s]" and axis is axes[0]
                axis.legend(
                    loc="upper right" if wave else "best",
                    fontsize=6.5,
                    frameon=wave,
                    framealpha=0.85,
                )
                shown = labels
        figure.tight_layout(pad=0.4)
        return to_png(figure, RESOLUTION)
