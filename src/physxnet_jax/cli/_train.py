"""`physxnet train`: a network from a configuration and datasets."""

import dataclasses
import math

from rich.console import Console

from ..data import CARD, list_entries, read_note
from ..devices import join_processes
from ..models import read_card, save_predictor
from ..training import TrainConfig, read_metrics, train as run
from ._configs import config_name, read_config
from ._experiment_commands import Train
from ._progress import progress_bars

# What a card records about each dataset.
_CARD_KEYS = (
    *("engine", "mirror", "speed", "left_out", "upper_from", "exaggerate", "subdue"),
    *("fps", "quantum"),
)


def train(command: Train, console: Console) -> int:
    """Starts or resumes training; writes the weights to the run's folder."""
    first = join_processes(command.coordinator, command.num_processes, command.process_id) == 0
    config = read_config(command.config, TrainConfig)
    if command.validation is not None:
        config = dataclasses.replace(config, validation=command.validation)
    entries = [
        entry
        for root in command.data
        for split in command.splits
        for entry in list_entries(root, split)
    ]
    with progress_bars(console) as progress:

        def report(done: int, total: int, values: dict[str, float]) -> None:
            progress("steps", done, total)
            if first and "validation_mm" in values:
                console.print(
                    f"step {done}: validation {values['validation_mm']:.2f} mm", highlight=False
                )

        predictor = run(
            config,
            entries,
            command.out,
            steps=command.steps,
            devices=command.devices,
            report=report,
        )
    if not first:
        return 0
    log = read_metrics(command.out)
    used = [e for e in entries if e.name not in config.validation]
    measured = [x for x in log if math.isfinite(x.get("validation_mm", math.nan))]
    alarms = sum(line.get("gan_alarm", 0.0) for line in log)
    notes = [read_note(root) for root in command.data]
    card = {
        **CARD,
        "data": [
            {k: n[k] for k in _CARD_KEYS if k in n} | {"splits": list(command.splits)}
            for n in notes
        ],
        "training": {
            "actions": len(used),
            "frames": sum(e.frames for e in used),
            "steps": int(log[-1]["step"]) if log else 0,
            **(
                {
                    "validation": list(config.validation),
                    "best_step": int(min(measured, key=lambda x: x["validation_mm"])["step"]),
                }
                if config.validation and measured
                else {}
            ),
            **({"blend": config.blend} if config.blend < 1.0 else {}),
            **(
                {"start": config.start, "start_sha256": read_card(config.start)["sha256"]}
                if config.start
                else {}
            ),
            "mirrored too": config.mirror_augmentation,
            "adversarial": config.adversarial,
            "seed": config.seed,
            "gan_alarms": int(alarms),
            "updates_skipped": int(max((x.get("skipped", 0.0) for x in log), default=0)),
        },
    }
    name = command.name or config_name(command.config)
    save_predictor(command.out / "weights", predictor, name=name, card=card)
    console.print(f"wrote {command.out / 'weights'}", highlight=False)
    if alarms:
        console.print(
            f"{alarms:.0f} of {len(log)} log lines have gan_alarm set: discriminator and generator"
            " were out of balance there; compare with adversarial=False."
        )
    return 0
