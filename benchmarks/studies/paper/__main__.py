"""The calibration of the paper, step after step: its Table 1, its Fig. 5, and its masses.

Shown in docs/explanation/paper.md and docs/explanation/calibration.md.

`python -m benchmarks.studies.paper --out DIR` calibrates the published wing by the paper's
procedure beside the joint posterior of `uav-twin calibrate`, and prints Table 1. `--data` takes
the measurements of a laboratory's folder instead.
"""

import argparse
from pathlib import Path

from benchmarks.studies.paper.calibration import PaperCalibration, calibrate_as_in_the_paper
from benchmarks.studies.paper.figure_5 import figure_5
from benchmarks.studies.paper.masses import authors_samples
from benchmarks.studies.paper.table_1 import WORDS, printed_table_1, table_1, write_table_1
from calibration.dynamics.records import STEP_FOLDER
from calibration.lab_folder import find_in_lab_folder
from calibration.result.figures import corner_figure, unmeasured_parameters
from calibration.wing.calibrate import WingCalibration, calibrate
from evidence.identification.published_results import RESULTS_FILE, read_published_results
from reporting import terminal
from reporting.pages.figures import save_figure
from reporting.pages.page import ReportFigure


def masses_figure(
    wing: WingCalibration, paper: PaperCalibration, data: Path | None
) -> ReportFigure:
    """Return the samples of both procedures, and the authors' own if the folder `data` has them."""
    columns, names = unmeasured_parameters(wing.result)
    sample_sets = [
        ("joint posterior", wing.result.samples[:, columns]),
        ("the paper's procedure", paper.masses.samples),
    ]
    remark = ""
    if data is not None and find_in_lab_folder(data, STEP_FOLDER / RESULTS_FILE) is not None:
        authors = authors_samples(read_published_results(data))
        sample_sets.append(("authors' model", authors.samples))
        remark = "; grey are the authors’ published samples"
    return WORDS.figure("procedure", corner_figure(names, sample_sets), authors=remark)


def main() -> None:
    """Calibrate a wing by both procedures, print Table 1, and write it with the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, help="laboratory folder; the published figures else")
    parser.add_argument("--out", type=Path, help="folder of table_1.csv and the figures")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    wing = calibrate(arguments.data, seed=arguments.seed)
    paper = calibrate_as_in_the_paper(wing, arguments.seed)
    rows = table_1(wing.result, paper.moments)
    terminal.show([printed_table_1(rows)])
    if arguments.out is not None:
        write_table_1(rows, arguments.out / "table_1.csv")
        save_figure(WORDS.figure("figure_5", figure_5(paper.static, paper.particle)), arguments.out)
        save_figure(masses_figure(wing, paper, arguments.data), arguments.out)


if __name__ == "__main__":
    main()
