"""What three networks answer on motion that none has seen: once more, faster and swung wider.

Command: physxnet dataset build experiments/configs/dataset_taught_b.py --out runs/taught_b
Cost:    see docs/reproduction.md, the dataset.
Result:  more cloth for one network to learn from that shall answer as three do.
"""

import dataclasses
import pathlib
import runpy

_BEFORE = runpy.run_path(str(pathlib.Path(__file__).with_name("dataset_taught_a.py")))["CONFIG"]

CONFIG = dataclasses.replace(_BEFORE, upper_from=9, exaggerate=1.3, speed=1.1)
