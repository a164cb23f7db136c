"""`local_muon_cpu.py` taught by three networks beside the simulator: one that answers as they do.

Command: physxnet train experiments/configs/local_taught_cpu.py --name local-taught
         --data runs/ours --data runs/extra --data runs/left_out --data runs/mixed
         --data runs/mixed_extra --data runs/mixed_left_out --data runs/varied
         --data runs/taught_a --data runs/taught_b --splits train extra
         --out runs/local-taught
Cost:    41 minutes on two cores beside other work: 8,942 steps.
Result:  the rows `local-taught` of experiments/results/more_motion.json; it isn't shipped.

References:
    Hinton et al., Distilling the knowledge in a neural network (2015).
"""

import dataclasses
import pathlib
import runpy

_LOCAL = runpy.run_path(str(pathlib.Path(__file__).with_name("local_cpu.py")))["CONFIG"]

# Once through half as many frames again.
CONFIG = dataclasses.replace(_LOCAL, optimiser="muon", epochs=1)
