"""`physxnet adapt`: a network fine-tuned to one garment."""

from rich.console import Console

from ..body import load_body
from ..data import CARD
from ..dressing import AdaptConfig, adapt
from ..errors import PhysXNetError
from ..garment import with_default_fabric
from ..models import read_card, save_predictor
from ._experiment_commands import Adapt
from ._progress import print_json, progress_bars
from ._shape import parse_shape


def run_adapt(command: Adapt, console: Console) -> int:
    """Fine-tunes, writes the weights, and reports what was gained."""
    card, out = read_card(command.weights), command.out
    if out.exists() and not out.is_dir():
        raise PhysXNetError(f"{out} is a file; name a folder for the weights.")
    (garment,) = with_default_fabric((command.garment,), command.fabric)
    try:
        config = AdaptConfig(steps=command.steps, seed=command.seed)
    except ValueError as error:
        raise PhysXNetError(f"--{error}") from None
    with progress_bars(console) as progress:
        done = adapt(
            garment,
            weights=command.weights,
            motions=command.motions,
            held_out=command.held_out,
            shape=load_body().shape(**parse_shape(command.shape)),
            simulate=command.simulate,
            frames=command.frames,
            config=config,
            progress=progress,
            resume=out.with_name(f".{out.name}.unfinished"),
        )
    found = {
        "garment": garment,
        "from": card["name"],
        "shape": list(command.shape),
        "simulated": command.simulate,
        "steps": done.steps,
        "held_out": command.held_out,
        "loss": done.loss,
        "potential": done.potential,
        "rmse_mm": done.rmse_mm,
    }
    save_predictor(out, done.predictor, name=out.name, card={**CARD, "adapted": found})
    if command.terminal.json:
        print_json({**found, "seconds": done.seconds, "files": [out]})
        return 0
    learned, simulated = done.seconds
    console.print(
        f"{command.held_out}, before and after {done.steps} steps ({learned:.0f} s, simulation"
        f" {simulated:.0f} s): loss {done.loss[0]:.2f}, {done.loss[1]:.2f}; potential"
        f" {done.potential[0]:.2f}, {done.potential[1]:.2f} J",
        highlight=False,
        soft_wrap=True,
    )
    if done.rmse_mm is not None:
        console.print(
            f"distance from the simulation: {done.rmse_mm[0]:.1f}, {done.rmse_mm[1]:.1f} mm",
            highlight=False,
        )
    if not done.steps:
        console.print("no step did better on the motion that was held out: same weights")
    console.print(f"wrote {out}: use it as --weights {out}", highlight=False, soft_wrap=True)
    return 0
