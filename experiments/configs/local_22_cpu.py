"""`local_cpu.py` from the paper's 22 training actions alone.

Command: physxnet train experiments/configs/local_22_cpu.py --name local-22
         --data runs/ours --out runs/local-22
Cost:    29 minutes beside other work on two cores: 6,144 steps.
Result:  the rows `local-22` of experiments/results/test_errors.md; with --data runs/blender the
         rows `blender-22`.
"""

import dataclasses
import pathlib
import runpy

_LOCAL = runpy.run_path(str(pathlib.Path(__file__).with_name("local_cpu.py")))["CONFIG"]

CONFIG = dataclasses.replace(_LOCAL, epochs=8, validate_every=782)
