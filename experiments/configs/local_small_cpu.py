"""The ladder's rung `small`: `local_cpu.py` with 16 channels in the first layer.

Command: physxnet train experiments/configs/local_small_cpu.py --name small
         --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed
         --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied
         --splits train extra --out runs/small
Cost:    21 minutes on two cores beside other work: 12,176 steps.
Result:  the rows `small` of experiments/results/test_errors.md: the recipe and the data of
         `local_cpu.py`.
"""

import dataclasses
import pathlib
import runpy

_LOCAL = runpy.run_path(str(pathlib.Path(__file__).with_name("local_cpu.py")))["CONFIG"]

CONFIG = dataclasses.replace(_LOCAL, model=dataclasses.replace(_LOCAL.model, width=16))
