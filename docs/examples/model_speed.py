"""Time from the mouse to the picture while a mesh follows a brush: measured in a real browser that is driven like a user's.

Starts ``shadowmap-dr model sphere --serve``, paints on the shadow with mouse events, and lets the page tell when the mesh has
moved. Needs Chromium and ``pip install '.[test]'``.

    python docs/examples/model_speed.py [--strokes 12] [--seconds 8] [--json FILE] [--picture FILE]
"""

from __future__ import annotations

import argparse
import math
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from browsers import browser, paint  # noqa: E402

from shadowmap_dr.experiments.common.timing import machine  # noqa: E402
from shadowmap_dr.io import records  # noqa: E402

SIZE, HALF, RADIUS_WORLD = 256, 2.0, 1.0

# For each frame: when its picture had been handed to the screen (the frame after it begins), steps so far, and how far the mesh
# has moved since `mark`.
WATCH = """
const log = { frames: [], down: null, base: null, last: null };
window.log = log;
window.mark = () => Object.assign(log, { frames: [], down: null, base: log.last.vertices.slice() });
addEventListener("pointerdown", (event) => { log.down ??= event.timeStamp; }, true);
document.addEventListener("frame", ({ detail }) => {
  log.last = detail;
  let moved = 0;
  if (log.base) {
    for (let i = 0; i < log.base.length; i += 3) {
      moved = Math.max(moved, Math.hypot(...[0, 1, 2].map((c) => detail.vertices[i + c] - log.base[i + c])));
    }
  }
  const entry = { steps: detail.steps, moved, match: detail.match, speed: detail.speed };
  requestAnimationFrame((now) => log.frames.push({ ...entry, time: now }));
});
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--strokes", type=int, default=12, help="strokes whose delay is measured")
    parser.add_argument("--seconds", type=float, default=8.0, help="of painting without a pause")
    parser.add_argument("--json", type=Path, help="record to write")
    parser.add_argument("--picture", type=Path, help="picture of the page to write (.png)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        code = "from shadowmap_dr.cli.main import main; main()"
        server = subprocess.Popen(
            [sys.executable, "-c", code, "model", "sphere", "--serve", "--port", "0", "-o", f"{folder}/mesh.ply"],
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            url = re.search(r"http://\S+", server.stdout.readline()).group()
            with browser() as instance:
                record = measure(instance, url, options)
        finally:
            server.send_signal(signal.SIGINT)
            server.wait(30)
    print(f"{record['steps_per_second']:.1f} steps a second while painting, {record['frames_per_second']:.1f} frames a second")
    for name, text in (("first", "the mesh has moved by a pixel"), ("half", "half of the stroke's end is reached")):
        times = record["delay_seconds"][name]
        print(f"{1000 * np.median(times):.0f} ms (median of {len(times)}), {1000 * max(times):.0f} ms at most until {text}")
    if options.json:
        records.write_json(options.json, record)


def measure(instance: Any, url: str, options: argparse.Namespace) -> dict[str, Any]:
    page = instance.new_page(viewport={"width": 1280, "height": 800})
    page.add_init_script(WATCH)
    page.goto(url)
    rest(page)
    page.wait_for_timeout(1000)
    stroke(page, 0.0)  # everything once, so that all is compiled
    rest(page)
    delays = [delay(page, 2 * math.pi * (k + 0.5) / options.strokes) for k in range(options.strokes)]
    speed = painting(page, options.seconds)
    rest(page)
    if options.picture:
        picture(page, options.picture)
    return {
        "settings": {"size": SIZE, "triangles": 12_800, "browser": instance.version, "graphics": "software"},
        "machine": {name: value for name, value in machine().items() if name != "variant"},
        "delay_seconds": {name: [entry[name] for entry in delays] for name in ("first", "half")},
        **speed,
    }


def rest(page: Any) -> None:
    page.wait_for_timeout(100)
    page.locator("body[data-phase=resting]").wait_for(timeout=120_000)


def stroke(page: Any, angle: float, length: float = 18.0) -> None:
    """From the sphere's rim outwards, in the time a hand takes."""
    rim = RADIUS_WORLD / HALF * SIZE / 2
    places = [rim - 6 + length * k / 12 for k in range(13)]
    paint(page, [(SIZE / 2 + r * math.cos(angle), SIZE / 2 + r * math.sin(angle)) for r in places], SIZE)


def delay(page: Any, angle: float) -> dict[str, float]:
    """Seconds from pressing the button until the mesh on the page has moved by a pixel, and half as far as the stroke goes."""
    page.evaluate("() => window.mark()")
    stroke(page, angle)
    rest(page)
    page.wait_for_timeout(200)
    log = page.evaluate("() => ({ frames: window.log.frames, down: window.log.down })")
    pixel = 2 * HALF / SIZE
    result = {}
    for name, distance in (("first", pixel), ("half", 0.5 * (18 - 6 + 12) * pixel)):
        result[name] = next(frame["time"] for frame in log["frames"] if frame["moved"] > distance) / 1000 - log["down"] / 1000
    page.click("#undo")
    rest(page)
    return result


def painting(page: Any, seconds: float) -> dict[str, float]:
    """Steps and frames a second while the brush goes round and round, out and in."""
    page.evaluate("() => window.mark()")
    box = page.locator("#shadow").bounding_box()
    scale = box["width"] / SIZE
    began, k = time.monotonic(), 0
    while (now := time.monotonic() - began) < seconds:
        radius = 64 + 24 * math.sin(5 * now)
        x, y = (SIZE / 2 + radius * f(1.3 * now) for f in (math.cos, math.sin))
        page.mouse.move(box["x"] + x * scale, box["y"] + y * scale)
        if k == 0:
            page.mouse.down()
        k += 1
    page.mouse.up()
    frames = page.evaluate("() => window.log.frames")
    span = (frames[-1]["time"] - frames[0]["time"]) / 1000
    return {
        "steps_per_second": (frames[-1]["steps"] - frames[0]["steps"]) / span,
        "frames_per_second": (len(frames) - 1) / span,
        "mouse_moves_per_second": k / seconds,
    }


def picture(page: Any, path: Path) -> None:
    """A creature with ears, arms and feet, while it is being painted."""
    page.click("#reset")
    rest(page)
    limbs = [
        ([(106, 78), (98, 48), (92, 26)], 11), ([(150, 78), (158, 48), (164, 26)], 11),
        ([(70, 140), (44, 152), (28, 138)], 8), ([(186, 140), (212, 152), (228, 138)], 8),
        ([(104, 184), (100, 212), (84, 226)], 12), ([(152, 184), (156, 212), (172, 226)], 12),
    ]  # fmt: skip
    for points, radius in limbs:
        page.fill("#radius", str(radius))
        along = np.linspace(0, len(points) - 1, 24)
        line = [tuple(float(np.interp(t, range(len(points)), [p[c] for p in points])) for c in (0, 1)) for t in along]
        paint(page, line, SIZE)
    page.wait_for_timeout(100)
    page.screenshot(path=path)
    rest(page)


if __name__ == "__main__":
    main()
