"""A fit as a shooting problem whose errors are as large as can be."""

from contextlib import nullcontext

from compilers import no_compiler
from fit_cases import KEY, TS, levels, smooth

import gbid
from gbid.identify.data import gather
from gbid.identify.disturbances import UNDISTURBED
from gbid.identify.options import FitArguments
from gbid.identify.problem.assemble import assemble, build_problem

BEGIN = {**KEY, "bd_xx": 2e4, "bd_xy": -3e3, "bd_yx": 5e3, "bd_yy": 1e4}


def recording(name, n, seed):
    u = 4e-6 * levels(n, 2, seed=seed)
    p = 1e-6 * smooth(n, 2, seed=seed + 50)  # no answer to u: the errors are as large as can be
    channels = {"u": ("x", "y"), "p": ("x", "y")}
    return gbid.Recording({"u": u, "p": p}, TS, name=name, units={"u": "m", "p": "m"}, channels=channels)


def problem(engine="numpy", disturbances=UNDISTURBED, **options):
    recordings = [recording("a", 900, 1), recording("b", 1300, 2)]
    structure = gbid.RotorBearing()
    data = gather(recordings, ("u",), ("p",), minimum=50)
    settings = {"criterion": "trace", "left_out": {"b": [(700, 900)]}, "window": 100, **options}
    arguments = FitArguments(intersample="foh", output_weights=[1.0, 2.0], prior={"k_xx": (-6e5, 1e3)}, **settings)
    with no_compiler() if engine == "numpy" else nullcontext():
        assembly = assemble(structure, structure.parameters, BEGIN, data, arguments, disturbances=disturbances)
    begin = {q.name: BEGIN.get(q.name.partition("[")[0], 1e-7) for q in assembly.free}
    return build_problem(assembly, data, arguments, begin)
