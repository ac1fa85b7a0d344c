"""Write the pages of docs/reference/effects from the catalogue, paragraphs and pictures.

``python -m benchmarks.effect_pages`` writes them all; ``--no-pictures`` leaves the pictures as they
are.
"""

import argparse
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.effect_pictures import (
    EFFECTS_OF_PARTS,
    FLOWS,
    draw,
    picture_of,
    picture_patch,
    picture_setting,
)
from discrepancy.catalogue.entry import Effect, Prior, Setting
from discrepancy.catalogue.library import library
from discrepancy.catalogue.needs import KIND_NAMES
from reporting.files import atomic_write_bytes, atomic_write_text

FOLDER = Path(__file__).parents[1] / "docs" / "reference" / "effects"

LETTERS = {"static": "S", "ring-down": "R", "forced": "O", "driven": "D", "flight": "F"}


def paragraphs() -> dict[str, Any]:
    """Return the hand-written paragraphs by effect, and the "overview" with its @placeholders@."""
    return tomllib.loads((FOLDER / "paragraphs.toml").read_text(encoding="utf-8"))


def range_of(prior: Prior) -> str:
    """Return a prior in a few words."""
    name = prior.shape.replace("_", "-")
    return f"{name}, {prior.low:.3g} to {prior.high:.3g}"


def page(effect: Effect, text: Mapping[str, Any], setting: Setting) -> str:
    """Return the page of an effect."""
    tank = effect.identifier in FLOWS
    structure = "tank" if tank else "cantilever"
    _, place = picture_patch(effect, setting)
    values = picture_of(effect).values
    rows = []
    for p in effect.parameters:
        unit = "" if p.unit == "1" else f", {p.unit}"
        rows.append(f"- {p.symbol} (`{p.name}`{unit}): {p.description}; {range_of(p.prior)}.")
    free = [
        f"- {s.symbol} (`{s.name}`): {s.description}; {s.canonical:g}, "
        f"and in the family {range_of(s.prior)}."
        for s in effect.shape
    ]
    parameters = ", ".join(f"{name} {value:g}" for name, value in values.items())
    lines = [
        f"# {effect.name[0].upper()}{effect.name[1:]}",
        "",
        f"`{effect.identifier}`, family: {effect.family}.",
        "",
        text["what"].strip(),
        "",
        "```",
        effect.equation,
        "```",
        "",
        *rows,
        *free,
        "",
        *([text["unit"], ""] if text["unit"] else []),
        f"![{effect.identifier}](images/{effect.identifier}.png)",
        "",
        f"The picture shows the effect on a {structure}: {parameters}"
        + (f", place `{place}`." if place else "."),
        "",
        "## Confused with",
        "",
        "These effects look similar. Each line says which measurement separates the two:",
        "",
        *(
            f"- [`{confused}`]({confused}.md): {text['tell'][confused]}"
            for confused in effect.confusable
        ),
        "",
        f"Sources: {'; '.join(source.rstrip('.') for source in text['references'])}.",
        "",
    ]
    return "\n".join(lines)


def readme() -> str:
    """Return the list of all effects."""
    rows = []
    for effect in library():
        letters = "".join(
            LETTERS[name] for kind, name in KIND_NAMES.items() if kind in effect.acts_on
        )
        rows.append(f"- [{effect.name}]({effect.identifier}.md), {letters}: {effect.signature}")
    families = len({effect.family for effect in library()})
    numbers = {"count": len(library()), "families": families, "rows": "\n".join(rows)}
    text: str = paragraphs()["overview"]
    for name, value in numbers.items():
        text = text.replace(f"@{name}@", str(value))
    return text


def pages() -> dict[str, str]:
    """Return every page by its file name."""
    texts, beam = paragraphs(), picture_setting()
    texts_by_page = {
        f"{effect.identifier}.md": page(
            effect,
            texts[effect.identifier],
            picture_setting(effect) if effect.identifier in (*FLOWS, *EFFECTS_OF_PARTS) else beam,
        )
        for effect in library()
    }
    return {"README.md": readme(), **texts_by_page}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", help="the picture of this effect alone")
    parser.add_argument("--no-pictures", action="store_true", help="leave the pictures as they are")
    arguments = parser.parse_args()
    for name, text in pages().items():
        atomic_write_text(FOLDER / name, text)
    if not arguments.no_pictures:
        for effect in library():
            if arguments.only not in (None, effect.identifier):
                continue
            data = draw(effect, picture_setting(effect))
            atomic_write_bytes(FOLDER / "images" / f"{effect.identifier}.png", data)
            print(f"{effect.identifier:32s}{len(data) / 1024:6.1f} kB")


if __name__ == "__main__":
    main()
