"""Every picture of docs/images by its name, with what README and docs say of it."""

from benchmarks.pictures import examples, front, measured, missions, tutorials
from benchmarks.pictures.picture import Picture, Statement

NOTEBOOK_FLEET = "fleet"
NOTEBOOK_EFFECT = "effect"
REAL_WING = "real wing"
WING_RECORDS = "uav_experimental_calibration"

PICTURES = {
    picture.name: picture
    for picture in (
        Picture(
            "front_mission",
            front.draw_mission,
            (
                Statement("README.md", "falls back to a gentle turn at step {change}"),
                Statement(
                    "README.md", "the damage that calls for it is there from step {damage} on"
                ),
            ),
        ),
        Picture("front_structure", front.draw_structure),
        Picture(
            "front_effect",
            front.draw_effect,
            (
                Statement("README.md", "found as Coulomb friction, {friction} N;"),
                Statement(
                    "README.md",
                    "χ² per sample of the held-out release falls from {before} to {after}.",
                ),
            ),
            minutes=True,
            source=NOTEBOOK_EFFECT,
        ),
        Picture(
            "missing_force",
            front.draw_missing_force,
            (Statement("docs/how_to/discrepancy.md", "a step of {step} N over the speed"),),
            minutes=True,
            source=NOTEBOOK_EFFECT,
        ),
        Picture(
            "force_at_joint",
            examples.draw_force_at_joint,
            (
                Statement(
                    "docs/explanation/locating.md", "a force of {rms} N (rms), at most {largest} N"
                ),
            ),
            minutes=True,
        ),
        Picture(
            "front_watch",
            front.draw_watch,
            (Statement("README.md", "at step 10: alarm at step {alarm},"),),
        ),
        Picture(
            "front_fleet",
            front.draw_fleet,
            (
                Statement("README.md", "damage worsens in {assumed} % of sharp turns"),
                Statement(
                    "README.md", "they learn {mean} % (95 %: {low} to {high}), where 5 % is true"
                ),
            ),
            minutes=True,
            source=NOTEBOOK_FLEET,
        ),
        Picture(
            "exchanger",
            tutorials.draw_exchanger,
            (Statement("docs/tutorials/your_own_fmu.md", "reduces the flow on day {change},"),),
        ),
        Picture(
            "calibrated_wing",
            tutorials.draw_calibrated_wing,
            (
                Statement(
                    "docs/tutorials/calibrate_a_wing.md",
                    "from 1.000 ± 0.025 to {mean} ± {deviation}.",
                ),
            ),
            minutes=True,
        ),
        Picture(
            "fleet",
            missions.draw_fleet,
            (Statement("docs/how_to/fleets.md", "![A fleet of {assets}:"),),
            minutes=True,
            source=NOTEBOOK_FLEET,
        ),
        Picture(
            "three_regions",
            missions.draw_three_regions,
            (Statement("docs/how_to/scenarios.md", "![Beliefs in three regions at step {step}]"),),
            minutes=True,
        ),
        Picture(
            "learnt",
            missions.draw_learnt,
            (
                Statement(
                    "docs/explanation/learning.md",
                    "![What was learnt in {steps} steps of the shipped scenario]",
                ),
            ),
        ),
        Picture("structure_bracket", missions.draw_bracket),
        Picture("structure_stiffened_panel", missions.draw_stiffened_panel),
        Picture(
            "plan",
            missions.draw_plan,
            (
                Statement(
                    "docs/how_to/planning.md",
                    "planned on the belief (bounds {lower} and {upper}, after 10 s) | {expected} |",
                ),
            ),
            minutes=True,
        ),
        Picture(
            "design",
            missions.draw_design,
            (
                Statement(
                    "docs/how_to/planning.md",
                    "Eight of the 24 gauges tell {chosen} of {of_all} bit.",
                ),
            ),
        ),
        Picture(
            "view",
            missions.draw_view,
            (
                Statement(
                    "docs/how_to/view.md", "![The page at step {step} of the paper's mission]"
                ),
            ),
            browser=True,
        ),
        Picture(
            "plate_against_box",
            measured.draw_plate_against_box,
            (
                Statement(
                    "docs/explanation/verification.md",
                    "all 24 gauges, rms | | {rms} ({largest}: {gauge}) |",
                ),
            ),
            minutes=True,
        ),
        Picture(
            "real_wing_residuals",
            measured.draw_real_wing_residuals,
            (
                Statement(
                    "docs/explanation/real_wing.md",
                    "leaves {without} µV (rms) without and {with_effects} µV with",
                ),
            ),
            record=WING_RECORDS,
            minutes=True,
            source=REAL_WING,
        ),
        Picture(
            "real_wing_force",
            measured.draw_real_wing_force,
            (Statement("docs/explanation/real_wing.md", "a moment of at most {largest} N m"),),
            record=WING_RECORDS,
            minutes=True,
            source=REAL_WING,
        ),
        Picture(
            "falling_phone",
            measured.draw_falling_phone,
            (
                Statement(
                    "docs/explanation/measured_rigs.md", "![The missing force of {falls} falls over"
                ),
            ),
            record="measured/falling_phone",
            minutes=True,
        ),
        Picture(
            "cooling_water",
            measured.draw_cooling_water,
            (
                Statement(
                    "docs/explanation/measured_rigs.md",
                    "to {flow} °C/s at an excess of {excess} °C",
                ),
            ),
            record="CoolingWater.csv",
            minutes=True,
        ),
    )
}
