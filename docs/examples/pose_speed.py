"""Time of an optimisation step with shadows, without, and with Mitsuba's projective integrator at its fair setting, in turns.

python docs/examples/pose_speed.py --normals vertex [--resolution 128] [--rounds 10] [--setting 1/1/64/none/64]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from mitsuba_baselines.pose import ProjectiveSetting
from shadowmap_dr.experiments.common.timing import Contender, OtherWork, alternate, compare
from shadowmap_dr.experiments.pose.methods import METHODS, build_method, usual_methods
from shadowmap_dr.experiments.pose.scene import make_problem, path_traced_reference, start_pose

# isort: split
import mitsuba as mi  # after shadowmap_dr, which chooses the LLVM library

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--object", default="spot")
parser.add_argument("--resolution", type=int, default=128)
parser.add_argument("--normals", choices=("face", "vertex"), default="face")
parser.add_argument("--rounds", type=int, default=10, help="steps of Mitsuba's; ours make five times as many")
parser.add_argument("--setting", metavar="C/P/I[/GUIDING[/SPP]]", help="sample counts of Mitsuba's instead of the fair ones")
options = parser.parse_args()

mi.set_variant("llvm_ad_rgb")
with tempfile.TemporaryDirectory() as folder:
    problem = make_problem(options.object, options.resolution, normals=options.normals, work=Path(folder))
    reference = path_traced_reference(problem, Path(folder) / "reference.exr")
    contenders = {}
    setting = ProjectiveSetting.parse(options.setting) if options.setting else None
    for name in METHODS if setting else usual_methods(normals=options.normals):
        method = build_method(name, problem, reference, setting=setting)
        method.reset(start_pose(0, 0))
        if name == "mitsuba":
            print(f"Mitsuba: {method.setting}")
            contenders[name] = Contender(method.step, options.rounds, warm_up=2, settle=0, burst=1)
        else:
            contenders[name] = Contender(method.step, 5 * options.rounds)
    others = OtherWork()
    if "mitsuba" not in contenders:
        print("No sample counts are known with which Mitsuba's integrator converges here: it is left out.")
    ratios = [("mitsuba", "shadows"), ("mitsuba", "rasterizer"), ("shadows", "rasterizer")]
    result = compare(alternate(contenders), [pair for pair in ratios if pair[0] in contenders])
    for name, seconds in result["seconds"].items():
        print(f"{name}: {1e3 * seconds['median']:.2f} ms a step (quartiles {1e3 * seconds['q1']:.2f}, {1e3 * seconds['q3']:.2f})")
    for name, ratio in result["ratio_of_medians"].items():
        print(f"{name}: {ratio:.{1 if ratio < 10 else 0}f}x")
    cores = others.cores()
    print("" if cores is None else f"cores that other work used meanwhile: {cores:.1f}")
