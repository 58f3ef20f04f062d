"""What all adaptors have in common: read the table, time the fit, judge it, print one line of JSON.

Needs nothing but NumPy, since it runs in the environment of each program.
"""

import contextlib
import io
import json
import sys
import time

import numpy as np

# Fits are repeated up to so many times, but no further once so much time is spent [s].
_TIMES, _ENOUGH = 5, 5.0
# Poses of a first fit that isn't counted: it loads and compiles whatever is only loaded and compiled once.
_FIRST = 50


def judge(prepare):
    """Fit and print parameters, seconds (of the processor, the shortest of several fits) and held-out rms [um].

    Args:
        prepare: takes the URDF's path, about where the reflector is in the flange's frame [m], and whether the arm is
            elastic; returns ``fit(q, position)``, which returns the number of parameters and a function that predicts
            positions [m], shape (N, 3), from joints [rad], shape (N, 6).
    """
    urdf, table = sys.argv[1:3]
    data = np.load(table)
    seconds = []
    # Reports of the programs themselves are not ours.
    with contextlib.redirect_stdout(io.StringIO()):
        fit = prepare(urdf, data["reflector"], bool(data["elastic"]))
        fit(data["q"][:_FIRST], data["position"][:_FIRST])
        while len(seconds) < _TIMES and sum(seconds) < _ENOUGH:
            begun = time.process_time()
            parameters, predict = fit(data["q"], data["position"])
            seconds.append(time.process_time() - begun)
        errors = np.linalg.norm(predict(data["other_q"]) - data["other_position"], axis=1)
    held_out = 1e6 * float(np.sqrt(np.mean(errors**2)))
    print(json.dumps({"parameters": int(parameters), "seconds": min(seconds), "held_out_um": held_out}))
