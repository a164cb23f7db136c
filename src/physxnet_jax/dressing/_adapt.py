"""Fine-tuning a network to one garment: by the physics of its cloth, or by simulations of it."""

import dataclasses
import functools
import pathlib
import shutil
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jaxtyping import Array, Float

from ..body import Body, load_body
from ..errors import MotionError, PhysXNetError, WeightsError
from ..files import atomic_write, claims
from ..garment import Garment
from ..models import (
    Generator,
    Predictor,
    load_predictor,
    make_generator,
)
from ..motion import (
    CLIPS,
    Motion,
    prepare_motion,
)
from ..simulation import (
    PRESETS,
    PreparedScene,
    Solver,
    fingerprint,
    make_system,
    prepare_scene,
    simulate_batch,
)
from ..typing import pytree
from ._adapt_task import FPS, AdaptConfig, Frames, Task, encode, judge, make_task, task_loss
from ._dresser import with_body
from ._meshes import resolve_garments
from ._simulate import Simulation, build_scene


@dataclasses.dataclass(frozen=True, kw_only=True)
class Adapted:
    """A network that was fine-tuned to a garment.

    Attributes:
        predictor: The network; the one that was given if none did better.
        garment: The garment.
        loss: Loss on the held-out clip before and after.
        potential: Potential of the cloth there, mean over frames, before and after [J].
        rmse_mm: Distance there from the simulation, before and after [mm]; None without one.
        steps: Steps after which the network was best.
        seconds: Time of learning, and of simulations [s].
    """

    predictor: Predictor
    garment: Garment
    loss: tuple[float, float]
    potential: tuple[float, float]
    rmse_mm: tuple[float, float] | None
    steps: int
    seconds: tuple[float, float]


@claims("resume")
def adapt(
    garment: Garment | str | pathlib.Path,
    *,
    weights: Predictor | str | pathlib.Path = "base",
    motions: Sequence[Motion | str | pathlib.Path] = (),
    held_out: Motion | str | pathlib.Path = "punch",
    shape: Float[Array, " shapes"] | None = None,
    simulate: bool = False,
    frames: int | None = None,
    config: AdaptConfig | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    resume: str | pathlib.Path | None = None,
) -> Adapted:
    """Fine-tunes the decoder of a garment's template to that garment, fabric and body.

    Without simulations the network learns to lower the potential of its own cloth
    (`incremental_potential`, and contact with the skin); means over patches of 8 cm stay where
    it predicted them: the potential knows no friction, so that cloth would slide off. With
    ``simulate`` it learns from simulations of the garment at ``standard``, and from the potential.

    Args:
        garment: The garment, a file, or a name with options such as ``coat.obj:fabric=wool``.
        weights: The network to start from.
        motions: Motions to learn from, beside the built-in clips.
        held_out: Motion by which the best network is chosen.
        shape: Shape parameters of the body; the default if None.
        simulate: Whether to simulate the garment on all motions first.
        frames: Use at most so many frames of each motion; a thousand take 0.3 GB of memory.
        config: Settings; defaults if None.
        progress: Called with the stage, what is done and the total.
        resume: Folder for what is finished, from which the same call goes on after an
            interruption; it is removed at the end. If None, nothing is stored.

    Returns:
        The network and what it gained. Its other decoders and its encoder are unchanged.

    Raises:
        BusyError: Another process adapts with the same ``resume``.
        PhysXNetError: The garment can't be worn by this network, a motion can't be read, or the
            folder to resume from belongs to another call.
        WeightsError: The network isn't a `Generator` as it was loaded, but folded, say.

    References:
        Santesteban et al., SNUG (2022); Grigorev et al., HOOD (2023).
    """
    config = AdaptConfig() if config is None else config
    report = (lambda *_: None) if progress is None else progress
    began = time.perf_counter()
    body = load_body()
    rest = body.rest_vertices(body.default_shape() if shape is None else shape)
    every = (*(n for n in CLIPS if n != held_out), *motions, held_out)
    clips = _load_clips(every, body, shape, frames, config.frames)
    (worn,), _ = resolve_garments(garment, body, shape)
    predictor = load_predictor(weights) if not isinstance(weights, Predictor) else weights
    predictor = with_body(predictor, body, rest)
    _check_plain(predictor)
    scene = prepare_scene(build_scene([worn], body, shape, Simulation()))
    solver = PRESETS["standard"]
    folder = None
    if resume is not None:
        call = (predictor.state, scene.effects, scene.inverse_mass, clips, np.asarray(rest))
        folder = _claim(pathlib.Path(resume), fingerprint(*call), config, simulate)
    truth = _simulated(scene, clips, solver, folder, report) if simulate else None
    simulated = time.perf_counter() - began
    physics = make_system(scene, solver)
    task, first = make_task(predictor, body, rest, worn, physics, config, simulate)
    data = [encode(task, first, m, body, rest) for m in clips]
    if truth is not None:
        data = [dataclasses.replace(d, target=x) for d, x in zip(data, truth, strict=True)]
    best, steps = _learn(task, first, data[:-1], data[-1], folder, report)
    if folder is not None:
        shutil.rmtree(folder)
    before, after = (judge(task, p, data[-1]) for p in (first, best))
    return Adapted(
        predictor=dataclasses.replace(predictor, state=nnx.merge_state(best, task.others)),
        garment=worn,
        loss=(before["loss"], after["loss"]),
        potential=(before["potential"], after["potential"]),
        rmse_mm=(before["rmse_mm"], after["rmse_mm"]) if simulate else None,
        steps=steps,
        seconds=(time.perf_counter() - began - simulated, simulated if simulate else 0.0),
    )


def _load_clips(
    motions: Sequence[Motion | str | pathlib.Path],
    body: Body,
    shape: Float[Array, " shapes"] | None,
    frames: int | None,
    least: int,
) -> list[Motion]:
    if frames is not None and frames < least:
        raise MotionError(f"frames is {frames}, shorter than a window of {least} frames.")
    clips = [prepare_motion(m, fps=FPS, body=body, shape=shape, frames=frames) for m in motions]
    if short := [m.name for m in clips if m.num_frames < least]:
        raise MotionError(f"{short[0]} is shorter than a window of {least} frames.")
    return clips


def _check_plain(predictor: Predictor) -> None:
    network = nnx.merge(predictor.graph, predictor.state)
    if isinstance(network, Generator) and not predictor.mirror_tta:
        plain = nnx.eval_shape(lambda: make_generator(predictor.config))
        if jax.tree.structure(nnx.state(plain)) == jax.tree.structure(nnx.state(network)):
            return
    raise WeightsError("adapt needs a network as it was loaded, without anything added to it.")


def _claim(folder: pathlib.Path, call: str, config: AdaptConfig, simulate: bool) -> pathlib.Path:
    """Makes a folder for unfinished work, or finds that of the same call."""
    key = f"{call} {config} simulate={simulate}"
    label = folder / "key.txt"
    if label.is_file() and label.read_text() != key:
        raise PhysXNetError(
            f"{folder} holds unfinished work on another garment or with other settings. Finish"
            " that, or remove the folder."
        )
    if not label.is_file() and folder.is_dir() and any(folder.iterdir()):
        raise PhysXNetError(f"{folder} holds other files. Choose an empty or a new folder.")
    with atomic_write(label) as part:
        part.write_text(key)
    return folder


def _simulated(
    scene: PreparedScene,
    clips: list[Motion],
    solver: Solver,
    folder: pathlib.Path | None,
    report: Callable[[str, int, int], None],
) -> list[Float[np.ndarray, "frames vertices 3"]]:
    """The garment as it is simulated on each clip [m]."""
    stored = None if folder is None else folder / "simulations.npz"
    if stored is not None and stored.is_file():
        with np.load(stored) as known:
            return [known[str(k)] for k in range(len(clips))]
    rollouts = simulate_batch(
        scene,
        clips,
        solver=solver,
        progress=lambda k, n: report("simulation", k, n),
        resume=None if folder is None else folder / "simulation",
    )
    for r in rollouts:
        r.check()
    cloth = [r.positions[0] for r in rollouts]
    if stored is not None:
        with atomic_write(stored) as part, part.open("wb") as file:
            np.savez(file, **{str(k): x for k, x in enumerate(cloth)})  # pyright: ignore
    return cloth


@pytree
@dataclasses.dataclass(frozen=True, kw_only=True)
class _Learned:
    """What changes while a network learns.

    Attributes:
        params: Parameters.
        memory: State of the optimizer.
        best: The parameters that did best on the held-out clip.
        least: Their loss there.
        best_step: Their step.
        step: Steps done.
    """

    params: Any
    memory: Any
    best: Any
    least: Array
    best_step: Array
    step: Array


@functools.partial(jax.jit, static_argnames="optimizer")
def _step(
    task: Task, params: Any, memory: Any, frames: Frames, optimizer: optax.GradientTransformation
) -> tuple[Any, Any]:
    """One step of the optimizer."""
    slopes = jax.grad(lambda p: task_loss(task, p, frames)[0])(params)
    # optax raises floats to integer powers, which strict promotion forbids.
    with jax.numpy_dtype_promotion("standard"):
        changes, memory = optimizer.update(slopes, memory, params)
    return optax.apply_updates(params, changes), memory


def _learn(
    task: Task,
    params: Any,
    clips: list[Frames],
    held_out: Frames,
    folder: pathlib.Path | None,
    report: Callable[[str, int, int], None],
) -> tuple[Any, int]:
    """The parameters that did best on the held-out clip, and the steps they took."""
    config = task.config
    room = np.array([len(c.target) - config.frames + 1 for c in clips])
    rate = optax.cosine_decay_schedule(config.learning_rate, config.steps)
    optimizer = optax.apply_if_finite(optax.adam(rate), config.steps)
    now = _Learned(
        params=params,
        memory=optimizer.init(params),
        best=params,
        least=jnp.asarray(judge(task, params, held_out)["loss"]),
        best_step=jnp.zeros((), jnp.int32),
        step=jnp.zeros((), jnp.int32),
    )
    checkpoints = None
    if folder is not None:
        # Orbax takes a second to import.
        from ..training import Checkpoints

        checkpoints = Checkpoints(folder / "checkpoints", keep=1)
        now = checkpoints.latest(now) or now
    for step in range(int(now.step) + 1, config.steps + 1):
        # A stream of each step's own: a resumed run draws the same.
        rng = np.random.default_rng((config.seed, step))
        drawn = rng.choice(len(clips), config.windows, p=room / room.sum())
        taken = []
        for c in drawn:
            start = rng.integers(room[c])
            taken.append(clips[c].take(slice(start, start + config.frames)))
        frames = jax.tree.map(lambda *x: jax.device_put(np.concatenate(x)), *taken)
        params, memory = _step(task, now.params, now.memory, frames, optimizer)
        now = dataclasses.replace(now, params=params, memory=memory, step=jnp.int32(step))
        if step % config.validate_every == 0 or step == config.steps:
            loss = jnp.asarray(judge(task, params, held_out)["loss"])
            if loss < now.least:
                now = dataclasses.replace(now, best=params, least=loss, best_step=now.step)
            if checkpoints is not None:
                checkpoints.save(now)
        report("steps", step, config.steps)
    if checkpoints is not None:
        checkpoints.close()
    return now.best, int(now.best_step)
