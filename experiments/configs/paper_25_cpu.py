"""The paper's network of paper_cpu.py for five times as long: does it learn too little?

Command: physxnet train experiments/configs/paper_25_cpu.py --name paper-25 --data runs/ours
         --out runs/paper-25
Cost:    20 minutes on two cores beside other work: it stopped after 6,840 of 9,600 steps.
Result:  best on its validation action after 2,280 steps, worse from there on; on the test
         actions experiments/results/paper_longer.json, beside `paper`.
"""

import dataclasses
import pathlib
import runpy

_PAPER = runpy.run_path(str(pathlib.Path(__file__).with_name("paper_cpu.py")))["CONFIG"]

CONFIG = dataclasses.replace(_PAPER, epochs=25)
