"""The report of a fit: one HTML file with all pictures, which needs no network and no JavaScript."""

from __future__ import annotations

import base64
import hashlib
import io
import os
import shlex
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from ..io.animations import Pixels
from ..io.files import atomic
from . import display, report_numbers
from .curves import best_start, curves_svg
from .film import encode_film, still
from .result import FitResult, Image, Picture, Step, relative_error
from .toml import to_toml

_PAGE = Path(__file__).parent / "page"
# Longer side of embedded pictures in pixels; up to this side they are stored without loss, and enlarged as squares.
_SIDE, _COARSE = 1024, 320
# Letters of commands in one line.
_LINE = 80
# Nothing is loaded from anywhere and no other script runs, even if a name should slip into the markup.
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"


def write_report(result: FitResult, path: str | os.PathLike[str], *, film: bytes | None = None) -> None:
    """Write the report (.html). Raises OutputError if it cannot be written.

    All texts of the result are escaped. Pictures are embedded with at most 1024 pixels along the longer side. ``film``: content
    of the film's file (.webp), if it is there already.
    """
    page = report_html(result, film)
    with atomic(path) as temporary:
        temporary.write_text(page, encoding="utf-8", errors="replace")


def report_html(result: FitResult, film: bytes | None = None) -> str:
    """The report as text. ``film``: see `write_report`."""
    pictures = [picture for picture in result.pictures if picture.target.size]
    title, verdict = _verdict(result)
    sections = [
        verdict,
        *(_picture(picture, number, len(pictures)) for number, picture in enumerate(pictures)),
        "" if pictures else "<h2>Pictures</h2><p>The result has no pictures.</p>",
        _film(pictures, film),
        _curves(result),
        f"<h2>Estimates</h2>{report_numbers.estimates(result)}" if result.estimates else "",
        report_numbers.correlations(result),
        _reproduction(result),
    ]
    style, script = ((_PAGE / name).read_text(encoding="utf-8") for name in ("report.css", "report.js"))
    script = f"\n{script}"
    policy = _POLICY.format(digest=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode())
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n<meta name="color-scheme" content="light dark">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(section for section in sections if section)
        + f"\n</main>\n<script>{script}</script>\n</body>\n</html>\n"
    )


def _verdict(result: FitResult) -> tuple[str, str]:
    """Title of the page and its first section."""
    shown = result.pictures
    one = f"“{shown[0].name}”" if len(shown) == 1 and shown[0].name else "the picture"
    target = one if len(shown) == 1 else f"the {len(shown)} pictures" if shown else "its pictures"
    verb, sign, kind = ("matches", "✓", "found") if result.found else ("does not match", "✗", "lost")
    title = f"{'Found' if result.found else 'Not found'}: the scene {verb} {target}"
    lines = [f"<p>{escape(_errors(shown))}</p>"] if shown else []
    if not result.found:
        lines.append("<p>The numbers below are those of the best attempt. Do not take them for estimates.</p>")
    words = "".join(f"<li>{escape(sentence)}</li>" for sentence in result.words)
    lines.append(f"<ul>{words}</ul>" if words else "")
    starts = len({step["start"] for step in result.history})
    tried = f" from {starts} {'start' if starts == 1 else 'starts'}" if starts else ""
    lines.append(f'<p class="pale">{escape(_duration(result.seconds))}{tried}.</p>')
    return title, (
        f'<header class="verdict {kind}"><h1><span aria-hidden="true">{sign}</span> {escape(title)}</h1>{"".join(lines)}</header>'
    )


def _errors(pictures: Sequence[Picture]) -> str:
    errors = [picture.error for picture in pictures]
    if len(errors) == 1:
        return "No pixel of the target counts." if np.isnan(errors[0]) else f"The fit {display.error_words(errors[0])}."
    known = [error for error in errors if not np.isnan(error)]
    if not known:
        return "No pixel of the targets counts."
    low, high = display.percent(min(known)), display.percent(max(known))
    return f"The fit differs from the targets by {low if low == high else f'{low} to {high}'} of their brightness."


def _duration(seconds: float) -> str:
    if not np.isfinite(seconds):
        return "The fit took an unknown time"
    if seconds < 120:
        return f"The fit took {seconds:.2g} s" if seconds < 10 else f"The fit took {seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"The fit took {minutes} minutes" if minutes < 120 else f"The fit took {minutes / 60:.1f} hours"


def _picture(picture: Picture, number: int, count: int) -> str:
    """Section of a target: its images in a grid, and a slider between target and fit."""
    name = picture.name or (f"target {number}" if count > 1 else "the target")
    height, width = picture.target.shape[:2]
    gain = display.gain(picture)
    started = relative_error(picture.start, picture.target, picture.weight)
    facts = [
        f"{width} × {height} pixels",
        f"error {display.percent(picture.error)} of the target's brightness, at the start {display.percent(started)}",
        f"rendered colours × {picture.exposure:.4g}" if picture.exposure != 1 else "",
        f"all images are shown with their colours × {gain:.2g}" if gain != 1 else "",
    ]
    values = display.difference(picture.fit, picture.target, picture.weight)
    end = display.limit(values, picture.weight)
    place = f"picture-{number}"
    figures = [
        _figure(display.colours(picture.target, gain), "Target", "the picture to be matched", name, f"{place}-target"),
        _figure(display.colours(picture.start, gain), "Start", "the scene as it was given", name),
        _figure(display.colours(picture.fit, gain), "Fit", "the scene with the fitted numbers", name, f"{place}-fit"),
        _figure(
            *(display.difference_colours(values, picture.weight, end), "Difference", "fit minus target", name),
            extra=_scale(end, masked=bool((picture.weight <= 0).any())),
        ),
        _mask(picture.weight, name),
    ]
    if picture.shadows is not None:
        text = "light that arrives in the fitted scene: black is in shadow, white is lit"
        figures.append(_figure(display.greys(picture.shadows), "Shadows", text, name))
    slider = (
        f'<div class="compare" data-first="{place}-target" data-second="{place}-fit" hidden><div></div>'
        f"<label>Target on the left, fit on the right<br>"
        f'<input type="range" min="0" max="100" value="50"></label></div>'
    )
    return (
        f'<section><h2>{escape(name)}</h2><p class="pale">{escape(" · ".join(filter(None, facts)))}</p>'
        f'<div class="pictures">{"".join(figures)}</div>{slider}</section>'
    )


def _figure(pixels: Pixels, title: str, text: str, name: str, place: str = "", extra: str = "") -> str:
    alt = escape(f"{title} of {name}: {text}")
    identity = f' id="{place}"' if place else ""
    return f"<figure>{_img(pixels, alt, identity)}<figcaption><b>{title}</b>: {text}{extra}</figcaption></figure>"


def _mask(weight: Image, name: str) -> str:
    """Weights of the pixels, or a sentence if all are 1."""
    share = float(np.mean(weight > 0)) if weight.size else 0.0
    if np.all(weight == 1):
        return ""
    return _figure(display.greys(weight), "Mask", f"white pixels count, black ones do not; {display.percent(share)} count", name)


def _scale(end: float, *, masked: bool) -> str:
    """The scale of a difference, with its unit."""
    ends = "".join(f"<span>{text}</span>" for text in (f"−{display.percent(end)}", "0", f"+{display.percent(end)}"))
    gradient = f"linear-gradient(90deg,{','.join(display.scale_colours())})"
    words = "in % of the target's brightness. Blue: the fit is darker. Red: brighter."
    return (
        f'<div class="scale" aria-hidden="true" style="background:{gradient}"></div>'
        f'<div class="ends">{ends}</div>{words}{" Striped: does not count." if masked else ""}'
    )


def _img(pixels: Pixels, alt: str, attributes: str = "") -> str:
    """An embedded picture. ``alt`` is escaped already."""
    height, width = pixels.shape[:2]
    longer = max(height, width)
    coarse = longer <= _COARSE
    if longer > _SIDE:
        pixels = display.resized(pixels, max(1, round(height * _SIDE / longer)), max(1, round(width * _SIDE / longer)))
    kind = ' class="coarse"' if coarse else ""
    source = _webp(pixels, lossless=coarse)
    return f'<img src="{source}" alt="{alt}" width="{pixels.shape[1]}" height="{pixels.shape[0]}"{kind}{attributes}>'


def _webp(pixels: Pixels, *, lossless: bool) -> str:
    from PIL import Image as pillow

    data = io.BytesIO()
    pillow.fromarray(pixels).save(data, format="WEBP", lossless=lossless, quality=88)
    return _data("image/webp", data.getvalue())


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _film(pictures: Sequence[Picture], film: bytes | None) -> str:
    if not any(picture.frames for picture in pictures):
        return ""
    last = still(pictures)
    height, width = last.shape[:2]
    alt = "Film: the target, the fit from the start to the end, and their difference"
    content = encode_film(pictures) if film is None else film
    return (
        '<h2>Film</h2><details class="film" open><summary>The fit from coarse to fine</summary><picture>'
        f'<source media="(prefers-reduced-motion: reduce)" srcset="{_webp(last, lossless=False)}">'
        f'<img src="{_data("image/webp", content)}" alt="{alt}" width="{width}" height="{height}">'
        "</picture></details>"
        '<p class="pale">From left to right: target, fit, difference. First the start, then coarse and finer images, at last '
        "the fit. The error is a fraction of the target's brightness.</p>"
    )


def _curves(result: FitResult) -> str:
    if not result.history:
        return ""
    best = best_start(result.history)
    starts = len({step["start"] for step in result.history})
    light, dark = (_data("image/svg+xml", curves_svg(result.history, dark=dark).encode()) for dark in (False, True))
    summary = "Error over seconds. " + (
        f"Start {best} ends with {display.percent(_last_error(result.history, best))}."
        if best is not None
        else "No start has an error that is a number."
    )
    text = "Dotted lines: stages of the best start, from coarse to fine images. Errors of different stages cannot be compared."
    return (
        f"<h2>Course</h2><p>{escape(summary)}{f' The best of {starts} starts is the wide line.' if starts > 1 else ''}</p>"
        f'<figure class="curves"><picture><source media="(prefers-color-scheme: dark)" srcset="{dark}">'
        f'<img src="{light}" alt="{escape(summary)}" width="640" height="310"></picture><figcaption>{text}</figcaption></figure>'
    )


def _last_error(history: Sequence[Step], start: int) -> float:
    return [step["error"] for step in history if step["start"] == start][-1]


def _reproduction(result: FitResult) -> str:
    """The command, its settings as a file, versions and the machine."""
    record = result.to_json()
    machine: Mapping[str, Any] = record["machine"] if isinstance(record["machine"], dict) else {}
    facts = {"shadowmap_dr": record["shadowmap_dr"], **machine}
    entries = "".join(
        f"<dt>{escape(name)}</dt><dd>{escape(str(value))}</dd>" for name, value in facts.items() if value is not None
    )
    command = f"<h2>How to reproduce this</h2><pre>{escape(_in_lines(result.command))}</pre>"
    settings = to_toml(result.settings)
    file = f"<h3>The same as fit.toml</h3><pre>{escape(settings)}</pre>" if settings else ""
    return f"{command}{file}<h3>Versions and machine</h3><dl>{entries}</dl>"


def _in_lines(command: str) -> str:
    """A long command with a line for each option."""
    try:
        words = shlex.split(command)
    except ValueError:
        return command
    if len(command) < _LINE or any("\n" in word for word in words):
        return command
    lines = [""]
    for word in map(shlex.quote, words):
        if word.startswith("--"):
            lines.append(f"    {word}")
        else:
            lines[-1] += f" {word}" if lines[-1] else word
    return " \\\n".join(lines)
