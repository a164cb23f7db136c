"""The ladder's rung `nano`: `local_cpu.py` with 8 channels in the first layer.

Command: physxnet train experiments/configs/local_nano_cpu.py --name nano
         --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed
         --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied
         --splits train extra --out runs/nano
Cost:    14 minutes on two cores beside other work: 12,176 steps.
Result:  the rows `nano` of experiments/results/test_errors.md: the recipe and the data of
         `local_cpu.py`.
"""

import dataclasses
import pathlib
import runpy

_LOCAL = runpy.run_path(str(pathlib.Path(__file__).with_name("local_cpu.py")))["CONFIG"]

CONFIG = dataclasses.replace(_LOCAL, model=dataclasses.replace(_LOCAL.model, width=8))
