"""Tables of measurements are those that the records in docs/results say."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"

if not DOCS.is_dir():
    pytest.skip("no documentation beside the tests", allow_module_level=True)

from docs import tables  # noqa: E402

#: Measurements: numbers with a fraction, and numbers with a unit.
MEASURED = re.compile(r"\d\.\d|\d ?(%|ms|s|x|GiB|MiB)\b|\d %")
#: Tables of other things, by page and the beginning of their first line.
OTHERS = {
    ("docs/commands.md", "| key | default"): "values of options",
    ("docs/conventions.md", "| | here and in Mitsuba"): "positions of pixels",
    ("docs/how-to/shadow-methods.md", "| If | then"): "values of options",
    ("docs/performance.md", "| section | what is timed"): "descriptions",
    ("docs/pose.md", "| option | default"): "values of options",
    ("docs/reference/results.md", "| Entry | Content"): "entries of records",
    ("docs/tutorials/index.md", "| problem | bar"): "docs/tutorials/compare.py has it from its record",
}
#: Pages whose tables name the pages that have the numbers, in a column `Source` or in the text: test_numbers.py.
SUMMARIES = {"docs/how-it-works.md", "docs/limits.md"}


def found(path: Path) -> Iterator[tuple[list[str], str, bool]]:
    """Tables of a page: lines, the text of their section above them, and whether they are generated."""
    section: list[str] = []
    lines = path.read_text(encoding="utf-8").splitlines()
    generated = fenced = False
    number = 0
    while number < len(lines):
        line = lines[number]
        fenced ^= line.startswith("```")
        generated = line.startswith("<!-- table: ") or (generated and line != "<!-- end of table -->")
        if line.startswith("#") and not fenced:
            # A section has the text of the sections around it.
            level = len(line) - len(line.lstrip("#"))
            section = [*section, line] if level > 2 else [line]
        elif line.startswith("|") and not fenced:
            end = next((k for k in range(number, len(lines)) if not lines[k].startswith("|")), len(lines))
            yield lines[number:end], " ".join(section), generated
            number = end - 1
        else:
            section.append(line)
        number += 1


def test_pages_have_what_the_records_say() -> None:
    changed = [path.relative_to(ROOT).as_posix() for path in tables.outdated(tables.pages())]
    assert not changed, "run python -m docs.tables"


def test_an_edited_number_is_noticed(tmp_path: Path) -> None:
    text = (DOCS / "lights.md").read_text(encoding="utf-8")
    edited = text.replace("| 1 | unfiltered | 0.9904 |", "| 1 | unfiltered | 0.9994 |")
    assert edited != text
    (tmp_path / "lights.md").write_text(edited, encoding="utf-8")
    assert tables.outdated([tmp_path / "lights.md"]) == {tmp_path / "lights.md": text}


def test_all_tables_are_used() -> None:
    names = [region["name"] for path in tables.pages() for region in tables.REGION.finditer(path.read_text(encoding="utf-8"))]
    assert sorted(names) == sorted(tables.TABLES)
    assert all((DOCS / name).is_file() for name in tables.FILES)


def test_measurements_without_a_record_say_so() -> None:
    unsaid, others = [], set(OTHERS)
    for path in tables.pages():
        page = path.relative_to(ROOT).as_posix()
        if page in SUMMARIES or page.removeprefix("docs/") in tables.FILES:
            continue
        for lines, above, generated in found(path):
            kind = next((key for key in OTHERS if key[0] == page and lines[0].startswith(key[1])), None)
            others -= {kind}
            if not generated and kind is None and MEASURED.search("\n".join(lines[2:])) and "No record is kept" not in above:
                unsaid.append(f"{page}: {lines[0]}")
    assert not unsaid and not others


def test_plots_are_drawn_from_the_records(tmp_path: Path) -> None:
    """The smallest of them; all are pictures of the pages, as large as they would be drawn."""
    from PIL import Image

    from docs import pictures

    pictures.PICTURES["pose-four-samples.png"](tmp_path / "plot.png")
    with Image.open(tmp_path / "plot.png") as drawn, Image.open(tables.RESULTS / "pose-four-samples.png") as kept:
        assert drawn.size == kept.size and drawn.width > 400
    texts = "\n".join(path.read_text(encoding="utf-8") for path in tables.pages())
    assert [name for name in pictures.PICTURES if f"results/{name}" not in texts or not (tables.RESULTS / name).is_file()] == []
