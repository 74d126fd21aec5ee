"""Script: seconds from the start of Python to the first derivative, a part at a time, for `bench.first`.

It imports this package for the plug-in `shadowmap` alone: other integrators take the time that they take without it.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from typing import Any


def main() -> None:
    """Read a task (JSON) from standard input; write seconds since ``began`` (`time.time`) at the end of each part."""
    task: dict[str, Any] = json.load(sys.stdin)
    ends = {"Python": time.time()}
    if task["integrator"]["type"] == "shadowmap":
        importlib.import_module("shadowmap_dr")
    import drjit as dr
    import mitsuba as mi

    mi.set_variant(task["variant"])
    integrator = mi.load_dict(task["integrator"])
    dr.set_thread_count(task["threads"])
    ends["imports"] = time.time()
    scene = mi.load_file(task["scene"], resolution=task["size"])
    ends["scene"] = time.time()

    params, change = mi.traverse(scene), mi.Float(0)
    dr.enable_grad(change)
    params[task["parameter"]] = params[task["parameter"]] + change
    params.update()
    image = mi.render(scene, params, integrator=integrator, spp=task["spp"])
    dr.eval(image)
    dr.sync_thread()
    ends["image"] = time.time()
    dr.backward(dr.mean(dr.square(image - 0.5), axis=None))
    gradient = float(dr.grad(change)[0])
    ends["derivative"] = time.time()
    # Mitsuba's warnings do not end their line.
    print("\n" + json.dumps({"gradient": gradient, "seconds": {name: end - task["began"] for name, end in ends.items()}}))


if __name__ == "__main__":
    main()
