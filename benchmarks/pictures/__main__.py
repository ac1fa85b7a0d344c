"""Draw the pictures of README and docs: `python -m benchmarks.pictures [NAME ...] [--data FOLDER]`.

Without a name all are drawn. A picture whose published record is not in FOLDER is passed over, and
one of the live view where Chromium is missing. What pages say otherwise than the pictures is
printed, and the exit code is then 1. `--check` draws nothing, and compares the pictures that are
there with the pages.
"""

import argparse
from pathlib import Path

from benchmarks.browser import CHROMIUM
from benchmarks.pictures import whole
from benchmarks.pictures.catalogue import PICTURES
from benchmarks.pictures.picture import IMAGES, ROOT, Picture, numbers_of
from reporting.files import atomic_write_bytes, atomic_write_text

PUBLISHED_DATA = ROOT.parent / "shared" / "reference"
"""Where published records are looked for by default."""


def reason_to_pass_over(picture: Picture, data: Path) -> str:
    """Return why a picture cannot be drawn here; empty if it can."""
    if picture.record and not (data / picture.record).exists():
        return f"its record is not at {data / picture.record}"
    if picture.browser and CHROMIUM is None:
        return "it needs Chromium"
    return ""


def main() -> int:
    """Draw or check pictures; return 1 if a page says otherwise."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    names = [whole.NAME, *PICTURES]
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(names))
    parser.add_argument(
        "--data", type=Path, default=PUBLISHED_DATA, help="folder of published records"
    )
    parser.add_argument("--out", type=Path, default=IMAGES, help="folder of the pictures")
    parser.add_argument(
        "--check", action="store_true", help="compare pages with the pictures that are there"
    )
    arguments = parser.parse_args()
    unknown = [name for name in arguments.names if name not in names]
    if unknown:
        parser.error(f"There is no picture {unknown[0]!r}: give some of {', '.join(names)}.")
    disagreements = []
    for name in arguments.names or names:
        if name == whole.NAME:
            if not arguments.check:
                atomic_write_text(arguments.out / f"{whole.NAME}.svg", whole.draw())
            continue
        picture = PICTURES[name]
        path = arguments.out / f"{name}.png"
        if arguments.check:
            disagreements += picture.disagreements(numbers_of(path.read_bytes()))
            continue
        reason = reason_to_pass_over(picture, arguments.data)
        if reason:
            print(f"{name} is passed over: {reason}.", flush=True)
            continue
        drawing = picture.drawn(arguments.data)
        atomic_write_bytes(path, drawing.png)
        print(f"{name:28s}{len(drawing.png) / 1000:6.0f} kB  {dict(drawing.numbers)}", flush=True)
        disagreements += picture.disagreements(drawing.numbers)
    for sentence in disagreements:
        print(sentence)
    return 1 if disagreements else 0


if __name__ == "__main__":
    raise SystemExit(main())
