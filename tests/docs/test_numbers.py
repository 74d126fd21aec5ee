"""Numbers in the text of summaries are those of the records; tables of limits and approximations name their sources."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"

if not DOCS.is_dir():
    pytest.skip("no documentation beside the tests", allow_module_level=True)

from docs.tables import record  # noqa: E402
from shadowmap_dr.experiments.art.gallery import WHOLE  # noqa: E402
from shadowmap_dr.experiments.faces.report import summary as faces_summary  # noqa: E402
from shadowmap_dr.experiments.gradients.report import jacobian_rows  # noqa: E402
from tests.agreement import report as agreement  # noqa: E402


def bleeding() -> str:
    tiers = record("maps")["scenes"]["tiers"]
    assert tiers["evsm4"]["bleeding"] < 1e-4
    return f"{tiers['vsm']['bleeding']:.4f}"


def without_range() -> str:
    return f"{record('maps')['scenes']['deep']['plain vsm']['bleeding']:.2f}"


def rough_scenes() -> str:
    errors = [entry["errors"][-1]["error"] for entry in record("soft")["scenes"].values() if not entry["glossy"]]
    return f"{sum(error <= 0.02 for error in errors)} of {len(errors)}"


def derivatives() -> list[str]:
    """Cells of 256 texels with the default filter: own, traced, blurred."""
    found = record("gradients")["jacobian"]
    entries = {key: entry for key, entry in found["entries"].items() if entry["candidate"] == "default"}
    return next(row for row in jacobian_rows({**found, "entries": entries})[1] if row[0] == "256, 3")


def recovered() -> str:
    runs = list(record("gradients")["convergence"]["runs"].values())
    return f"{sum(run['recovered'] for run in runs)} of {len(runs)}"


def light(lights: int, size: int = 3, strategy: str = "plain", reference: str = "own") -> dict[str, Any]:
    wanted = (lights, size, strategy, reference, "gaussian")
    keys = ("lights", "filter_size", "strategy", "reference", "filter")
    return next(entry for entry in record("lights")["summaries"] if tuple(entry[key] for key in keys) == wanted)


def alignment(*setting: Any) -> str:
    return f"{light(*setting)['alignment_mean']:.4f}"


def lost(*setting: Any) -> str:
    entry = light(*setting)
    count = entry["runs"] * len(entry["objects"])
    return str(count - round(entry["share_from_0.995"] * count))


def faces(lights: int, key: str, digits: int) -> str:
    return f"{faces_summary(record('faces'), 'identity')[lights][key]:.{digits}f}"


def brightness(key: str) -> str:
    lamps = [entry[key] for entries in record("lamp_brightness")["lamps"].values() for entry in entries.values()]
    return f"{100 * max(map(abs, lamps)):.1f} %"


def one_view() -> str:
    return f"{np.mean([record('art')['pieces'][name]['views'][0]['iou'] for name in WHOLE]):.3f}"


def embree() -> str:
    units = record("bench")["sections"]["raster"]["units"]
    ratios = (units[f"spot-6k@{size}"]["ratio_of_medians"]["embree update and trace / ours"] for size in (128, 512, 1024, 2048))
    return ", ".join(f"{ratio:.0f}x" if ratio >= 10 else f"{ratio:.1f}x" for ratio in ratios)


#: Page -> what its text says, with what makes each number in braces.
FACTS: dict[str, dict[str, tuple[Callable[[], str], ...]]] = {
    "docs/how-it-works.md": {
        "`vsm` {}, `evsm4` below 0.0001": (bleeding,),
        "{} scenes of rough materials within 2 %": (rough_scenes,),
        "cosine {}, scale {:.2f}": (lambda: derivatives()[3], lambda: derivatives()[4]),
        "cosine {}, scale {} ": (lambda: derivatives()[5], lambda: derivatives()[6]),
    },
    "docs/limits.md": {
        "`evsm4` below 0.0001; `vsm` {}, without `shadow_receiver_range` up to {}": (bleeding, without_range),
        "{} scenes within 2 %": (rough_scenes,),
        "bias at most {}, error at most {}": (lambda: brightness("bias"), lambda: brightness("error")),
        "{} runs lead home": (recovered,),
        "{} of 900 runs; {} with `--strategy coarse`": (lambda: lost(1), lambda: lost(1, 3, "coarse")),
        "66 comparisons | {} within": (lambda: agreement.summary(record("agreement")["cases"]).split()[0],),
        "mean distance {} with one shadow": (lambda: faces(1, "mean", 3),),
    },
    "docs/results.md": {
        "for Spot {} at 128, 512, 1024, 2048": (embree,),
        "{} / {} with one shadow, {} / {} with three": (
            *(lambda: faces(1, "mean", 4), lambda: faces(1, "hausdorff", 3)),
            *(lambda: faces(3, "mean", 4), lambda: faces(3, "hausdorff", 3)),
        ),
        "{} scenes of rough materials are within 2 %": (rough_scenes,),
        "{} on average, at least 0.994, for one shadow": (one_view,),
        "light {}, {} with a filter of 15 texels instead of 3, {} with `--strategy coarse`, {} with path-traced targets": (
            *(lambda: alignment(1), lambda: alignment(1, 15)),
            *(lambda: alignment(1, 3, "coarse"), lambda: alignment(1, 3, "plain", "mitsuba")),
        ),
        "with three, four and five lights {}, {} and {}, without shadows {}, {} and {}": (
            *(lambda n=n: alignment(n) for n in (3, 4, 5)),
            *(lambda n=n: alignment(n, 0) for n in (3, 4, 5)),
        ),
        "mesh takes {} steps a second": (lambda: f"{record('model')['steps_per_second']:.0f}",),
        "to move {} ms after the mouse": (lambda: f"{1e3 * np.median(record('model')['delay_seconds']['first']):.0f}",),
    },
    "docs/gradients.md": {"{} runs lead home": (recovered,)},
    "docs/mitsuba-agreement.md": {"{} ": (lambda: agreement.summary(record("agreement")["cases"]),)},
}


@pytest.mark.parametrize("page", FACTS)
def test_text_has_the_numbers_of_the_records(page: str) -> None:
    text = " ".join((ROOT / page).read_text(encoding="utf-8").split())
    sentences = []
    for sentence, makers in FACTS[page].items():
        values: list[Any] = [make() for make in makers]
        if ":.2f}" in sentence:
            values = [float(value) if "." in value else value for value in values]
            sentence = sentence.replace("cosine {}", "cosine {:.3f}")
        sentences.append(sentence.format(*values))
    assert [sentence for sentence in sentences if sentence not in text + " "] == []


def sourced_rows() -> Iterator[tuple[str, list[str]]]:
    """Rows of tables with a column of sources: page and cells."""
    for page in ("docs/how-it-works.md", "docs/limits.md"):
        lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
        for line, above in zip(lines, ["", *lines], strict=False):
            if line.startswith("|") and not line.startswith("|---") and above.startswith("|"):
                yield page, [cell.strip() for cell in line.strip("|").split(" |")]


def test_limits_and_approximations_have_sources() -> None:
    rows = list(sourced_rows())
    assert len(rows) > 45 and all(len(cells) == 3 and all(cells) for _, cells in rows), rows
    wrong = []
    for page, (limit, _, source) in rows:
        links = re.findall(r"\]\(([^)#]+)(?:#([^)]+))?\)", source)
        tests = re.findall(r"`(tests/[\w/]+\.py)`", source)
        if not (links or tests or re.search(r"`python docs/examples/\w+\.py`", source)):
            wrong.append(f"{page}: {limit}: {source}")
        wrong += [f"{page}: {limit}: {test}" for test in tests if not (ROOT / test).is_file()]
        for target, anchor in links:
            text = (DOCS / target).read_text(encoding="utf-8")
            headings = {
                re.sub(r"[^\w\- ]", "", heading).lower().replace(" ", "-")
                for heading in re.findall(r"^#+ (.+)$", text, re.MULTILINE)
            }
            if anchor and anchor not in headings:
                wrong.append(f"{page}: {limit}: {target}#{anchor}")
    assert not wrong
