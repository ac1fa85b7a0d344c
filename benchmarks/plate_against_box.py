"""Draw gauge strains of box and sandwich plate: `python -m benchmarks.plate_against_box FILE.png`."""

import sys
from pathlib import Path

import numpy as np

from evidence.sandwich_plate.plate_comparison import DAMAGE, compare_with_plate
from fe.wing.design import load_design
from reporting.figures import (
    OBSERVED,
    PAST,
    PREDICTION,
    REFERENCE,
    new_figure,
    panel_label,
    publication_style,
    to_png,
)
from reporting.files import atomic_write_bytes


def main(path: Path) -> None:
    """Draw healthy strains, and their ratios under damage, over the distance from the root."""
    design = load_design()
    found = compare_with_plate(design)
    distance = np.array([place for place, _ in design.gauges.positions])
    with publication_style():
        figure = new_figure(2.6)
        left, right = figure.subplots(1, 2)
        left.plot(distance, 1e6 * found.box.strain, "o", color=OBSERVED, label="box")
        left.plot(distance, 1e6 * found.plate.strain, "x", color=PAST, label="sandwich plate")
        panel_label(left, "a", f"strain at {design.lift.load_factor:g}g")
        left.set_ylabel("microstrain")
        for number, color in enumerate((PREDICTION, PAST)):
            name = f"z{number + 1} = {100 * DAMAGE:.0f} %"
            right.plot(
                distance, found.box.damage_ratio[number], "o", color=color, mfc="none", label=f"box, {name}"
            )
            right.plot(distance, found.plate.damage_ratio[number], "x", color=color, label=f"plate, {name}")
        right.axhline(1.0, color=REFERENCE, linewidth=0.7)
        panel_label(right, "b", "strain over healthy strain")
        for axes in (left, right):
            axes.set_xlabel("distance from the root, m")
            axes.legend()
        figure.tight_layout()
        atomic_write_bytes(path, to_png(figure))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
