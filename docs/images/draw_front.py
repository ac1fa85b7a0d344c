"""The five pictures of README.md: `python docs/images/draw_front.py` flies, fits and learns what they show.

It takes the cells of the notebooks in docs/tutorials, so that picture and notebook tell the same.
"""

import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

import uav_twin

IMAGES = Path(__file__).parent
CELL = re.compile(r"^```{code-cell} python\n(.*?)^```", re.MULTILINE | re.DOTALL)
BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#999999"


def cells_of(notebook: str, until: str) -> dict[str, Any]:
    """Run the cells of a notebook in a folder of its own, to the first with a text; return their names."""
    names: dict[str, Any] = {"__name__": "__main__"}
    os.chdir(tempfile.mkdtemp())
    for cell in CELL.findall((IMAGES.parent / "tutorials" / f"{notebook}.md").read_text(encoding="utf-8")):
        first, _, rest = cell.partition("\n")
        if first.startswith("%%writefile "):
            Path(first.split()[1]).write_text(rest, encoding="utf-8")
            continue
        exec(compile(cell, notebook, "exec"), names)
        plt.close("all")
        if until in cell:
            break
    return names


def picture(name: str, x_label: str, y_label: str) -> Any:
    """Open a small axis; `saved` writes it."""
    plt.rcParams |= {"font.size": 8, "svg.hashsalt": name}
    _, axis = plt.subplots(figsize=(3.2, 1.9), layout="constrained")
    axis.set(xlabel=x_label, ylabel=y_label)
    axis.spines[["top", "right"]].set_visible(False)
    return axis


def saved(name: str) -> None:
    """Write the picture that is open."""
    plt.savefig(IMAGES / f"front_{name}.png", dpi=150, metadata={"Software": None})
    plt.close("all")


def belief(name: str, run: Any, factor: int, x_label: str, y_label: str) -> None:
    """Draw belief against truth of one factor of the state."""
    axis = picture(name, x_label, y_label)
    mean = 100 * run["filtered"]["mean"].values[:, factor]
    band = 200 * run["filtered"]["standard_deviation"].values[:, factor]
    axis.fill_between(range(len(mean)), mean - band, mean + band, color=BLUE, alpha=0.2, lw=0)
    axis.plot(mean, color=BLUE)
    axis.plot(100 * run["truth"]["state"].values[:, factor], color="k", ls="--", lw=1)
    control = run["observed"]["control_index"].values
    change = int(np.flatnonzero(np.diff(control))[0]) + 1
    axis.axvline(change, color=ORANGE, lw=1)
    axis.text(change + 0.5, 2, "control changes", color=ORANGE)
    saved(name)


def main(wanted: list[str]) -> None:
    """Draw the pictures that are named, or all."""
    drawings = {
        "mission": draw_mission,
        "structure": draw_structure,
        "effect": draw_effect,
        "watch": draw_watch,
        "fleet": draw_fleet,
    }
    for name in wanted or drawings:
        drawings[name]()


def draw_mission() -> None:
    """Draw region 1 of the paper's mission."""
    run = cells_of("fly_the_mission", "open_run")["run"]
    belief("mission", run, 0, "turn", "stiffness loss, %")


def draw_structure() -> None:
    """Draw the crack of the bracket."""
    outcome = cells_of("your_own_structure", "outcome.control")["outcome"]
    belief("structure", uav_twin.open_run(outcome.folder), 0, "shift", "crack of the heel, %")


def draw_effect() -> None:
    """Draw the residual of the held-out release."""
    found = cells_of("name_an_effect", "investigate(")["found"]
    axis = picture("effect", "time, s", "residual, mm")
    shown = (found.before, GREY, "model as it was"), (found.after, BLUE, "with friction")
    for residuals, colour, label in shown:
        (fitted,) = (fitted for fitted in residuals.trials if fitted.trial.held_out)
        axis.plot(fitted.trial.time, 1e3 * fitted.residual[:, 0], color=colour, lw=0.6, label=label)
    axis.legend(frameon=False, loc="upper left")
    saved("effect")


def draw_watch() -> None:
    """Draw what the twin learns, and its alarm."""
    decisions = cells_of("watch_and_teach", "uav_twin.watch")["decisions"]
    learnt = [decision["learnt"]["young_modulus_factor"] for decision in decisions]
    axis = picture("watch", "turn", "factor on Young's modulus")
    low, high = ([one[key] for one in learnt] for key in ("lower", "upper"))
    axis.fill_between(range(len(learnt)), low, high, color=BLUE, alpha=0.2, lw=0)
    axis.plot([one["mean"] for one in learnt], color=BLUE)
    axis.axhline(0.97, color="k", ls="--", lw=1)
    (alarm,) = (decision["turn"] for decision in decisions for _ in decision["notices"])
    axis.axvline(alarm, color=ORANGE, lw=1)
    axis.text(alarm - 0.3, max(high), "alarm: gauge 4", color=ORANGE, ha="right", va="top")
    saved("watch")


def draw_fleet() -> None:
    """Draw the probabilities that a fleet learns."""
    learnt = cells_of("a_fleet_that_learns", "learn_from_fleet")["learnt"]
    axis = picture("fleet", "", "probability to worsen")
    rates = learnt["groups"]["north"]["probability"]
    for place, (control, truth) in enumerate((("2g", 0.025), ("3g", 0.05))):
        rate = rates[control]
        axis.plot([place, place], [rate["lower_95"], rate["upper_95"]], color=BLUE, lw=4, alpha=0.4)
        axis.plot(place, rate["mean"], "o", color=BLUE, label="learnt" if place else None)
        axis.plot(place, rate["assumed"], "x", color=GREY, label="assumed" if place else None)
        axis.plot([place - 0.2, place + 0.2], [truth, truth], "k--", lw=1, label="truth" if place else None)
    axis.set(xticks=[0, 1], xticklabels=["gentle turn", "sharp turn"], ylim=(0, None))
    axis.legend(frameon=False, loc="upper left")
    saved("fleet")


if __name__ == "__main__":
    main(sys.argv[1:])
