"""`local_cpu.py` with Muon in place of Adam: the shipped weights `local-muon`.

Command: physxnet train experiments/configs/local_muon_cpu.py --name local-muon
         --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed
         --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied
         --splits train extra --out runs/local-muon
Cost:    26 minutes on two cores, some of it beside other work: 12,176 steps.
Result:  the rows `local-muon` of experiments/results/test_errors.md, and half of `pair`.
"""

import dataclasses
import pathlib
import runpy

_LOCAL = runpy.run_path(str(pathlib.Path(__file__).with_name("local_cpu.py")))["CONFIG"]

CONFIG = dataclasses.replace(_LOCAL, optimiser="muon")
