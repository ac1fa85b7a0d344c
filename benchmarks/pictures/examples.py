"""Pictures of example campaigns, which the package simulates itself."""

import subprocess
import sys

import uav_twin
from benchmarks.pictures.notebooks import folder_until_exit
from benchmarks.pictures.picture import Drawing
from discrepancy.report.force_figure import missing_force_figure
from reporting.pages.figures import publication_style, to_png

CHAIN = "three_mass_chain"
HIDDEN_FRICTION = "coulomb_friction@joint=0.004"
"""The effect that the example of docs/how_to/discrepancy.md and docs/explanation/locating.md
hides."""


def draw_force_at_joint() -> Drawing:
    """Draw the force that the three-mass chain lacks at its joint, with the law that is named."""
    folder = folder_until_exit() / "demo"
    example = ["discrepancy", "example", "laboratory", str(folder)]
    options = ["--model", CHAIN, "--effect", HIDDEN_FRICTION]
    subprocess.run(
        [sys.executable, "-m", "uav_twin", *example, *options], check=True, capture_output=True
    )
    missing = uav_twin.investigate(folder, CHAIN).missing
    if missing is None:
        raise ValueError(
            f"No force is missing in the example with {HIDDEN_FRICTION}: nothing is drawn."
        )
    with publication_style():
        figure = missing_force_figure(missing)
        figure.suptitle("Force that the three-mass chain lacks at its joint", x=0.02, ha="left")
        png = to_png(figure, 110.0)
    return Drawing(
        png,
        {"rms": float(missing.at_port.rms), "largest": abs(float(missing.at_port.largest.force))},
    )
